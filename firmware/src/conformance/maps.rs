//! Operators on maps: pools, sums, changes of scale, resize, copies.

use super::draw::Draw;
use super::{Case, Outcome, code_bits};
use crate::kernels::{ConcatSourceArgs, CopyBoxArgs, GatherSumArgs, PoolArgs, RequantArgs, ResizeArgs, TermArgs, plan};
use crate::program::{Axis, Requant, Window};
use crate::tensor::{ElementType, Shape, index};

/// Channels on both sides of what kernels take at once.
const CHANNELS: [u16; 14] = [1, 2, 3, 7, 8, 15, 16, 17, 31, 32, 33, 64, 65, 130];

/// A pool with kernels up to 4; padding stays inside the kernel.
fn pool(draw: &mut Draw<'_>, padded: bool) -> Option<PoolArgs> {
    let input_shape = Shape::map(draw.size(1, 9), draw.size(1, 9), draw.one_of(&CHANNELS));
    let (kernel_h, kernel_w) = (draw.byte(1, 4), draw.byte(1, 4));
    let mut pad = |kernel: u8| if padded { draw.byte(0, kernel - 1) } else { 0 };
    let (pad_top, pad_bottom, pad_left, pad_right) = (pad(kernel_h), pad(kernel_h), pad(kernel_w), pad(kernel_w));
    let window = Window {
        kernel_h,
        kernel_w,
        stride_h: draw.byte(1, 3),
        stride_w: draw.byte(1, 3),
        pad_top,
        pad_bottom,
        pad_left,
        pad_right,
        dilation_h: 1,
        dilation_w: 1,
    };
    let (height, width) = window.output_size(input_shape.height, input_shape.width)?;
    Some(PoolArgs { input_shape, output_shape: Shape::map(height, width, input_shape.channels), window })
}

/// Apart, and in place where that is right.
pub(super) fn max_pool(case: &mut Case<'_>, _: u32) -> Outcome {
    let Some(args) = pool(&mut case.draw, true) else { return Some(Ok(0)) };
    let element = case.draw.element();
    let in_place = plan::max_pool_in_place(args.input_shape, args.output_shape, args.window) && case.draw.flag();
    let input = case.draw.map(element, args.input_shape)?;
    case.describe(format_args!("{element:?} {args:?}, in place: {in_place}"));
    let elements = usize::try_from(args.output_shape.elements()).ok()?;
    if in_place {
        return case.compare(input, elements, |kernels, output| kernels.max_pool(&args, None, output));
    }
    let (codes, stored) = (input.codes()?, case.draw.map(element, args.output_shape)?);
    case.compare(stored, elements, |kernels, output| kernels.max_pool(&args, Some(codes), output))
}

pub(super) fn average_pool(case: &mut Case<'_>, _: u32) -> Outcome {
    let Some(args) = pool(&mut case.draw, false) else { return Some(Ok(0)) };
    let draw = &mut case.draw;
    let (input, output) = (draw.element(), draw.element());
    let requant = draw.requant_args(input, code_bits(input) + 2, output);
    let (codes, stored) = (draw.map(input, args.input_shape)?.codes()?, draw.map(output, args.output_shape)?);
    case.describe(format_args!("{input:?} {args:?} to {output:?}"));
    let elements = usize::try_from(args.output_shape.elements()).ok()?;
    case.compare(stored, elements, |kernels, output| kernels.average_pool(&args, &requant, codes, output))
}

/// One or two maps.
pub(super) fn global_pool(case: &mut Case<'_>, _: u32) -> Outcome {
    let draw = &mut case.draw;
    let (channels, output) = (draw.one_of(&CHANNELS), draw.element());
    let positions = [draw.size(1, 70), draw.size(1, 70)];
    let [first, second] = positions.map(|positions| {
        let element = draw.element();
        let codes = draw.codes(element, usize::from(positions) * usize::from(channels))?.codes()?;
        Some(TermArgs { codes: Some(codes), zero_point: draw.zero_point(element), multiplier: draw.word(1, 1 << 24) })
    });
    let terms = [first?, second?];
    let count = if draw.flag() { 1 } else { 2 };
    let sum = draw.sum(output, (24, 40));
    let stored = draw.codes(output, channels.into())?;
    case.describe(format_args!("{count} maps of {positions:?} positions, {channels} channels, to {output:?}"));
    case.compare(stored, channels.into(), |kernels, output| {
        kernels.global_pool(channels, &sum, terms.get(..count).unwrap_or_default(), output);
    })
}

