//! Max pool; may write over its input.

use super::StepContext;
use crate::arena::{Changed, Operands};
use crate::image::{Check, ParseError};
use crate::kernels::{Kernels, PoolArgs, plan};
use crate::program::MaxPool;

pub(super) fn validate(step: &MaxPool, context: &StepContext<'_, '_>) -> Result<u64, ParseError> {
    let input = context.activation(step.input)?;
    let output = context.typed(step.output, input.element)?;
    context.ensure_equal(Check::StepShape, output.shape.channels, input.shape.channels)?;
    context.window(&step.window, input.shape, output.shape)?;
    context.undilated(&step.window)?;
    let ordered = output.in_place_of.is_none() || plan::max_pool_in_place(input.shape, output.shape, step.window);
    context.ensure(Check::InPlaceOrder, ordered, step.input.0, step.input.0)?;
    let taps = u64::from(step.window.kernel_h).saturating_mul(step.window.kernel_w.into());
    Ok(output.shape.elements().saturating_mul(taps))
}

pub(super) fn run<K: Kernels>(
    step: &MaxPool,
    context: &StepContext<'_, '_>,
    kernels: &K,
    operands: Operands<'_>,
) -> Result<(), Changed> {
    let args = PoolArgs {
        input_shape: context.tensor(step.input)?.shape,
        output_shape: context.tensor(step.output)?.shape,
        window: step.window,
    };
    kernels.max_pool(&args, operands.reads.optional_codes(0)?, operands.output.codes()?);
    Ok(())
}
