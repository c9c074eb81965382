//! Operators on tokens, the softmaxes, the sigmoid and the waypoint decoder. Tables fall and rise like the functions
//! that they stand for, but are straight lines: a backend must read them, not know them.

use super::draw::Draw;
use super::{Case, Outcome};
use crate::fixed_point::{EXP_TABLE_LEN, TANH_TABLE_LEN};
use crate::kernels::{
    AttentionArgs, Kernels, LayerNormArgs, Portable, SigmoidArgs, SoftmaxArgs, SpatialSoftmaxArgs, TokenSourceArgs,
    TokensArgs, WaypointDecoderArgs, plan,
};
use crate::program::Requant;
use crate::tensor::{Codes, CodesMut, ElementType, Shape, index};

/// Two maps of any grids.
pub(super) fn tokens(case: &mut Case<'_>, number: u32) -> Outcome {
    let draw = &mut case.draw;
    let channels = u16::try_from(number % 70 + 1).ok()?;
    let [first, second] = [(); 2].map(|()| {
        let [height, width] = [draw.size(1, 4), draw.size(1, 4)];
        let pool = [draw.byte(1, 4), draw.byte(1, 8)];
        let shape = Shape::map(height * u16::from(pool[0]), width * u16::from(pool[1]), channels);
        let element = draw.element();
        let codes = draw.map(element, shape)?.codes()?;
        let (zero_point, multiplier) = (draw.zero_point(element), draw.word(1, 1 << 24));
        Some((TokenSourceArgs { codes, shape, zero_point, pool, multiplier }, height * width))
    });
    let ((first, first_tokens), (second, second_tokens)) = (first?, second?);
    let output = draw.element();
    let elements = usize::from(first_tokens + second_tokens) * usize::from(channels);
    let args = TokensArgs {
        sources: [first, second],
        velocity: draw.half_word(i16::MIN, i16::MAX),
        velocity_multipliers: draw.values(channels.into(), -(1 << 24), 1 << 24)?,
        position: draw.values(elements, i16::MIN.into(), i16::MAX.into())?,
        sum: draw.sum(output, (16, 40)),
    };
    let stored = draw.codes(output, elements)?;
    let shapes = args.sources.map(|source| (source.shape, source.pool));
    case.describe(format_args!("{shapes:?} to {output:?}"));
    case.compare(stored, elements, |kernels, output| kernels.tokens(&args, output))
}

/// Every channel count to 200, and the largest.
pub(super) fn layer_norm(case: &mut Case<'_>, number: u32) -> Outcome {
    let draw = &mut case.draw;
    let channels = if number % 20 == 19 { 1024 } else { u16::try_from(number % 200 + 1).ok()? };
    let (rows, input, output) = (u32::from(draw.size(1, 4)), draw.element(), draw.element());
    let elements = index(rows) * usize::from(channels);
    let shift = draw.byte(20, 30);
    let args = LayerNormArgs {
        rows,
        channels,
        epsilon: draw.one_of(&[1, 5, 1 << 30]),
        gains: draw.values(channels.into(), -(1 << (shift - 6)), 1 << (shift - 6))?,
        offsets: draw.values(channels.into(), -(1 << (shift + 7)), 1 << (shift + 7))?,
        sum: draw.sum(output, (shift, shift)),
    };
    let codes = match draw.range(0, 3) {
        // Rows of nearly equal values have the smallest variance.
        0 => Codes::I16(draw.values(elements, 1000, 1003)?),
        _ => draw.codes(input, elements)?.codes()?,
    };
    let stored = draw.codes(output, elements)?;
    case.describe(format_args!("{rows} rows of {channels} channels to {output:?}"));
    case.compare(stored, elements, |kernels, output| kernels.layer_norm(&args, codes, output))
}

/// Queries apart and in place; tokens and head widths around vectors, and the largest of each.
pub(super) fn attention(case: &mut Case<'_>, number: u32) -> Outcome {
    let draw = &mut case.draw;
    let (tokens, heads, width) = match number {
        0 => (512, 1, 3),
        1 => (3, 1, 512),
        _ => (u32::from(draw.size(1, 70)), draw.size(1, 4), u16::try_from(number % 70 + 1).ok()?),
    };
    let (channels, output) = (heads * width, draw.element());
    let elements = index(tokens) * usize::from(channels);
    let exp_table = exp_table(draw)?;
    let requant = draw.requant_args(ElementType::I16, 19, output);
    let args = AttentionArgs {
        tokens,
        channels,
        heads,
        exponent: Requant { multiplier: draw.multiplier(), shift: draw.byte(16, 28) },
        exp_table,
        requant,
    };
    let mut codes = || draw.values::<i8>(elements, -127, 127);
    let (query, key, value) = (codes()?, codes()?, codes()?);
    let in_place = output == ElementType::I8 && draw.flag();
    let scratch = draw.scratch(plan::attention_scratch_bytes(tokens, channels, heads))?;
    let mut stored = draw.codes(output, elements)?;
    if in_place && let CodesMut::I8(stored) = stored.codes_mut()? {
        stored.copy_from_slice(query);
    }
    case.describe(format_args!("{tokens} tokens, {heads} heads of {width}, to {output:?}, in place: {in_place}"));
    let query = (!in_place).then_some(&*query);
    case.compare(stored, elements, |kernels, output| kernels.attention(&args, query, key, value, output, scratch))
}

/// A line from 1 to one half, Q15.
fn exp_table<'m>(draw: &mut Draw<'m>) -> Option<&'m [i16]> {
    let table = draw.take::<i16>(EXP_TABLE_LEN)?;
    for (entry, k) in table.iter_mut().zip(0_i16..) {
        *entry = i16::MAX - 64 * k;
    }
    Some(table)
}

