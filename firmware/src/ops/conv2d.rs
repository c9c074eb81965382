//! Convolution.

use super::{StepContext, rescale};
use crate::arena::{Changed, Operands};
use crate::image::{Check, ParseError};
use crate::kernels::{Conv2dArgs, Kernels, plan};
use crate::program::Conv2d;
use crate::tensor::ElementType;

pub(super) fn validate(step: &Conv2d, context: &StepContext<'_, '_>) -> Result<u64, ParseError> {
    let input = context.typed(step.input, ElementType::I8)?.shape;
    let record = context.activation(step.output)?;
    let output = record.shape;
    context.window(&step.window, input, output)?;
    let divides = |channels: u16| channels.checked_rem(step.groups) == Some(0);
    context.ensure(Check::StepGroups, divides(input.channels) && divides(output.channels), step.groups, 1)?;
    let taps = u64::from(step.window.kernel_h).saturating_mul(step.window.kernel_w.into());
    let depth = taps.saturating_mul(input.channels.checked_div(step.groups).unwrap_or_default().into());
    let weights = plan::weight_bytes(step.kernel, step.groups, output.channels, depth);
    context.constants::<i8>(step.weights, weights)?;
    context.constants::<i8>(step.padding_codes, input.channels.into())?;
    rescale::validate(&step.rescale, step.output, 1, context)?;
    let scratch = plan::conv2d_scratch_bytes(step.kernel, input, output, step.window, step.groups);
    context.scratch(step.scratch, scratch)?;
    Ok(output.elements().saturating_mul(depth))
}

pub(super) fn run<K: Kernels>(
    step: &Conv2d,
    context: &StepContext<'_, '_>,
    kernels: &K,
    operands: Operands<'_>,
) -> Result<(), Changed> {
    let Operands { output, scratch, reads } = operands;
    let args = Conv2dArgs {
        input_shape: context.tensor(step.input)?.shape,
        output_shape: context.tensor(step.output)?.shape,
        window: step.window,
        groups: step.groups,
        kernel: step.kernel,
        weights: context.slice(step.weights)?,
        padding_codes: context.slice(step.padding_codes)?,
        rescale: rescale::args(&step.rescale, context, &reads)?,
    };
    kernels.conv2d(&args, reads.elements(0)?, output.codes()?, scratch);
    Ok(())
}
