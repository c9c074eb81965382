//! Portable logistic function.

use super::codes::{operand, operand_len};
use crate::fixed_point::{round_shift, sigmoid_q15};
use crate::kernels::SigmoidArgs;
use crate::tensor::Codes;

/// `σ(x)` in Q15 of each element, `x = R((q − z)·M, n)` in Q12 ([`sigmoid_q15`]).
///
/// `input`: i8 or i16, as long as `output`, or `None` where `output` holds the codes. M in `[2^23, 2^24)`, n in 1..=52.
pub fn sigmoid(args: &SigmoidArgs<'_>, input: Option<Codes<'_>>, output: &mut [i16]) {
    let Some(table) = args.tanh_table.first_chunk() else { return };
    if operand_len(input, output.len()) != output.len() {
        return;
    }
    for (index, code) in output.iter_mut().enumerate() {
        let value = operand(input, index, *code) - i64::from(args.input_zero_point);
        let product = value.wrapping_mul(i64::from(args.requant.multiplier));
        *code = sigmoid_q15(table, round_shift(product, args.requant.shift.into()));
    }
}

#[cfg(test)]
mod tests {
    extern crate std;
    use super::super::oracle::{for_seeds, round};
    use super::*;
    use crate::fixed_point::TANH_TABLE_LEN;
    use crate::program::Requant;
    use crate::tensor::ElementType;
    use std::vec::Vec;

    fn table() -> [i16; TANH_TABLE_LEN] {
        core::array::from_fn(|k| f64::min(32767.0, (32768.0 * (k as f64 / 64.0).tanh()).round()) as i16)
    }

    fn expected(args: &SigmoidArgs<'_>, code: i128) -> i128 {
        let product = (code - i128::from(args.input_zero_point)) * i128::from(args.requant.multiplier);
        let x = round(product, args.requant.shift.into());
        let a = x.abs().min((1 << 16) - 1);
        let (k, r) = ((a >> 7) as usize, a & 127);
        let (t0, t1) = (i128::from(args.tanh_table[k]), i128::from(args.tanh_table[k + 1]));
        let tanh = round(t0 * 128 + (t1 - t0) * r, 7);
        round((1 << 15) + if x < 0 { -tanh } else { tanh }, 1).min(32767)
    }

    #[test]
    fn equals_the_formula_apart_and_in_place() {
        let table = table();
        for_seeds(300, |rng| {
            let element = rng.element_type();
            let len = rng.range(1, 70) as usize;
            let args = SigmoidArgs {
                input_zero_point: rng.zero_point(element),
                // Pre-activations from a fraction of the table's range to far beyond it.
                requant: Requant { multiplier: rng.multiplier(), shift: rng.range(8, 30) as u8 },
                tanh_table: &table,
            };
            let input = rng.buffer(element, len);
            let expected: Vec<i128> = (0..len).map(|i| expected(&args, input.get(i))).collect();
            let mut output: Vec<i16> = rng.values(len, -32768, 32767);
            sigmoid(&args, Some(input.codes()), &mut output);
            assert!(output.iter().map(|y| i128::from(*y)).eq(expected.iter().copied()), "{element:?}");
            if element == ElementType::I16 {
                let mut in_place: Vec<i16> = (0..len).map(|i| input.get(i) as i16).collect();
                sigmoid(&args, None, &mut in_place);
                assert_eq!(in_place, output, "in place");
            }
        });
    }

    #[test]
    fn follows_the_logistic_function() {
        let table = table();
        // Codes in 1/1024.
        let args = SigmoidArgs {
            input_zero_point: 0,
            requant: Requant { multiplier: 1 << 23, shift: 21 },
            tanh_table: &table,
        };
        for code in (i16::MIN..=i16::MAX).step_by(17) {
            let mut output = [code];
            sigmoid(&args, None, &mut output);
            let exact = 1.0 / (1.0 + (-f64::from(code) / 1024.0).exp());
            assert!((f64::from(output[0]) / 32768.0 - exact).abs() < 3.0 / 32768.0, "code {code}: {output:?}");
        }
    }

    #[test]
    fn hostile_constants_and_lengths_do_not_panic() {
        for entry in [i16::MIN, -1, 0, i16::MAX] {
            let table = [entry; TANH_TABLE_LEN];
            for (multiplier, shift) in [(i32::MIN, 255), (i32::MAX, 0), (1, 52)] {
                let requant = Requant { multiplier, shift };
                for tanh_table in [&table[..], &[]] {
                    let args = SigmoidArgs { input_zero_point: i16::MIN, requant, tanh_table };
                    sigmoid(&args, Some(Codes::I8(&[-128, 127])), &mut [0; 2]);
                    sigmoid(&args, Some(Codes::I16(&[0; 3])), &mut [0; 2]);
                    sigmoid(&args, None, &mut [i16::MIN, i16::MAX, 0]);
                }
            }
        }
    }
}
