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
            row.score(key, heads, head);
            let sum = row.exponentiate(args, table);
            row.mix(value, heads, head);
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
    fn score(&mut self, key: &[i8], heads: usize, head: usize) {
        for (j, logit) in self.keys.iter_mut().enumerate() {
            let key = block(key, j * heads + head, self.query.len()).unwrap_or_default();
            [*logit] = dot(key, [&*self.query]);
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
    fn mix(&mut self, value: &[i8], heads: usize, head: usize) {
        self.context.fill(0);
        for (j, e) in self.keys.iter().enumerate() {
            let e = saturate_i16(i64::from(*e));
            let value = block(value, j * heads + head, self.context.len()).unwrap_or_default();
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

#[cfg(test)]
mod tests {
    extern crate std;
    use super::super::oracle::{Rng, Scratch, clamp, exp_table, for_seeds, round};
    use super::*;
    use crate::kernels::RequantArgs;
    use crate::kernels::plan::attention_scratch_bytes;
    use crate::program::{Clamp, Requant};
    use crate::tensor::ElementType;
    use std::vec::Vec;

    fn expected(args: &AttentionArgs<'_>, query: &[i8], key: &[i8], value: &[i8]) -> Vec<i128> {
        let (tokens, channels) = (args.tokens as usize, usize::from(args.channels));
        let size = channels / usize::from(args.heads);
        let at = |codes: &[i8], token: usize, channel: usize| i128::from(codes[token * channels + channel]);
        let code = |element: usize| {
            let (row, channel) = (element / channels, element % channels);
            let head = channel / size * size..(channel / size + 1) * size;
            let logit = |j: usize| head.clone().map(|c| at(query, row, c) * at(key, j, c)).sum::<i128>();
            let a: Vec<i128> = (0..tokens).map(logit).collect();
            let e = a.iter().map(|logit| {
                let delta = a.iter().max().unwrap() - logit;
                let u = round(delta * i128::from(args.exponent.multiplier), args.exponent.shift.into()).min(31 << 16);
                let (i, k, r) = (u >> 16, ((u >> 8) & 255) as usize, u & 255);
                let (t0, t1) = (i128::from(args.exp_table[k]), i128::from(args.exp_table[k + 1]));
                round((t0 << 8) - (t0 - t1) * r, 8 + i.min(23) as u32)
            });
            let e: Vec<i128> = e.collect();
            let s: i128 = e.iter().sum();
            let c = s.ilog2() + 1;
            let mixed: i128 = (0..tokens).map(|j| e[j] * at(value, j, channel)).sum();
            let t = round(mixed * ((1 << (c + 22)) / s), c + 10);
            let requant = args.requant.requant;
            let y =
                i128::from(args.requant.zero_point) + round(t * i128::from(requant.multiplier), requant.shift.into());
            clamp(y, args.requant.clamp)
        };
        (0..tokens * channels).map(code).collect()
    }

    fn check(rng: &mut Rng, tokens: u32, heads: u16, size: u16) {
        let channels = heads * size;
        let count = tokens as usize * usize::from(channels);
        let [query, key, value] = [(); 3].map(|()| rng.values::<i8>(count, -127, 127));
        let to = rng.element_type();
        let table = exp_table();
        let span = if to == ElementType::I8 { 7 } else { 15 };
        let args = AttentionArgs {
            tokens,
            channels,
            heads,
            exponent: Requant { multiplier: rng.multiplier(), shift: rng.range(16, 28) as u8 },
            exp_table: &table,
            requant: RequantArgs {
                input_zero_point: 0,
                requant: rng.requant(19, span),
                zero_point: rng.zero_point(to),
                clamp: rng.clamp(to),
            },
        };
        let expected = expected(&args, &query, &key, &value);
        let mut scratch = Scratch::new(attention_scratch_bytes(tokens, channels, heads));
        let mut output = rng.buffer(to, count);
        attention(&args, Some(&query), &key, &value, output.codes_mut(), scratch.bytes());
        output.assert_equals(&expected, "attention");
        if to == ElementType::I8 {
            let mut output = query.clone();
            attention(&args, None, &key, &value, CodesMut::I8(&mut output), scratch.bytes());
            assert!(output.iter().map(|y| i128::from(*y)).eq(expected), "in place");
        }
    }

    #[test]
    fn equals_the_formula_apart_and_in_place() {
        for_seeds(300, |rng| {
            let (tokens, heads, size) = (rng.range(1, 20) as u32, rng.range(1, 4) as u16, rng.range(1, 40) as u16);
            check(rng, tokens, heads, size);
        });
    }

    #[test]
    fn equals_the_formula_at_the_largest_sizes() {
        check(&mut Rng(1), 512, 1, 3);
        check(&mut Rng(2), 3, 1, 512);
    }

    #[test]
    fn equal_logits_average_the_values() {
        let table = exp_table();
        let args = AttentionArgs {
            tokens: 4,
            channels: 1,
            heads: 1,
            exponent: Requant { multiplier: 1 << 23, shift: 20 },
            exp_table: &table,
            requant: RequantArgs {
                input_zero_point: 0,
                requant: Requant { multiplier: 1 << 23, shift: 23 + 12 },
                zero_point: 0,
                clamp: Clamp { min: -128, max: 127 },
            },
        };
        let mut output = [0; 4];
        let mut scratch = Scratch::new(attention_scratch_bytes(4, 1, 1));
        attention(&args, Some(&[0; 4]), &[9; 4], &[10, 20, 30, -16], CodesMut::I8(&mut output), scratch.bytes());
        assert_eq!(output, [11; 4]);
    }

    #[test]
    fn hostile_constants_and_lengths_do_not_panic() {
        for entry in [i16::MIN, -1, 0, i16::MAX] {
            let table = [entry; EXP_TABLE_LEN];
            let args = AttentionArgs {
                tokens: 2,
                channels: 3,
                heads: 1,
                exponent: Requant { multiplier: i32::MIN, shift: 255 },
                exp_table: &table,
                requant: RequantArgs {
                    input_zero_point: i16::MIN,
                    requant: Requant { multiplier: i32::MIN, shift: 0 },
                    zero_point: i16::MIN,
                    clamp: Clamp { min: 1, max: -1 },
                },
            };
            let codes = [-128, 127, -128, 127, -128, 127];
            for args in [
                args,
                AttentionArgs { exponent: Requant { multiplier: i32::MAX, shift: 0 }, ..args },
                AttentionArgs { heads: 0, ..args },
                AttentionArgs { heads: 2, ..args },
                AttentionArgs { heads: 7, ..args },
                AttentionArgs { channels: 0, ..args },
                AttentionArgs { tokens: u32::MAX, ..args },
                AttentionArgs { exp_table: &[], ..args },
            ] {
                let mut scratch = Scratch::new(256);
                attention(&args, Some(&codes), &codes, &codes, CodesMut::I16(&mut [0; 6]), scratch.bytes());
                attention(&args, None, &codes, &codes, CodesMut::I8(&mut [0; 6]), scratch.bytes());
                attention(&args, None, &codes, &codes, CodesMut::I16(&mut [0; 6]), &mut []);
                attention(&args, None, &codes, &[], CodesMut::I8(&mut [0; 6]), scratch.bytes());
            }
        }
    }
}
