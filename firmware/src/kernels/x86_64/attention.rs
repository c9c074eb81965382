//! Attention for AVX2 and AVX-512: [`portable::attention`], four query rows at a time.

use super::pairs::{Matrix, Pair, PairProduct, ROWS};
use super::sums::Ending;
use super::{Avx2, Avx512Vnni};
use crate::fixed_point::{EXP_TABLE_LEN, EXPONENT_MAX, bits, saturate_i16, saturate_i32, saturate_i64};
use crate::kernels::AttentionArgs;
use crate::kernels::portable;
use crate::kernels::portable::codes::{Code, block, block_mut, widen};
use crate::program::Requant;
use crate::tensor::{CodesMut, index};

/// Most tokens, and widest head, of an image.
const MAX_LEN: usize = 512;

/// [`portable::attention::attention`] with AVX2. Uses none of `scratch` (where it does not fall back) but 84 KiB of the
/// stack, like [`avx512`].
#[target_feature(enable = "avx2")]
pub(super) fn avx2(
    token: Avx2,
    args: &AttentionArgs<'_>,
    query: Option<&[i8]>,
    key: &[i8],
    value: &[i8],
    output: CodesMut<'_>,
    scratch: &mut [u8],
) {
    attention(token, args, query, key, value, output, scratch);
}

/// [`portable::attention::attention`] with AVX-512.
#[target_feature(enable = "avx512f,avx512bw,avx512dq,avx512vl,avx512vnni")]
pub(super) fn avx512(
    token: Avx512Vnni,
    args: &AttentionArgs<'_>,
    query: Option<&[i8]>,
    key: &[i8],
    value: &[i8],
    output: CodesMut<'_>,
    scratch: &mut [u8],
) {
    attention(token, args, query, key, value, output, scratch);
}

/// Heads whose keys or values do not fit a [`Matrix`] (of up to 128 tokens, those wider than 128) take the portable
/// kernel, as do operands of lengths that no image has.
#[inline(always)]
fn attention(
    product: impl PairProduct,
    args: &AttentionArgs<'_>,
    query: Option<&[i8]>,
    key: &[i8],
    value: &[i8],
    output: CodesMut<'_>,
    scratch: &mut [u8],
) {
    let output_len = match &output {
        CodesMut::I8(output) => output.len(),
        CodesMut::I16(output) => output.len(),
    };
    let (tokens, size) = (index(args.tokens), usize::from(args.channels.checked_div(args.heads).unwrap_or_default()));
    let whole = size * usize::from(args.heads) == usize::from(args.channels)
        && [query.unwrap_or(key), key, value].iter().all(|codes| codes.len() == output_len)
        && tokens.checked_mul(args.channels.into()) == Some(output_len);
    let small = (1..=MAX_LEN).contains(&tokens)
        && (1..=MAX_LEN).contains(&size)
        && Matrix::holds(size, tokens)
        && Matrix::holds(tokens, size);
    match (output, Exponential::new(args)) {
        (CodesMut::I8(output), Some(exponential)) if whole && small => {
            run(product, args, &exponential, query, key, value, output);
        }
        (CodesMut::I16(output), Some(exponential)) if whole && small && query.is_some() => {
            run(product, args, &exponential, query, key, value, output);
        }
        (output, _) => portable::attention::attention(args, query, key, value, output, scratch),
    }
}

#[inline(always)]
fn run<T: Code>(
    product: impl PairProduct,
    args: &AttentionArgs<'_>,
    exponential: &Exponential,
    query: Option<&[i8]>,
    key: &[i8],
    value: &[i8],
    output: &mut [T],
) {
    let (tokens, channels, heads) = (index(args.tokens), usize::from(args.channels), usize::from(args.heads));
    let size = channels / heads;
    let ending = Ending::of_requant(&args.requant);
    let (mut keys, mut values) = (Matrix::new(size), Matrix::new(tokens));
    let mut queries = [[0; MAX_LEN]; ROWS];
    let mut weights = [[0; MAX_LEN]; ROWS];
    // `a_j` of every token, then `A_t` of every channel.
    let mut sums = [[0; MAX_LEN]; ROWS];
    for head in 0..heads {
        let of_head = |codes, token: usize| block(codes, token * heads + head, size).unwrap_or_default();
        for token in 0..tokens {
            keys.set_column(token, of_head(key, token));
        }
        for first in (0..tokens).step_by(2) {
            let second = if first + 1 < tokens { of_head(value, first + 1) } else { &[] };
            values.set_rows(first / 2, of_head(value, first), second);
        }
        for (group, output) in output.chunks_mut(ROWS * channels).enumerate() {
            let rows = output.len() / channels;
            for (row, widened) in queries.iter_mut().enumerate().take(rows) {
                match query {
                    Some(query) => widen(of_head(query, group * ROWS + row), widened),
                    None => widen(block(output, row * heads + head, size).unwrap_or_default(), widened),
                }
            }
            keys.multiply(product, &queries, tokens, &mut sums);
            let mut totals = [0; ROWS];
            for ((total, logits), weights) in totals.iter_mut().zip(&mut sums).zip(&mut weights) {
                *total = exponential.apply(logits.get_mut(..tokens).unwrap_or_default(), weights);
            }
            values.multiply(product, &weights, size, &mut sums);
            for (row, (total, context)) in totals.into_iter().zip(&sums).enumerate().take(rows) {
                write(args, ending, total, context, block_mut(output, row * heads + head, size).unwrap_or_default());
            }
        }
    }
}

