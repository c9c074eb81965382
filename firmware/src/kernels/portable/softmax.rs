//! Portable softmax.

use super::codes::operand_len;
use crate::fault::{self, Fault};
use crate::fixed_point::{EXP_TABLE_LEN, bits, divide, exp2_q15, round_shift, saturate_i16, saturate_i64};
use crate::kernels::SoftmaxArgs;
use crate::tensor::Codes;

/// `exp(x_j) / Σ exp(x_j)` in Q15 over the channels of each position.
///
/// `u_j = min(R((max(q) − q_j)·M_u, n_u), 31·2^16)`; `e_j = 2^(−u_j)` ([`exp2_q15`]); `S = Σ e_j`, `c = bits(S)`,
/// `R_s = floor(2^(c+22)/S)`; `p_j = min(32767, R(e_j·R_s, c + 7))`.
///
/// `input`: i8 or i16 logits, `positions × channels`, or `None` where `output` holds them; `output` receives p.
/// Precondition: channels ≤ 2^15.
pub fn softmax(args: &SoftmaxArgs<'_>, input: Option<Codes<'_>>, output: &mut [i16]) {
    let channels = usize::from(args.channels);
    let Some(table) = args.exp_table.first_chunk() else { return };
    if channels == 0 || operand_len(input, output.len()) != output.len() {
        return;
    }
    match input {
        Some(Codes::I8(codes)) => {
            for (row, codes) in output.chunks_exact_mut(channels).zip(codes.chunks_exact(channels)) {
                row.iter_mut().zip(codes).for_each(|(logit, code)| *logit = i16::from(*code));
                normalize(args, table, row);
            }
        }
        Some(Codes::I16(codes)) => {
            for (row, codes) in output.chunks_exact_mut(channels).zip(codes.chunks_exact(channels)) {
                row.copy_from_slice(codes);
                normalize(args, table, row);
            }
        }
        None => output.chunks_exact_mut(channels).for_each(|row| normalize(args, table, row)),
    }
}

/// Replaces the logits of one position by their probabilities.
fn normalize(args: &SoftmaxArgs<'_>, table: &[i16; EXP_TABLE_LEN], row: &mut [i16]) {
    let considered = match &*row {
        [front @ .., _] if fault::active(Fault::SoftmaxMaximum) => front,
        all => all,
    };
    let peak = i64::from(considered.iter().copied().max().unwrap_or(0));
    let mut sum = 0;
    for code in row.iter_mut() {
        let distance = (peak - i64::from(*code)).wrapping_mul(i64::from(args.exponent.multiplier));
        *code = exp2_q15(table, round_shift(distance, args.exponent.shift.into()));
        sum += i64::from(*code);
    }
    let digits = bits(sum);
    let reciprocal = saturate_i64(divide(1 << (digits + 22).min(63), sum.max(0).unsigned_abs()));
    for code in row.iter_mut() {
        *code = saturate_i16(round_shift(i64::from(*code).wrapping_mul(reciprocal), digits + 7));
    }
}

#[cfg(test)]
mod tests {
    extern crate std;
    use super::super::oracle::{Buffer, Rng, for_seeds, round};
    use super::*;
    use crate::program::Requant;
    use crate::tensor::CodesMut;
    use std::vec::Vec;

    fn table() -> [i16; EXP_TABLE_LEN] {
        core::array::from_fn(|k| f64::min(32767.0, (32768.0 * f64::exp2(-(k as f64) / 256.0)).round()) as i16)
    }

    fn expected(args: &SoftmaxArgs<'_>, logits: &[i128]) -> Vec<i128> {
        let peak = logits.iter().max().unwrap();
        let e = logits.iter().map(|logit| {
            let u =
                round((peak - logit) * i128::from(args.exponent.multiplier), args.exponent.shift.into()).min(31 << 16);
            let (i, k, r) = (u >> 16, ((u >> 8) & 255) as usize, u & 255);
            let (t0, t1) = (i128::from(args.exp_table[k]), i128::from(args.exp_table[k + 1]));
            round((t0 << 8) - (t0 - t1) * r, 8 + i.min(23) as u32)
        });
        let e: Vec<i128> = e.collect();
        let sum: i128 = e.iter().sum();
        let c = sum.ilog2() + 1;
        assert!(c <= 30);
        e.iter().map(|e| round(e * ((1 << (c + 22)) / sum), c + 7).min(32767)).collect()
    }

    fn check(rng: &mut Rng, positions: usize, channels: u16) {
        let table = table();
        let exponent = Requant { multiplier: rng.multiplier(), shift: rng.range(8, 32) as u8 };
        let args = SoftmaxArgs { channels, exponent, exp_table: &table };
        let element = rng.element_type();
        let input = rng.buffer(element, positions * usize::from(channels));
        let logits: Vec<i128> = (0..input.len()).map(|i| input.get(i)).collect();
        let expected: Vec<i128> = logits.chunks(channels.into()).flat_map(|row| expected(&args, row)).collect();
        let mut output = Buffer::I16(rng.values(input.len(), -32768, 32767));
        let CodesMut::I16(codes) = output.codes_mut() else { unreachable!("16 bits") };
        softmax(&args, Some(input.codes()), codes);
        output.assert_equals(&expected, "softmax");
        let mut in_place: Vec<i16> = logits.iter().map(|logit| *logit as i16).collect();
        softmax(&args, None, &mut in_place);
        assert!(in_place.iter().map(|p| i128::from(*p)).eq(expected), "in place");
    }

    #[test]
    fn equals_the_formula_apart_and_in_place() {
        for_seeds(300, |rng| {
            let (positions, channels) = (rng.range(1, 5) as usize, rng.range(1, 40) as u16);
            check(rng, positions, channels);
        });
    }

    #[test]
    fn equals_the_formula_at_the_largest_size() {
        check(&mut Rng(1), 2, 1 << 15);
        check(&mut Rng(2), 1, 4096);
    }

    #[test]
    fn equal_logits_share_and_a_lone_one_has_all() {
        let table = table();
        let exponent = Requant { multiplier: 1 << 23, shift: 7 };
        let args = SoftmaxArgs { channels: 4, exponent, exp_table: &table };
        let mut output = [7, 7, 7, 7, 9, -9, -9, -9];
        softmax(&args, None, &mut output);
        assert_eq!(output, [8192, 8192, 8192, 8192, 32767, 0, 0, 0]);
        let mut equal = std::vec![0; 1 << 15];
        softmax(&SoftmaxArgs { channels: 1 << 15, ..args }, None, &mut equal);
        assert!(equal.iter().all(|p| *p == 1));
    }

    #[test]
    fn hostile_constants_and_lengths_do_not_panic() {
        for entry in [i16::MIN, -1, 0, i16::MAX] {
            let table = [entry; EXP_TABLE_LEN];
            for (multiplier, shift) in [(i32::MIN, 255), (i32::MAX, 0), (1, 52)] {
                let args = SoftmaxArgs { channels: 2, exponent: Requant { multiplier, shift }, exp_table: &table };
                for args in [args, SoftmaxArgs { channels: 0, ..args }, SoftmaxArgs { exp_table: &[], ..args }] {
                    softmax(&args, Some(Codes::I8(&[-128, 127])), &mut [0; 2]);
                    softmax(&args, Some(Codes::I16(&[i16::MIN, i16::MAX])), &mut [0; 2]);
                    softmax(&args, Some(Codes::I16(&[0; 3])), &mut [0; 2]);
                    softmax(&args, None, &mut [i16::MIN, i16::MAX, 0]);
                }
            }
        }
    }
}
