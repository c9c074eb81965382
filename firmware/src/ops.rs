//! The operators, one per file: what a step must satisfy beside the tensor table (`validate`), and its run on a
//! backend (`run`), which resolves tensors and constant ranges into the views of [`crate::kernels`].
//!
//! `Image::parse` validates every step once; the engine validates the step again right before it runs, which costs
//! microseconds and keeps the promise of "no panic" even if the image's memory changes under way. The arithmetic is in
//! the kernels. Attention follows these formulas per head and query row (q, k, v symmetric, d = head width):
//!
//! 1. `a_j = Σ q·k_j`; `δ_j = max(a) − a_j`; `u_j = min(R(δ_j·M_u, n_u), 31·2^16)`
//! 2. `I = u>>16, k = (u>>8)&255, r = u&255`; `e_j = R((T[k]<<8) − (T[k]−T[k+1])·r, 8 + min(I,23))` (Q15)
//! 3. `S = Σ e_j`; `c = bits(S)`; `R_s = floor(2^(c+22)/S)`
//! 4. `A_t = Σ_j e_j·v_jt`; `t = R(A_t·R_s, c+10)` (Q12); `ctx = clamp(z_o + R(t·M, n))`

#![deny(
    clippy::indexing_slicing,
    clippy::arithmetic_side_effects,
    clippy::unwrap_used,
    clippy::expect_used,
    clippy::panic
)]

use crate::arena::{Changed, Regions};
use crate::image::{Image, ParseError};
use crate::kernels::Kernels;
use crate::program::Step;

mod add;
mod attention;
mod average_pool;
mod branch_linear;
mod concat;
mod context;
mod conv2d;
mod copy_box;
mod gather_sum;
mod global_pool;
mod layer_norm;
mod linear;
mod max_pool;
mod requantize;
mod rescale;
mod resize_bilinear;
mod sigmoid;
mod softmax;
mod spatial_softmax;
mod term;
mod tokens;
mod waypoint_decoder;

pub(crate) use context::StepContext;

/// Checks a step against the tensor table; the memory of its operands is checked by
/// [`StepContext::check_operands`]. Returns its elementary operations.
pub(crate) fn validate(step: &Step, context: &StepContext<'_, '_>) -> Result<u64, ParseError> {
    match step {
        Step::Conv2d(step) => conv2d::validate(step, context),
        Step::Linear(step) => linear::validate(step, context),
        Step::MaxPool(step) => max_pool::validate(step, context),
        Step::AveragePool(step) => average_pool::validate(step, context),
        Step::GlobalPool(step) => global_pool::validate(step, context),
        Step::Add(step) => add::validate(step, context),
        Step::Requantize(step) => requantize::validate(step, context),
        Step::ResizeBilinear(step) => resize_bilinear::validate(step, context),
        Step::Tokens(step) => tokens::validate(step, context),
        Step::LayerNorm(step) => layer_norm::validate(step, context),
        Step::Attention(step) => attention::validate(step, context),
        Step::WaypointDecoder(step) => waypoint_decoder::validate(step, context),
        Step::CopyBox(step) => copy_box::validate(step, context),
        Step::Concat(step) => concat::validate(step, context),
        Step::Softmax(step) => softmax::validate(step, context),
        Step::GatherSum(step) => gather_sum::validate(step, context),
        Step::BranchLinear(step) => branch_linear::validate(step, context),
        Step::Sigmoid(step) => sigmoid::validate(step, context),
        Step::SpatialSoftmax(step) => spatial_softmax::validate(step, context),
    }
}

/// Validates a step and runs it in the memory regions.
pub(crate) fn run<K: Kernels>(
    step: &Step,
    image: &Image<'_>,
    position: u16,
    kernels: &K,
    regions: &mut Regions<'_>,
) -> Result<(), Changed> {
    let context = StepContext { image, position };
    context.check_operands(step)?;
    validate(step, &context)?;
    let operands = context.operands(step, regions)?;
    match step {
        Step::Conv2d(step) => conv2d::run(step, &context, kernels, operands),
        Step::Linear(step) => linear::run(step, &context, kernels, operands),
        Step::MaxPool(step) => max_pool::run(step, &context, kernels, operands),
        Step::AveragePool(step) => average_pool::run(step, &context, kernels, operands),
        Step::GlobalPool(step) => global_pool::run(step, &context, kernels, operands),
        Step::Add(step) => add::run(step, kernels, operands),
        Step::Requantize(step) => requantize::run(step, kernels, operands),
        Step::ResizeBilinear(step) => resize_bilinear::run(step, &context, kernels, operands),
        Step::Tokens(step) => tokens::run(step, &context, kernels, operands),
        Step::LayerNorm(step) => layer_norm::run(step, &context, kernels, operands),
        Step::Attention(step) => attention::run(step, &context, kernels, operands),
        Step::WaypointDecoder(step) => waypoint_decoder::run(step, &context, kernels, operands),
        Step::CopyBox(step) => copy_box::run(step, &context, kernels, operands),
        Step::Concat(step) => concat::run(step, &context, kernels, operands),
        Step::Softmax(step) => softmax::run(step, &context, kernels, operands),
        Step::GatherSum(step) => gather_sum::run(step, &context, kernels, operands),
        Step::BranchLinear(step) => branch_linear::run(step, &context, kernels, operands),
        Step::Sigmoid(step) => sigmoid::run(step, &context, kernels, operands),
        Step::SpatialSoftmax(step) => spatial_softmax::run(step, &context, kernels, operands),
    }
}

impl From<ParseError> for Changed {
    fn from(_: ParseError) -> Self {
        Self
    }
}
