//! Portable attention.
use crate::kernels::AttentionArgs;
use crate::tensor::CodesMut;

/// See [`crate::kernels::Kernels::attention`].
pub fn attention(
    _args: &AttentionArgs<'_>,
    _query: Option<&[i8]>,
    _key: &[i8],
    _value: &[i8],
    _output: CodesMut<'_>,
    _scratch: &mut [u8],
) {
}
