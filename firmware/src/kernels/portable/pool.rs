//! Portable pools.
use crate::kernels::{PoolArgs, RequantArgs, SumArgs, TermArgs};
use crate::tensor::{Codes, CodesMut};

/// See [`crate::kernels::Kernels::max_pool`].
pub fn max_pool(_args: &PoolArgs, _input: Option<Codes<'_>>, _output: CodesMut<'_>) {}
/// See [`crate::kernels::Kernels::average_pool`].
pub fn average_pool(_args: &PoolArgs, _requant: &RequantArgs, _input: Codes<'_>, _output: CodesMut<'_>) {}
/// See [`crate::kernels::Kernels::global_pool`].
pub fn global_pool(_channels: u16, _sum: &SumArgs, _terms: &[TermArgs<'_>], _output: CodesMut<'_>) {}
