//! Portable convolution.
use crate::kernels::Conv2dArgs;
use crate::tensor::CodesMut;

/// See [`crate::kernels::Kernels::conv2d`].
pub fn conv2d(_args: &Conv2dArgs<'_>, _input: &[i8], _output: CodesMut<'_>, _scratch: &mut [u8]) {}
