//! Average pool over full windows.

use super::StepContext;
use crate::arena::{Changed, Operands};
use crate::image::{Check, ParseError};
use crate::kernels::{Kernels, PoolArgs, RequantArgs};
use crate::program::AveragePool;

pub(super) fn validate(step: &AveragePool, context: &StepContext<'_, '_>) -> Result<u64, ParseError> {
    let (input, output) = (context.activation(step.input)?.shape, context.activation(step.output)?.shape);
    context.ensure_equal(Check::StepShape, output.channels, input.channels)?;
    context.window(&step.window, input, output)?;
    context.undilated(&step.window)?;
    let window = &step.window;
    let pad = window.pad_top.max(window.pad_bottom).max(window.pad_left).max(window.pad_right);
    context.ensure_equal(Check::StepPadding, pad, 0_u8)?;
    context.zero_point(step.input, step.input_zero_point)?;
    context.requant(step.requant)?;
    context.output_codes(step.output, step.zero_point, step.clamp)?;
    let taps = u64::from(window.kernel_h).saturating_mul(window.kernel_w.into());
    Ok(output.elements().saturating_mul(taps))
}

pub(super) fn run<K: Kernels>(
    step: &AveragePool,
    context: &StepContext<'_, '_>,
    kernels: &K,
    operands: Operands<'_>,
) -> Result<(), Changed> {
    let args = PoolArgs {
        input_shape: context.tensor(step.input)?.shape,
        output_shape: context.tensor(step.output)?.shape,
        window: step.window,
    };
    let requant = RequantArgs {
        input_zero_point: step.input_zero_point,
        requant: step.requant,
        zero_point: step.zero_point,
        clamp: step.clamp,
    };
    kernels.average_pool(&args, &requant, operands.reads.codes(0)?, operands.output.codes()?);
    Ok(())
}
