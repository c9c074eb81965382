//! Softmax over all pixels of each channel, and the pixel that it expects.

use super::StepContext;
use crate::arena::{Changed, Operands};
use crate::fixed_point::EXP_TABLE_LEN;
use crate::image::{Check, ParseError};
use crate::kernels::{Kernels, SpatialSoftmaxArgs};
use crate::program::SpatialSoftmax;
use crate::tensor::{ElementType, Shape};

/// Most rows and most columns: the sum over all pixels, times 64 times the last index, stays below 2^53.
const MAX_SIDE: i64 = 256;

pub(super) fn validate(step: &SpatialSoftmax, context: &StepContext<'_, '_>) -> Result<u64, ParseError> {
    let shape = context.typed(step.input, ElementType::I16)?.shape;
    context.ensure_within(Check::StepPixels, shape.height, 1..=MAX_SIDE)?;
    context.ensure_within(Check::StepPixels, shape.width, 1..=MAX_SIDE)?;
    let output = context.typed(step.output, ElementType::I32)?.shape;
    context.same_shape(output, Shape::tokens(shape.channels, 2))?;
    context.requant(step.exponent)?;
    context.constants::<i16>(step.exp_table, EXP_TABLE_LEN as u64)?;
    Ok(shape.elements().saturating_mul(3))
}

pub(super) fn run<K: Kernels>(
    step: &SpatialSoftmax,
    context: &StepContext<'_, '_>,
    kernels: &K,
    operands: Operands<'_>,
) -> Result<(), Changed> {
    let args = SpatialSoftmaxArgs {
        shape: context.tensor(step.input)?.shape,
        exponent: step.exponent,
        exp_table: context.slice(step.exp_table)?,
    };
    kernels.spatial_softmax(&args, operands.reads.elements(0)?, operands.output.words()?);
    Ok(())
}