/// Logits apart and in place.
pub(super) fn softmax(case: &mut Case<'_>, number: u32) -> Outcome {
    let draw = &mut case.draw;
    let channels = if number % 100 == 99 { 1 << 15 } else { u16::try_from(number % 130 + 1).ok()? };
    let (positions, element) = (if channels < 1024 { draw.size(1, 5) } else { 1 }, draw.element());
    let elements = usize::from(positions) * usize::from(channels);
    let exponent = Requant { multiplier: draw.multiplier(), shift: draw.byte(8, 28) };
    let args = SoftmaxArgs { channels, exponent, exp_table: exp_table(draw)? };
    let codes = if draw.flag() { Some(draw.codes(element, elements)?.codes()?) } else { None };
    let stored = draw.codes(ElementType::I16, elements)?;
    case.describe(format_args!("{positions} rows of {channels}, {element:?}, in place: {}", codes.is_none()));
    case.compare(stored, elements, |kernels, output| {
        if let CodesMut::I16(output) = output {
            kernels.softmax(&args, codes, output);
        }
    })
}

/// Codes apart and in place.
pub(super) fn sigmoid(case: &mut Case<'_>, number: u32) -> Outcome {
    let draw = &mut case.draw;
    let (elements, element) = (index(number % 130 + 1), draw.element());
    let args = SigmoidArgs {
        input_zero_point: draw.zero_point(element),
        requant: Requant { multiplier: draw.multiplier(), shift: draw.byte(8, 30) },
        tanh_table: tanh_table(draw)?,
    };
    let codes = if draw.flag() { Some(draw.codes(element, elements)?.codes()?) } else { None };
    let stored = draw.codes(ElementType::I16, elements)?;
    case.describe(format_args!("{elements} elements, {element:?}, in place: {}", codes.is_none()));
    case.compare(stored, elements, |kernels, output| {
        if let CodesMut::I16(output) = output {
            kernels.sigmoid(&args, codes, output);
        }
    })
}

/// A line from 0 that ends at one, Q15.
fn tanh_table<'m>(draw: &mut Draw<'m>) -> Option<&'m [i16]> {
    let table = draw.take::<i16>(TANH_TABLE_LEN)?;
    for (entry, k) in table.iter_mut().zip(0_i16..) {
        *entry = k.saturating_mul(256);
    }
    Some(table)
}

/// Small maps, and the longest row and column.
pub(super) fn spatial_softmax(case: &mut Case<'_>, number: u32) -> Outcome {
    let draw = &mut case.draw;
    let channels = u16::try_from(number % 9 + 1).ok()?;
    let shape = match number % 50 {
        0 => Shape::map(256, 2, channels),
        1 => Shape::map(2, 256, channels),
        _ => Shape::map(draw.size(1, 20), draw.size(1, 20), channels),
    };
    let exponent = Requant { multiplier: draw.multiplier(), shift: draw.byte(8, 36) };
    let args = SpatialSoftmaxArgs { shape, exponent, exp_table: exp_table(draw)? };
    let logits: &[i16] = draw.values(usize::try_from(shape.elements()).ok()?, i16::MIN.into(), i16::MAX.into())?;
    case.describe(format_args!("{shape:?}"));
    let (mut expected, mut found) = ([0x5555; 18], [0x5555; 18]);
    let points = 2 * usize::from(channels);
    Portable.spatial_softmax(&args, logits, expected.get_mut(..points)?);
    case.kernels.spatial_softmax(&args, logits, found.get_mut(..points)?);
    case.judge(&found, &expected, points)
}

/// Both forms of the goal.
pub(super) fn waypoint_decoder(case: &mut Case<'_>, number: u32) -> Outcome {
    let draw = &mut case.draw;
    let hidden_size = u16::try_from(number % 70 + 1).ok()?;
    let (size, concat) = (usize::from(hidden_size), draw.flag());
    let inputs = if concat { 4 } else { 2 };
    let tanh_table = tanh_table(draw)?;
    let args = WaypointDecoderArgs {
        hidden_size,
        steps: 4,
        hidden_fraction_bits: draw.byte(0, 15).into(),
        concat,
        input_weights: draw.values(3 * size * inputs, -32767, 32767)?,
        hidden_weights: draw.values(3 * size * size, -32767, 32767)?,
        input_pre_shift: draw.byte(0, 4).into(),
        hidden_pre_shift: draw.byte(0, 8).into(),
        input_multipliers: draw.values(3 * size, 1, 1 << 8)?,
        hidden_multipliers: draw.values(3 * size, 1, 1 << 8)?,
        shifts: draw.values(3 * size, 24, 30)?,
        biases: draw.values(4 * size, -(1 << 40), 1 << 40)?,
        output_weights: draw.values(2 * size, -32767, 32767)?,
        output_bias: draw.values(2, -(1 << 30), 1 << 30)?,
        output_pre_shift: 8,
        output_requant: [(); 2].map(|()| Requant { multiplier: draw.multiplier(), shift: draw.byte(28, 36) }),
        tanh_table,
    };
    let hidden: &[i16] = draw.values(size, i16::MIN.into(), i16::MAX.into())?;
    let goal: &[i32] = draw.values(2, -(1 << 24), 1 << 24)?;
    let scratch = draw.scratch(plan::waypoint_decoder_scratch_bytes(hidden_size))?;
    case.describe(format_args!("hidden state of {hidden_size}, concatenated goal: {concat}"));
    let (mut expected, mut found) = ([0x5555; 8], [0x5555; 8]);
    Portable.waypoint_decoder(&args, hidden, goal, &mut expected, scratch);
    case.kernels.waypoint_decoder(&args, hidden, goal, &mut found, scratch);
    case.judge(&found, &expected, expected.len())
}
