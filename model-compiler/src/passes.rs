//! Graph to equivalent graph: fewer nodes, the same result.
//!
//! Each pass is one rule in one file. A fused node stands where the last node of its chain stood and keeps its name
//! and value, so operands are always computed before it and a value is found under the same name before and after.

use crate::error::{Error, ErrorCode, Result};
use crate::ir::Graph;
use crate::ir::verify::verify;

mod clip_before_pool;
mod commute_pointwise;
mod dead_code;
#[cfg(test)]
mod fixture;
mod fold_batch_norm;
mod fold_batch_norm_forward;
mod fold_grey_norm;
mod fold_normalization;
mod fold_padding;
mod fuse_activation;
mod fuse_residual;
mod lower_batch_norm;
mod lower_normalization;
mod rewrite;
mod split_concat;

/// Switches of the passes.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct PassOptions {
    /// Add the residual inside convolutions and linear layers (one rounding instead of two). Enlargements take their
    /// residual either way.
    pub fuse_residual: bool,
}

impl Default for PassOptions {
    fn default() -> Self {
        Self { fuse_residual: true }
    }
}

/// Runs all passes in order.
///
/// # Errors
/// See [`optimize_with`].
pub fn optimize(graph: &mut Graph) -> Result<()> {
    optimize_with(graph, PassOptions::default())
}

/// Runs all passes in order and verifies the graph after each.
///
/// # Errors
/// `Numeric`: what the verifier found, such as a folded weight that exceeds the range of `f32`.
pub fn optimize_with(graph: &mut Graph, options: PassOptions) -> Result<()> {
    type Pass<'a> = &'a dyn Fn(&mut Graph);
    let passes: [(&str, Pass<'_>); 13] = [
        ("fold_padding", &fold_padding::run),
        ("fold_batch_norm", &fold_batch_norm::run),
        ("fold_batch_norm_forward", &fold_batch_norm_forward::run),
        ("fold_grey_norm", &fold_grey_norm::run),
        ("lower_batch_norm", &lower_batch_norm::run),
        ("fold_normalization", &fold_normalization::run),
        ("lower_normalization", &lower_normalization::run),
        ("commute_pointwise", &commute_pointwise::run),
        ("fuse_residual", &|graph| fuse_residual::run(graph, options.fuse_residual)),
        ("clip_before_pool", &clip_before_pool::run),
        ("fuse_activation", &fuse_activation::run),
        ("split_concat", &split_concat::run),
        ("dead_code", &dead_code::run),
    ];
    for (name, pass) in passes {
        pass(graph);
        verify(graph).map_err(|errors| Error::new(ErrorCode::Numeric, format!("pass {name}"), errors.join("\n")))?;
    }
    Ok(())
}