/// Every length; each operand apart or in place.
pub(super) fn add(case: &mut Case<'_>, number: u32) -> Outcome {
    let draw = &mut case.draw;
    let (len, output) = (index(number % 200) + 1, draw.element());
    let [first, second] = [(); 2].map(|()| {
        let in_place = draw.flag();
        let element = if in_place { output } else { draw.element() };
        let codes = if in_place { None } else { Some(draw.codes(element, len)?.codes()?) };
        Some(TermArgs { codes, zero_point: draw.zero_point(element), multiplier: draw.word(1, i32::MAX) })
    });
    let terms = [first?, second?];
    let sum = draw.sum(output, (24, 40));
    let stored = draw.codes(output, len)?;
    let in_place = terms.map(|term| term.codes.is_none());
    case.describe(format_args!("{len} elements to {output:?}, in place: {in_place:?}"));
    case.compare(stored, len, |kernels, output| kernels.add(&sum, &terms, output))
}

/// Every length.
pub(super) fn requantize(case: &mut Case<'_>, number: u32) -> Outcome {
    let draw = &mut case.draw;
    let (len, input, output) = (index(number % 200) + 1, draw.element(), draw.element());
    let args = draw.requant_args(input, code_bits(input), output);
    let (codes, stored) = (draw.codes(input, len)?.codes()?, draw.codes(output, len)?);
    case.describe(format_args!("{len} elements of {input:?} to {output:?}"));
    case.compare(stored, len, |kernels, output| kernels.requantize(&args, codes, output))
}

/// Whole factors; with a residual apart, in place, or none.
pub(super) fn resize_bilinear(case: &mut Case<'_>, _: u32) -> Outcome {
    let draw = &mut case.draw;
    let (factor_h, factor_w) = (draw.one_of(&[1, 2, 3, 4, 8]), draw.one_of(&[1, 2, 3, 4, 5, 8]));
    let weight_bits = draw.one_of(&[4, 11]);
    let input_shape = Shape::map(draw.size(1, 5), draw.size(1, 5), draw.one_of(&CHANNELS));
    let output_shape =
        Shape { height: input_shape.height * factor_h, width: input_shape.width * factor_w, ..input_shape };
    let (input, output, in_place) = (draw.element(), draw.element(), draw.flag());
    let multiplier = draw.word(1, 1 << if input == ElementType::I8 { 24 } else { 16 });
    let codes = Some(draw.map(input, input_shape)?.codes()?);
    let term = TermArgs { codes, zero_point: draw.zero_point(input), multiplier };
    let residual = if draw.flag() {
        let element = if in_place { output } else { draw.element() };
        let codes = if in_place { None } else { Some(draw.map(element, output_shape)?.codes()?) };
        Some(TermArgs { codes, zero_point: draw.zero_point(element), multiplier: draw.word(1, 1 << 24) })
    } else {
        None
    };
    let args = ResizeArgs {
        input_shape,
        output_shape,
        input: term,
        residual,
        rows: axis(draw, input_shape.height, factor_h, weight_bits)?,
        columns: axis(draw, input_shape.width, factor_w, weight_bits)?,
        weight_bits,
        sum: draw.sum(output, (24, 36)),
    };
    let stored = draw.map(output, output_shape)?;
    let kind = residual.map(|term| if term.codes.is_none() { "in place" } else { "apart" });
    case.describe(format_args!("{input:?} {input_shape:?} to {output:?} {output_shape:?}, residual: {kind:?}"));
    let elements = usize::try_from(output_shape.elements()).ok()?;
    case.compare(stored, elements, |kernels, output| kernels.resize_bilinear(&args, output))
}

/// A strided box inside a border.
pub(super) fn copy_box(case: &mut Case<'_>, _: u32) -> Outcome {
    let draw = &mut case.draw;
    let element = draw.element();
    let mut axis = |longest: u16| {
        let (begin, stride, size) = (draw.size(0, 3), draw.size(1, 3), draw.size(1, longest));
        let (before, behind) = (draw.size(0, 2), draw.size(0, 2));
        let input = begin + (size - 1) * stride + 1 + behind;
        (begin, stride, size, before, input, before + size + behind)
    };
    let axes = [axis(6), axis(6), axis(70)];
    let shape = |sizes: [u16; 3]| Shape::map(sizes[0], sizes[1], sizes[2]);
    let args = CopyBoxArgs {
        input_shape: shape(axes.map(|axis| axis.4)),
        output_shape: shape(axes.map(|axis| axis.5)),
        begin: axes.map(|axis| axis.0),
        stride: axes.map(|axis| axis.1),
        size: axes.map(|axis| axis.2),
        before: axes.map(|axis| axis.3),
        border: draw.half_word(*element.codes().start(), *element.codes().end()),
    };
    let (codes, stored) = (draw.map(element, args.input_shape)?.codes()?, draw.map(element, args.output_shape)?);
    case.describe(format_args!("{element:?} {args:?}"));
    let elements = usize::try_from(args.output_shape.elements()).ok()?;
    case.compare(stored, elements, |kernels, output| kernels.copy_box(&args, codes, output))
}