/// Writes `ctx_t = clamp(z_o + R(R(A_t·R_s, c + 10)·M, n))` with `c = bits(S)`, `R_s = floor(2^(c+22)/S)`.
#[inline(always)]
fn write<T: Code>(args: &AttentionArgs<'_>, ending: Ending, sum: i32, context: &[i32], codes: &mut [T]) {
    let digits = bits(sum.into());
    let numerator = 1_u64 << (digits + 22).min(63);
    let reciprocal = saturate_i64(numerator.checked_div(sum.max(0).unsigned_abs().into()).unwrap_or(0));
    let (shift, half) = (digits + 10, 1_i64 << (digits + 9));
    for (code, context) in codes.iter_mut().zip(context) {
        let t = i64::from(*context).wrapping_mul(reciprocal).wrapping_add(half) >> shift;
        *code = ending.code(t.wrapping_mul(args.requant.requant.multiplier.into()));
    }
}

/// From the logits of a row to `e_j`.
struct Exponential {
    exponent: Requant,
    /// `(T[k], T[k+1])`.
    table: [Pair; EXP_TABLE_LEN - 1],
}

impl Exponential {
    #[inline(always)]
    fn new(args: &AttentionArgs<'_>) -> Option<Self> {
        let entries: &[i16; EXP_TABLE_LEN] = args.exp_table.first_chunk()?;
        let mut table = [[0; 2]; EXP_TABLE_LEN - 1];
        for (pair, neighbors) in table.iter_mut().zip(entries.array_windows()) {
            *pair = *neighbors;
        }
        Some(Self { exponent: args.exponent, table })
    }

    /// `e_j` of every logit `a_j`, and their sum S; see [`crate::fixed_point::exp2_q15`]. Spoils the logits.
    #[inline(always)]
    fn apply(&self, logits: &mut [i32], weights: &mut [i16]) -> i32 {
        let peak = logits.iter().copied().max().unwrap_or(0);
        let shift = u32::from(self.exponent.shift).min(62);
        let half = (1_i64 << shift) >> 1;
        for logit in &mut *logits {
            let distance = i64::from(peak.wrapping_sub(*logit)).wrapping_mul(self.exponent.multiplier.into());
            *logit = saturate_i32((distance.wrapping_add(half) >> shift).clamp(0, EXPONENT_MAX));
        }
        let mut sum = 0_i32;
        for (e, exponent) in weights.iter_mut().zip(logits) {
            let [fraction, k, whole, _] = exponent.to_le_bytes();
            let [here, next] = self.table[usize::from(k)].map(i32::from);
            let value = (here << 8).wrapping_sub((here - next).wrapping_mul(fraction.into()));
            let shift = 8 + u32::from(whole).min(23);
            let rounded = value.wrapping_add(1 << (shift - 1)) >> shift;
            *e = saturate_i16(rounded.into());
            sum = sum.wrapping_add(rounded);
        }
        sum
    }
}

#[cfg(test)]
mod tests {
    extern crate std;
    use super::super::testing::{for_backends, requant};
    use crate::kernels::plan::attention_scratch_bytes;
    use crate::kernels::portable::oracle::{Rng, Scratch, exp_table};
    use crate::kernels::{AttentionArgs, Kernels, Portable, RequantArgs};
    use crate::program::Requant;
    use crate::tensor::{CodesMut, ElementType};

