//! Portable bilinear resize.
use crate::kernels::ResizeArgs;
use crate::tensor::CodesMut;

/// See [`crate::kernels::Kernels::resize_bilinear`].
pub fn resize_bilinear(_args: &ResizeArgs<'_>, _output: CodesMut<'_>) {}
