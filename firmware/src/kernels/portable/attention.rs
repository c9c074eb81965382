//! Portable attention.

use super::codes::{Code, block, block_mut, take, widen};
use super::product::dot;
use crate::fault::{self, Fault};
use crate::fixed_point::{EXP_TABLE_LEN, bits, divide, exp2_q15, round_shift, saturate_i16, saturate_i64};
use crate::kernels::AttentionArgs;
use crate::tensor::{CodesMut, index};

/// Softmax attention of every query over all keys, per head and one query row at a time.
///
/// For query row q of a head: `a_j = Σ q·k_j`; `u_j = min(R((max(a) − a_j)·M_u, n_u), 31·2^16)`; `e_j = 2^(−u_j)`
/// ([`exp2_q15`]); `S = Σ e_j`, `c = bits(S)`, `R_s = floor(2^(c+22)/S)`; `A_t = Σ_j e_j·v_jt`;
/// `ctx_t = clamp(z_o + R(R(A_t·R_s, c + 10)·M, n))`.
///
/// `query`, `key`, `value`: i8 in [−127, 127], `tokens × C`; head h has channels `h·C/heads ..`. `output`: i8 or i16,
/// `tokens × C`, i8 where it holds the queries (a row of a head is written after its last use). `scratch`:
/// [`crate::kernels::plan::attention_scratch_bytes`], aligned to 4 bytes. Preconditions: tokens ≤ 512, C/heads ≤ 512.
pub fn attention(
    args: &AttentionArgs<'_>,
    query: Option<&[i8]>,
    key: &[i8],
    value: &[i8],
    output: CodesMut<'_>,
    scratch: &mut [u8],
) {
    match output {
        CodesMut::I8(output) => run(args, query, key, value, output, scratch),
        CodesMut::I16(output) => run(args, query, key, value, output, scratch),
    }
}

fn run<T: Code>(
    args: &AttentionArgs<'_>,
    query: Option<&[i8]>,
    key: &[i8],
    value: &[i8],
    output: &mut [T],
    scratch: &mut [u8],
) {
    let channels = usize::from(args.channels);
    let heads = usize::from(args.heads);
    let (Some(size), Some(table)) = (channels.checked_div(heads), args.exp_table.first_chunk()) else { return };
    let Some(mut row) = RowScratch::new(scratch, index(args.tokens), size) else { return };
    if channels == 0 || [query.unwrap_or(key), key, value].iter().any(|codes| codes.len() != output.len()) {
        return;
    }
    for (position, output_row) in output.chunks_exact_mut(channels).enumerate() {
        let query_row = query.and_then(|query| block(query, position, channels));
        for head in 0..heads {
            let Some(codes) = block_mut(output_row, head, size) else { continue };
            match query_row.and_then(|query| block(query, head, size)) {
                Some(query) => widen(query, row.query),
                None => widen(codes, row.query),
            }
            row.score(key, channels, head);
            let sum = row.exponentiate(args, table);
            row.mix(value, channels, head);
            row.write(args, sum, codes);
        }
    }
}

/// Working memory for one query row of one head.
struct RowScratch<'a> {
    /// Per key: the logit `a_j`, later `e_j`.
    keys: &'a mut [i32],
    /// Per channel of the head: `A_t`.
    context: &'a mut [i32],
    /// Per channel of the head: the query.
    query: &'a mut [i16],
}

impl<'a> RowScratch<'a> {
    fn new(mut scratch: &'a mut [u8], tokens: usize, size: usize) -> Option<Self> {
        Some(Self {
            keys: take(&mut scratch, tokens)?,
            context: take(&mut scratch, size)?,
            query: take(&mut scratch, size)?,
        })
    }

    /// `a_j = Σ q·k_j`.
    fn score(&mut self, key: &[i8], channels: usize, head: usize) {
        for (logit, key) in self.keys.iter_mut().zip(key.chunks_exact(channels)) {
            [*logit] = dot(block(key, head, self.query.len()).unwrap_or_default(), [&*self.query]);
        }
    }

    /// Replaces each `a_j` by `e_j` and returns S.
    fn exponentiate(&mut self, args: &AttentionArgs<'_>, table: &[i16; EXP_TABLE_LEN]) -> i64 {
        let considered = match &*self.keys {
            [keys @ .., _] if fault::active(Fault::SoftmaxMaximum) => keys,
            keys => keys,
        };
        let peak = i64::from(considered.iter().copied().max().unwrap_or(0));
        let mut sum = 0;
        for key in self.keys.iter_mut() {
            let distance = (peak - i64::from(*key)).wrapping_mul(i64::from(args.exponent.multiplier));
            let exponent = round_shift(distance, u32::from(args.exponent.shift));
            let e = exp2_q15(table, exponent);
            *key = i32::from(e);
            sum += i64::from(e);
        }
        sum
    }

    /// `A_t = Σ_j e_j·v_jt`.
    fn mix(&mut self, value: &[i8], channels: usize, head: usize) {
        self.context.fill(0);
        for (e, value) in self.keys.iter().zip(value.chunks_exact(channels)) {
            let e = saturate_i16(i64::from(*e));
            let value = block(value, head, self.context.len()).unwrap_or_default();
            for (sum, v) in self.context.iter_mut().zip(value) {
                *sum = sum.wrapping_add(i32::from(e) * i32::from(*v));
            }
        }
    }

    /// `ctx_t = clamp(z_o + R(R(A_t·R_s, c + 10)·M, n))` with `c = bits(S)`, `R_s = floor(2^(c+22)/S)`.
    fn write<T: Code>(&self, args: &AttentionArgs<'_>, sum: i64, codes: &mut [T]) {
        let digits = bits(sum);
        let reciprocal = saturate_i64(divide(1 << (digits + 22).min(63), sum.max(0).unsigned_abs()));
        for (code, context) in codes.iter_mut().zip(&*self.context) {
            let t = round_shift(i64::from(*context).wrapping_mul(reciprocal), digits + 10);
            *code = args.requant.code(t);
        }
    }
}