    fn check(kernels: &dyn Kernels, rng: &mut Rng, tokens: u32, heads: u16, size: u16) {
        let channels = heads * size;
        let count = tokens as usize * usize::from(channels);
        // One in four of few different codes, so that many keys are close to the largest logit.
        let range = if rng.next().is_multiple_of(4) { 3 } else { 127 };
        let [query, key, value] = [(); 3].map(|()| rng.values::<i8>(count, -range - 1, range));
        let to = rng.element_type();
        let mut table = exp_table();
        if rng.next().is_multiple_of(8) {
            table.fill_with(|| rng.range(i16::MIN.into(), i16::MAX.into()) as i16);
        }
        let exponent = match rng.next() % 8 {
            0 => Requant { multiplier: i32::MIN, shift: rng.range(0, 255) as u8 },
            1 => Requant { multiplier: i32::MAX, shift: rng.range(0, 255) as u8 },
            _ => Requant { multiplier: rng.multiplier(), shift: rng.range(10, 28) as u8 },
        };
        let args = AttentionArgs {
            tokens,
            channels,
            heads,
            exponent,
            exp_table: &table,
            requant: RequantArgs { input_zero_point: 0, ..requant(rng, ElementType::I8, 19, to) },
        };
        let what = std::format!("{tokens} tokens, {heads} heads of {size}, {exponent:?}");
        let mut scratch = Scratch::new(attention_scratch_bytes(tokens, channels, heads));
        let mut expected = rng.buffer(to, count);
        let mut output = expected.clone();
        Portable.attention(&args, Some(&query), &key, &value, expected.codes_mut(), scratch.bytes());
        kernels.attention(&args, Some(&query), &key, &value, output.codes_mut(), scratch.bytes());
        assert_eq!(output, expected, "{what}");
        let (mut expected, mut output) = (query.clone(), query);
        Portable.attention(&args, None, &key, &value, CodesMut::I8(&mut expected), scratch.bytes());
        kernels.attention(&args, None, &key, &value, CodesMut::I8(&mut output), scratch.bytes());
        assert_eq!(output, expected, "{what}, in place");
    }

    #[test]
    fn equals_portable_apart_and_in_place() {
        for_backends(300, |kernels, rng| {
            let (tokens, heads, size) = (rng.range(1, 40) as u32, rng.range(1, 4) as u16, rng.range(1, 40) as u16);
            check(kernels, rng, tokens, heads, size);
        });
    }

    #[test]
    fn equals_portable_at_transfusers_sizes_and_where_a_head_does_not_fit() {
        for_backends(2, |kernels, rng| {
            for (tokens, heads, size) in
                [(128, 4, 16), (128, 4, 128), (127, 1, 127), (129, 1, 128), (512, 1, 32), (512, 1, 33), (3, 1, 512)]
            {
                check(kernels, rng, tokens, heads, size);
            }
        });
    }

    #[test]
    fn hostile_lengths_give_what_portable_gives() {
        for_backends(1, |kernels, rng| {
            let table = exp_table();
            let codes = [-128, 127, -128, 127, -128, 127];
            let args = AttentionArgs {
                tokens: 2,
                channels: 3,
                heads: 1,
                exponent: Requant { multiplier: 1 << 23, shift: 20 },
                exp_table: &table,
                requant: requant(rng, ElementType::I8, 19, ElementType::I8),
            };
            for args in [
                args,
                AttentionArgs { heads: 0, ..args },
                AttentionArgs { heads: 2, ..args },
                AttentionArgs { heads: 7, ..args },
                AttentionArgs { channels: 0, ..args },
                AttentionArgs { tokens: 0, ..args },
                AttentionArgs { tokens: 3, ..args },
                AttentionArgs { tokens: u32::MAX, ..args },
                AttentionArgs { exp_table: &[], ..args },
            ] {
                for (value, len) in [(&codes[..], 6), (&codes[..5], 6), (&codes[..], 5)] {
                    let mut scratch = Scratch::new(256);
                    let (mut expected, mut output) = ([9_i16; 6], [9_i16; 6]);
                    let portable = CodesMut::I16(&mut expected[..len]);
                    Portable.attention(&args, None, &codes, value, portable, scratch.bytes());
                    kernels.attention(&args, None, &codes, value, CodesMut::I16(&mut output[..len]), scratch.bytes());
                    assert_eq!(output, expected, "{args:?}");
                    let (mut expected, mut output) = ([9_i8; 6], [9_i8; 6]);
                    let portable = CodesMut::I8(&mut expected[..len]);
                    Portable.attention(&args, None, &codes, value, portable, scratch.bytes());
                    kernels.attention(&args, None, &codes, value, CodesMut::I8(&mut output[..len]), scratch.bytes());
                    assert_eq!(output, expected, "{args:?}");
                }
            }
        });
    }
}