/// Each axis; sources of their own scales, or of the output's.
pub(super) fn concat(case: &mut Case<'_>, _: u32) -> Outcome {
    let draw = &mut case.draw;
    let axis = draw.pick(&[Axis::Height, Axis::Width, Axis::Channels])?;
    let (output, shape) = (draw.element(), Shape::map(draw.size(1, 5), draw.size(1, 5), draw.one_of(&CHANNELS)));
    let (zero_point, clamp) = (draw.zero_point(output), draw.clamp(output));
    let [first, second] = [(); 2].map(|()| {
        let (element, size) = (draw.element(), draw.size(1, 20));
        let shape = match axis {
            Axis::Height => Shape { height: size, ..shape },
            Axis::Width => Shape { width: size, ..shape },
            Axis::Channels => Shape { channels: size, ..shape },
        };
        let own = draw.requant_args(element, code_bits(element), output);
        let copied = RequantArgs { input_zero_point: zero_point, requant: ONE, ..own };
        let requant = if element == output && draw.flag() { copied } else { own };
        let codes = draw.map(element, shape)?.codes()?;
        Some(ConcatSourceArgs { codes, shape, requant: RequantArgs { zero_point, clamp, ..requant } })
    });
    let sources = [first?, second?];
    let elements = usize::try_from(sources.iter().map(|source| source.shape.elements()).sum::<u64>()).ok()?;
    let stored = draw.codes(output, elements)?;
    case.describe(format_args!("{:?} along {axis:?}, to {output:?}", sources.map(|source| source.shape)));
    case.compare(stored, elements, |kernels, output| kernels.concat(axis, &sources, output))
}

/// Indices inside the map and outside of it.
pub(super) fn gather_sum(case: &mut Case<'_>, _: u32) -> Outcome {
    let draw = &mut case.draw;
    let channels = draw.one_of(&CHANNELS);
    let input_shape = Shape::map(draw.size(1, 9), draw.size(1, 9), channels);
    let output_shape = Shape::map(draw.size(1, 9), draw.size(1, 9), channels);
    let (cells, input, output) = (draw.size(1, 6), draw.element(), draw.element());
    let (low, high) = if draw.flag() { (0, 8) } else { (-128, 127) };
    let indices = draw.values(index(output_shape.positions()) * usize::from(cells) * 2, low, high)?;
    let requant = draw.requant_args(input, code_bits(input) + 2, output);
    let args = GatherSumArgs { input_shape, output_shape, indices, requant };
    let (codes, stored) = (draw.map(input, input_shape)?.codes()?, draw.map(output, output_shape)?);
    case.describe(format_args!("{cells} cells of {input:?} {input_shape:?} to {output:?} {output_shape:?}"));
    let elements = usize::try_from(output_shape.elements()).ok()?;
    case.compare(stored, elements, |kernels, output| kernels.gather_sum(&args, codes, output))
}

/// A factor of exactly one.
const ONE: Requant = Requant { multiplier: 1 << 23, shift: 23 };

/// `[i0, w1]` of half-pixel centers: `src = max((d + ½)·in/out − ½, 0)` in units of `1/(2·factor)`.
fn axis<'m>(draw: &mut Draw<'m>, size: u16, factor: u16, weight_bits: u32) -> Option<&'m [[u16; 2]]> {
    let lines = draw.take::<[u16; 2]>(usize::from(size) * usize::from(factor))?;
    let unit = 2 * u32::from(factor);
    for (d, line) in (0_u32..).zip(lines.iter_mut()) {
        let source = (2 * d + 1).saturating_sub(u32::from(factor));
        let first = (source / unit).min(u32::from(size) - 1);
        let weight = (((source - first * unit) << weight_bits) + unit / 2) / unit;
        *line = [u16::try_from(first).ok()?, u16::try_from(weight).ok()?];
    }
    Some(lines)
}
