//! GRU that emits waypoints.

use super::StepContext;
use crate::arena::{Changed, Operands};
use crate::image::{Check, ParseError};
use crate::kernels::{Kernels, WaypointDecoderArgs, plan};
use crate::program::WaypointDecoder;
use crate::tensor::{ElementType, Shape};

/// Largest hidden state: the sums of 16-bit products stay below 2^42.
const MAX_HIDDEN: i64 = 1024;
/// Entries of the tanh table.
const TANH_ENTRIES: u64 = 513;

pub(super) fn validate(step: &WaypointDecoder, context: &StepContext<'_, '_>) -> Result<u64, ParseError> {
    let hidden = context.typed(step.hidden, ElementType::I16)?.shape;
    context.same_shape(hidden, Shape::vector(hidden.channels))?;
    context.ensure_within(Check::StepChannels, hidden.channels, 1..=MAX_HIDDEN)?;
    context.ensure_equal(Check::StepShape, context.typed(step.goal, ElementType::I32)?.shape.elements(), 2_u64)?;
    let output = context.typed(step.output, ElementType::I32)?.shape;
    context.same_shape(output, Shape::tokens(output.height, 2))?;
    let width = u64::from(hidden.channels);
    let rows = width.saturating_mul(3);
    let inputs = if step.concat { 4 } else { 2 };
    context.constants::<i16>(step.input_weights, rows.saturating_mul(inputs))?;
    context.constants::<i16>(step.hidden_weights, rows.saturating_mul(width))?;
    context.constants::<i32>(step.input_multipliers, rows)?;
    context.constants::<i32>(step.hidden_multipliers, rows)?;
    context.constants::<u8>(step.shifts, rows)?;
    context.constants::<i64>(step.biases, width.saturating_mul(4))?;
    context.constants::<i16>(step.output_weights, width.saturating_mul(2))?;
    context.constants::<i64>(step.output_bias, 2)?;
    context.constants::<i16>(step.tanh_table, TANH_ENTRIES)?;
    context.ensure_within(Check::StepFraction, step.hidden_fraction_bits, 0..=15)?;
    for pre_shift in [step.input_pre_shift, step.hidden_pre_shift, step.output_pre_shift] {
        context.ensure_within(Check::StepPreShift, pre_shift, 0..=36)?;
    }
    for requant in step.output_requant {
        context.requant(requant)?;
    }
    context.scratch(step.scratch, plan::waypoint_decoder_scratch_bytes(hidden.channels))?;
    let products = rows.saturating_mul(width.saturating_add(inputs)).saturating_add(width.saturating_mul(2));
    Ok(products.saturating_mul(output.height.into()))
}

pub(super) fn run<K: Kernels>(
    step: &WaypointDecoder,
    context: &StepContext<'_, '_>,
    kernels: &K,
    operands: Operands<'_>,
) -> Result<(), Changed> {
    let Operands { output, scratch, reads } = operands;
    let args = WaypointDecoderArgs {
        hidden_size: context.tensor(step.hidden)?.shape.channels,
        steps: context.tensor(step.output)?.shape.height,
        hidden_fraction_bits: step.hidden_fraction_bits.into(),
        concat: step.concat,
        input_weights: context.slice(step.input_weights)?,
        hidden_weights: context.slice(step.hidden_weights)?,
        input_pre_shift: step.input_pre_shift.into(),
        hidden_pre_shift: step.hidden_pre_shift.into(),
        input_multipliers: context.slice(step.input_multipliers)?,
        hidden_multipliers: context.slice(step.hidden_multipliers)?,
        shifts: context.slice(step.shifts)?,
        biases: context.slice(step.biases)?,
        output_weights: context.slice(step.output_weights)?,
        output_bias: context.slice(step.output_bias)?,
        output_pre_shift: step.output_pre_shift.into(),
        output_requant: step.output_requant,
        tanh_table: context.slice(step.tanh_table)?,
    };
    kernels.waypoint_decoder(&args, reads.elements(0)?, reads.elements(1)?, output.words()?, scratch);
    Ok(())
}
