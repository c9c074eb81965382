//! Matrix product with one of several blocks of weights; on every backend its linear layer.

use super::{StepContext, rescale};
use crate::arena::{Changed, Operands};
use crate::fault::{self, Fault};
use crate::image::{Check, ParseError};
use crate::kernels::{Kernels, LinearArgs, RescaleArgs, plan};
use crate::program::{BranchLinear, Residual};
use crate::tensor::ElementType;

pub(super) fn validate(step: &BranchLinear, context: &StepContext<'_, '_>) -> Result<u64, ParseError> {
    let record = context.activation(step.input)?;
    let (input, output) = (record.shape, context.activation(step.output)?.shape);
    context.ensure_equal(Check::StepShape, output.positions(), input.positions())?;
    let command = context.typed(step.command, ElementType::I8)?.shape;
    context.ensure_equal(Check::StepShape, command.elements(), 1_u64)?;
    context.ensure_within(Check::StepBranches, step.branches, 1..=i64::from(i8::MAX))?;
    let block = plan::weight_bytes(step.kernel, 1, output.channels, input.channels.into());
    context.constants::<i8>(step.weights, block.saturating_mul(step.branches.into()))?;
    let alone = step.rescale.residual == Residual::None;
    context.ensure(Check::StepResidual, alone, !alone, false)?;
    rescale::validate(&step.rescale, step.output, step.branches, context)?;
    let scratch = plan::linear_scratch_bytes(step.kernel, input.positions(), input.channels, record.element);
    context.scratch(step.scratch, scratch)?;
    Ok(output.elements().saturating_mul(input.channels.into()))
}

pub(super) fn run<K: Kernels>(
    step: &BranchLinear,
    context: &StepContext<'_, '_>,
    kernels: &K,
    operands: Operands<'_>,
) -> Result<(), Changed> {
    let Operands { output, scratch, reads } = operands;
    let (input, shape) = (context.tensor(step.input)?.shape, context.tensor(step.output)?.shape);
    let command: &[i8] = reads.elements(1)?;
    let branch = branch(*command.first().ok_or(Changed)?, step.branches);
    let of_all = rescale::args(&step.rescale, context, &reads)?;
    let args = LinearArgs {
        positions: shape.positions(),
        inputs: input.channels,
        outputs: shape.channels,
        kernel: step.kernel,
        weights: block(context.slice(step.weights)?, branch, step.branches)?,
        wide: step.wide,
        rescale: RescaleArgs {
            bias: block(of_all.bias, branch, step.branches)?,
            multipliers: block(of_all.multipliers, branch, step.branches)?,
            shifts: block(of_all.shifts, branch, step.branches)?,
            ..of_all
        },
    };
    kernels.linear(&args, reads.codes(0)?, output.codes()?, scratch);
    Ok(())
}

/// `clamp(command − 1, 0, branches − 1)`.
fn branch(command: i8, branches: u16) -> u16 {
    let first = if fault::active(Fault::BranchFromZero) { 0 } else { 1 };
    let last = branches.saturating_sub(1);
    u16::try_from(i16::from(command).saturating_sub(first)).unwrap_or(0).min(last)
}

/// One of `count` equal parts of an array.
fn block<T>(array: &[T], index: u16, count: u16) -> Result<&[T], Changed> {
    let length = array.len().checked_div(count.into()).ok_or(Changed)?;
    let start = length.checked_mul(index.into()).ok_or(Changed)?;
    array.get(start..start.checked_add(length).ok_or(Changed)?).ok_or(Changed)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_code_selects_a_block() {
        let expected = [(i8::MIN, 0), (-1, 0), (0, 0), (1, 0), (2, 1), (5, 4), (6, 5), (7, 5), (i8::MAX, 5)];
        for (command, index) in expected {
            assert_eq!(branch(command, 6), index, "command {command}");
        }
        assert_eq!((branch(i8::MAX, 127), branch(9, 1), branch(9, 0)), (126, 0, 0));
    }

    #[test]
    fn blocks_are_equal_parts_in_order() {
        let array = [1, 2, 3, 4, 5, 6];
        assert_eq!(block(&array, 0, 3), Ok(&[1, 2][..]));
        assert_eq!(block(&array, 2, 3), Ok(&[5, 6][..]));
        assert_eq!(block(&array, 3, 3), Err(Changed));
        assert_eq!(block(&array, 0, 0), Err(Changed));
    }
}
