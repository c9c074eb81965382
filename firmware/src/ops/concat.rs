//! Two maps one behind the other along an axis, each brought to the output's scale.

use super::StepContext;
use crate::arena::{Changed, Operands};
use crate::image::{Check, ParseError};
use crate::kernels::{ConcatSourceArgs, Kernels, RequantArgs};
use crate::program::{Axis, Concat, ConcatSource};
use crate::tensor::Shape;

pub(super) fn validate(step: &Concat, context: &StepContext<'_, '_>) -> Result<u64, ParseError> {
    let output = context.activation(step.output)?.shape;
    let first = validate_source(&step.first, context)?;
    let second = validate_source(&step.second, context)?;
    let axes = [
        (Axis::Height, first.height, second.height, output.height),
        (Axis::Width, first.width, second.width, output.width),
        (Axis::Channels, first.channels, second.channels, output.channels),
    ];
    for (axis, first, second, output) in axes {
        if axis == step.axis {
            context.ensure_equal(Check::StepShape, output, u32::from(first).saturating_add(second.into()))?;
        } else {
            context.ensure_equal(Check::StepShape, first, output)?;
            context.ensure_equal(Check::StepShape, second, output)?;
        }
    }
    context.output_codes(step.output, step.zero_point, step.clamp)?;
    Ok(output.elements())
}

fn validate_source(source: &ConcatSource, context: &StepContext<'_, '_>) -> Result<Shape, ParseError> {
    let record = context.activation(source.tensor)?;
    context.zero_point(source.tensor, source.zero_point)?;
    context.requant(source.requant)?;
    Ok(record.shape)
}

pub(super) fn run<K: Kernels>(
    step: &Concat,
    context: &StepContext<'_, '_>,
    kernels: &K,
    operands: Operands<'_>,
) -> Result<(), Changed> {
    let args = |source: &ConcatSource, operand| {
        Ok::<_, Changed>(ConcatSourceArgs {
            codes: operands.reads.codes(operand)?,
            shape: context.tensor(source.tensor)?.shape,
            requant: RequantArgs {
                input_zero_point: source.zero_point,
                requant: source.requant,
                zero_point: step.zero_point,
                clamp: step.clamp,
            },
        })
    };
    let sources = [args(&step.first, 0)?, args(&step.second, 1)?];
    kernels.concat(step.axis, &sources, operands.output.codes()?);
    Ok(())
}
