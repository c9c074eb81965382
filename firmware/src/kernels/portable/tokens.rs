//! Portable tokens.
use crate::kernels::TokensArgs;
use crate::tensor::CodesMut;

/// See [`crate::kernels::Kernels::tokens`].
pub fn tokens(_args: &TokensArgs<'_>, _output: CodesMut<'_>) {}
