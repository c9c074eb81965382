//! Convolutions and linear layers: every depth around the blocks, outputs and positions around the tiles, all packings.

use super::draw::{Buffer, Draw};
use super::{Case, Outcome, code_bits};
use crate::kernels::{Conv2dArgs, LinearArgs, RescaleArgs, ResidualArgs, k4n16, plan};
use crate::program::{KernelId, Window};
use crate::tensor::{Codes, ElementType, Shape, index};

/// Output channels on both sides of what kernels take at once.
const OUTPUTS: [u16; 16] = [1, 2, 3, 4, 7, 8, 9, 15, 16, 17, 31, 33, 63, 64, 65, 80];
/// Depths from 1 to here follow each other.
const DEPTHS: u32 = 130;

/// A convolution: in turn one of 1×1 over each depth, a random window, a grouped one, and a deep one whose windows do
/// not fit in a cache at once.
pub(super) fn conv2d(case: &mut Case<'_>, number: u32) -> Outcome {
    let draw = &mut case.draw;
    let one = Window::square(1, 1, 0);
    let (window, shape, groups, outputs) = match number % 8 {
        _ if number % 500 == 499 => (Window::square(3, 1, 1), Shape::map(14, 13, 128), 1, 17),
        0..4 => {
            let depth = u16::try_from(number / 8 * 4 % DEPTHS + number % 8 + 1).ok()?;
            (one, Shape::map(draw.size(1, 4), draw.size(1, 7), depth), 1, draw.one_of(&OUTPUTS))
        }
        4 | 5 => {
            let shape = Shape::map(draw.size(1, 9), draw.size(1, 9), draw.size(1, 9));
            (random_window(draw), shape, 1, draw.one_of(&OUTPUTS))
        }
        6 => {
            let (groups, channels) = (draw.size(1, 4), draw.size(1, 6));
            let shape = Shape::map(draw.size(1, 8), draw.size(1, 8), groups * channels);
            (random_window(draw), shape, groups, groups * draw.one_of(&[1, 2, 16, 17, 32]))
        }
        _ => {
            let channels = draw.size(1, 40);
            (random_window(draw), Shape::map(draw.size(1, 7), draw.size(1, 7), channels), channels, channels)
        }
    };
    let Some((height, width)) = window.output_size(shape.height, shape.width) else { return Some(Ok(0)) };
    let output_shape = Shape::map(height, width, outputs);
    let kernel = draw.pick(case.kernels.supported())?;
    let taps = usize::from(window.kernel_h) * usize::from(window.kernel_w);
    let depth = taps * usize::from(shape.channels.checked_div(groups)?);
    let weights = packed(draw, kernel, groups, outputs.checked_div(groups)?, depth)?;
    let output = draw.element();
    let (rescale, stored) = rescale(draw, output, outputs, output_shape.positions(), 7, depth)?;
    let args = Conv2dArgs {
        input_shape: shape,
        output_shape,
        window,
        groups,
        kernel,
        weights,
        padding_codes: draw.values(shape.channels.into(), -128, 127)?,
        rescale,
    };
    let Codes::I8(input) = draw.map(ElementType::I8, shape)?.codes()? else { return None };
    let scratch = draw.scratch(plan::conv2d_scratch_bytes(kernel, shape, output_shape, window, groups))?;
    case.describe(format_args!("{kernel:?} {shape:?} to {output:?} {output_shape:?}, {window:?}, {groups} groups"));
    let elements = usize::try_from(output_shape.elements()).ok()?;
    case.compare(stored, elements, |kernels, output| kernels.conv2d(&args, input, output, scratch))
}

/// Kernels may be larger than the map; padding may be larger than the kernel.
fn random_window(draw: &mut Draw<'_>) -> Window {
    Window {
        kernel_h: draw.byte(1, 4),
        kernel_w: draw.byte(1, 4),
        stride_h: draw.byte(1, 3),
        stride_w: draw.byte(1, 3),
        pad_top: draw.byte(0, 3),
        pad_bottom: draw.byte(0, 3),
        pad_left: draw.byte(0, 3),
        pad_right: draw.byte(0, 3),
        dilation_h: draw.byte(1, 2),
        dilation_w: draw.byte(1, 2),
    }
}

