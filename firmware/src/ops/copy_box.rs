//! A strided box of the input inside a border: slice, pad, or both.

use super::StepContext;
use crate::arena::{Changed, Operands};
use crate::image::{Check, ParseError};
use crate::kernels::{CopyBoxArgs, Kernels};
use crate::program::CopyBox;
use crate::tensor::Shape;

pub(super) fn validate(step: &CopyBox, context: &StepContext<'_, '_>) -> Result<u64, ParseError> {
    let input = context.activation(step.input)?;
    let output = context.typed(step.output, input.element)?;
    let places = axes(input.shape).into_iter().zip(axes(output.shape));
    let taken = step.begin.into_iter().zip(step.stride).zip(step.size).zip(step.before);
    for ((from, to), (((begin, stride), size), before)) in places.zip(taken) {
        context.ensure(Check::StepBox, stride > 0 && size > 0, size, from)?;
        let last = u64::from(size.saturating_sub(1)).saturating_mul(stride.into()).saturating_add(begin.into());
        context.ensure(Check::StepBox, last < u64::from(from), begin, from)?;
        let end = u32::from(before).saturating_add(size.into());
        context.ensure(Check::StepBox, end <= u32::from(to), end, to)?;
    }
    let codes = input.element.codes();
    let nearest = step.border.clamp(*codes.start(), *codes.end());
    context.ensure(Check::StepBorder, codes.contains(&step.border), step.border, nearest)?;
    Ok(output.shape.elements())
}

fn axes(shape: Shape) -> [u16; 3] {
    [shape.height, shape.width, shape.channels]
}

pub(super) fn run<K: Kernels>(
    step: &CopyBox,
    context: &StepContext<'_, '_>,
    kernels: &K,
    operands: Operands<'_>,
) -> Result<(), Changed> {
    let args = CopyBoxArgs {
        input_shape: context.tensor(step.input)?.shape,
        output_shape: context.tensor(step.output)?.shape,
        begin: step.begin,
        stride: step.stride,
        size: step.size,
        before: step.before,
        border: step.border,
    };
    kernels.copy_box(&args, operands.reads.codes(0)?, operands.output.codes()?);
    Ok(())
}
