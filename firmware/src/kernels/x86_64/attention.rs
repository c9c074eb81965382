//! Attention for AVX2 and AVX-512: [`portable::attention`], four query rows at a time.

use super::pairs::{Matrix, Pair, PairProduct, ROWS};
use super::sums::Ending;
use super::{Avx2, Avx512Vnni};
use crate::fixed_point::{EXP_TABLE_LEN, EXPONENT_MAX, bits, saturate_i16, saturate_i32, saturate_i64};
use crate::kernels::AttentionArgs;
use crate::kernels::portable;
use crate::kernels::portable::codes::{Code, block, block_mut};
use crate::program::Requant;
use crate::tensor::{CodesMut, index};

/// Most tokens, and widest head, of an image.
const MAX_LEN: usize = 512;

/// [`portable::attention::attention`] with AVX2. Uses none of `scratch` (where it does not fall back) but 88 KiB of the
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
    // Per pair of channels, then per pair of tokens: that of each row.
    let mut queries = [[[0; 2]; ROWS]; MAX_LEN / 2];
    let mut weights = [[[0; 2]; ROWS]; MAX_LEN / 2];
    // Per row: `a_j`, then `e_j`, of every token; then `A_t` of every channel.
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
            for row in 0..rows {
                match query {
                    Some(query) => set_row(&mut queries, row, of_head(query, group * ROWS + row)),
                    None => set_row(&mut queries, row, block(output, row * heads + head, size).unwrap_or_default()),
                }
            }
            keys.multiply(product, &queries, tokens, &mut sums);
            let mut totals = [0; ROWS];
            for (row, (total, logits)) in totals.iter_mut().zip(&mut sums).enumerate() {
                let logits = logits.get_mut(..tokens).unwrap_or_default();
                *total = exponential.apply(logits);
                set_row(&mut weights, row, logits);
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

    /// Replaces each `a_j` (below 2^24) by `e_j` and returns S; see [`crate::fixed_point::exp2_q15`].
    #[inline(always)]
    fn apply(&self, logits: &mut [i32]) -> i32 {
        let peak = logits.iter().copied().max().unwrap_or(0);
        let shift = u32::from(self.exponent.shift).min(62);
        let half = (1_i64 << shift) >> 1;
        for logit in &mut *logits {
            let distance = i64::from(peak.wrapping_sub(*logit)).wrapping_mul(self.exponent.multiplier.into());
            *logit = saturate_i32((distance.wrapping_add(half) >> shift).clamp(0, EXPONENT_MAX));
        }
        let mut sum = 0_i32;
        for e in logits {
            let [fraction, k, whole, _] = e.to_le_bytes();
            let [here, next] = self.table[usize::from(k)].map(i32::from);
            let value = (here << 8).wrapping_sub((here - next).wrapping_mul(fraction.into()));
            let shift = 8 + u32::from(whole).min(23);
            *e = value.wrapping_add(1 << (shift - 1)) >> shift;
            sum = sum.wrapping_add(*e);
        }
        sum
    }
}

/// Sets one of the rows that are multiplied at once to `values`, which fit 16 bits.
#[inline(always)]
fn set_row<T: Copy + Into<i32>>(pairs: &mut [[Pair; ROWS]], row: usize, values: &[T]) {
    let narrow = |value: T| saturate_i16(i64::from(value.into()));
    let (whole, rest) = values.as_chunks();
    let tail = rest.first().map(|last| [narrow(*last), 0]);
    let values = whole.iter().map(|pair: &[T; 2]| pair.map(narrow)).chain(tail);
    for (pairs, pair) in pairs.iter_mut().zip(values) {
        pairs[row] = pair;
    }
}