/// A linear layer of each depth, with narrow and wide input and accumulators.
pub(super) fn linear(case: &mut Case<'_>, number: u32) -> Outcome {
    let draw = &mut case.draw;
    let inputs = u16::try_from(number % DEPTHS + 1).ok()?;
    let (positions, outputs) = (u32::from(draw.size(1, 20)), draw.one_of(&OUTPUTS));
    let (input, output, wide) = (draw.element(), draw.element(), draw.flag());
    let kernel = draw.pick(case.kernels.supported())?;
    let weights = packed(draw, kernel, 1, outputs, inputs.into())?;
    let (rescale, stored) = rescale(draw, output, outputs, positions, code_bits(input), inputs.into())?;
    let args = LinearArgs { positions, inputs, outputs, kernel, weights, wide, rescale };
    let codes = draw.codes(input, index(positions) * usize::from(inputs))?.codes()?;
    let scratch = draw.scratch(plan::linear_scratch_bytes(kernel, positions, inputs, input))?;
    case.describe(format_args!(
        "{kernel:?} {positions} rows of {input:?} {inputs} to {output:?} {outputs}, wide: {wide}"
    ));
    let elements = index(positions) * usize::from(outputs);
    case.compare(stored, elements, |kernels, output| kernels.linear(&args, codes, output, scratch))
}

/// Random weights in the order of a kernel.
fn packed<'m>(draw: &mut Draw<'m>, kernel: KernelId, groups: u16, outputs: u16, depth: usize) -> Option<&'m [i8]> {
    let weights = draw.values::<i8>(usize::from(groups) * usize::from(outputs) * depth, -127, 127)?;
    match kernel {
        KernelId::Direct => Some(weights),
        KernelId::K4N16 => {
            let packed = draw.take::<i8>(usize::try_from(k4n16::packed_bytes(groups, outputs, depth as u64)).ok()?)?;
            packed.fill(0);
            k4n16::pack(weights, outputs, depth, packed);
            Some(packed)
        }
    }
}

/// An epilogue for sums of `depth` products of `input_bits`-digit codes, and the output buffer before the step.
fn rescale<'m>(
    draw: &mut Draw<'m>,
    output: ElementType,
    outputs: u16,
    positions: u32,
    input_bits: u32,
    depth: usize,
) -> Option<(RescaleArgs<'m>, Buffer<'m>)> {
    let channels = usize::from(outputs);
    let elements = index(positions) * channels;
    let (in_place, kind) = (draw.flag(), draw.range(0, 2));
    let stored = draw.codes(output, elements)?;
    // The digits that random sums have; extreme ones have more and meet the clamp.
    let bits = input_bits + 6 + (usize::BITS - depth.leading_zeros()) / 2;
    let pre_shift = draw.byte(0, 3).into();
    let shift = i64::from(23 + bits) - i64::from(code_bits(output)) - i64::from(pre_shift);
    let element = if kind == 2 || in_place { output } else { draw.element() };
    let codes = if in_place || kind == 0 { None } else { Some(draw.codes(element, elements)?.codes()?) };
    let residual = match kind {
        0 => ResidualArgs::None,
        1 => {
            let multipliers = draw.values(channels, 1, 1 << 24)?;
            ResidualArgs::Scaled { codes, zero_point: draw.zero_point(element), multipliers }
        }
        _ => ResidualArgs::Stream { codes },
    };
    let rescale = RescaleArgs {
        pre_shift,
        bias: draw.values(channels, -(1 << 20), 1 << 20)?,
        multipliers: draw.values(channels, 1 << 23, (1 << 24) - 1)?,
        shifts: draw.values(channels, (shift - 2).clamp(1, 40), (shift + 2).clamp(1, 40))?,
        zero_point: draw.zero_point(output),
        clamp: draw.clamp(output),
        residual,
    };
    Some((rescale, stored))
}
