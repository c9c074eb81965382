//! Bilinear enlargement by a whole factor, optionally added to a map of the output's size.

use super::{StepContext, term};
use crate::arena::{Changed, Operands};
use crate::image::{Check, ParseError};
use crate::kernels::{Kernels, ResizeArgs};
use crate::program::ResizeBilinear;

pub(super) fn validate(step: &ResizeBilinear, context: &StepContext<'_, '_>) -> Result<u64, ParseError> {
    let input = term::validate(&step.input, context)?.shape;
    let output = context.activation(step.output)?.shape;
    context.ensure_equal(Check::StepShape, output.channels, input.channels)?;
    let whole = |large: u16, small: u16| large.checked_rem(small) == Some(0);
    context.ensure(Check::StepFactor, whole(output.height, input.height), output.height, input.height)?;
    context.ensure(Check::StepFactor, whole(output.width, input.width), output.width, input.width)?;
    if let Some(residual) = &step.residual {
        context.same_shape(term::validate(residual, context)?.shape, output)?;
    }
    context.constants::<[u16; 2]>(step.rows, output.height.into())?;
    context.constants::<[u16; 2]>(step.columns, output.width.into())?;
    context.ensure_within(Check::StepWeightBits, step.weight_bits, 4..=11)?;
    context.sum_shift(step.shift)?;
    context.output_codes(step.output, step.zero_point, step.clamp)?;
    Ok(output.elements().saturating_mul(4))
}

pub(super) fn run<K: Kernels>(
    step: &ResizeBilinear,
    context: &StepContext<'_, '_>,
    kernels: &K,
    operands: Operands<'_>,
) -> Result<(), Changed> {
    let reads = &operands.reads;
    let args = ResizeArgs {
        input_shape: context.tensor(step.input.tensor)?.shape,
        output_shape: context.tensor(step.output)?.shape,
        input: term::args(&step.input, reads, 0)?,
        residual: step.residual.as_ref().map(|residual| term::args(residual, reads, 1)).transpose()?,
        rows: context.slice(step.rows)?,
        columns: context.slice(step.columns)?,
        weight_bits: step.weight_bits.into(),
        sum: term::sum(step.shift, step.zero_point, step.clamp),
    };
    kernels.resize_bilinear(&args, operands.output.codes()?);
    Ok(())
}
