//! Portable element-wise operators.

use super::codes::{Code, operand, operand_len, value};
use crate::fault::{self, Fault};
use crate::fixed_point::finish;
use crate::kernels::{RequantArgs, SumArgs, TermArgs};
use crate::tensor::{Codes, CodesMut};

/// `y = clamp(z_o + R((a − z_a)·M_a + (b − z_b)·M_b, n))`.
///
/// Operands: i8 or i16, as long as `output`; either may be in place (then it has the output's type). `M_k < 2^31`,
/// n ≤ 40.
pub fn add(sum: &SumArgs, terms: &[TermArgs<'_>; 2], output: CodesMut<'_>) {
    match output {
        CodesMut::I8(output) => add_into(sum, terms, output),
        CodesMut::I16(output) => add_into(sum, terms, output),
    }
}

fn add_into<T: Code>(sum: &SumArgs, [first, second]: &[TermArgs<'_>; 2], output: &mut [T]) {
    let len = output.len();
    if operand_len(first.codes, len) != len || operand_len(second.codes, len) != len {
        return;
    }
    let second = if fault::active(Fault::ResidualZeroPoint) { &TermArgs { zero_point: 0, ..*second } } else { second };
    for (index, code) in output.iter_mut().enumerate() {
        let total = weighted(first, index, *code).wrapping_add(weighted(second, index, *code));
        *code = T::from_code(finish(total, sum.shift, i64::from(sum.zero_point), sum.clamp));
    }
}

/// `(q − z)·M` of element `index` of a term; `stored` is that element of the output buffer.
#[inline]
pub(super) fn weighted<T: Code>(term: &TermArgs<'_>, index: usize, stored: T) -> i64 {
    (operand(term.codes, index, stored) - i64::from(term.zero_point)) * i64::from(term.multiplier)
}

/// `y = clamp(z_o + R((q − z)·M, n))`.
///
/// `input`: i8 or i16, as long as `output`. M in `[2^23, 2^24)`, n in 1..=52.
pub fn requantize(args: &RequantArgs, input: Codes<'_>, output: CodesMut<'_>) {
    match (input, output) {
        (Codes::I8(input), CodesMut::I8(output)) => requantize_into(args, input, output),
        (Codes::I8(input), CodesMut::I16(output)) => requantize_into(args, input, output),
        (Codes::I16(input), CodesMut::I8(output)) => requantize_into(args, input, output),
        (Codes::I16(input), CodesMut::I16(output)) => requantize_into(args, input, output),
    }
}

fn requantize_into<I: Code, O: Code>(args: &RequantArgs, input: &[I], output: &mut [O]) {
    if input.len() != output.len() {
        return;
    }
    for (code, q) in output.iter_mut().zip(input) {
        *code = args.code(value(*q) - i64::from(args.input_zero_point));
    }
}

impl RequantArgs {
    /// `clamp(z_o + R(value·M, n))` for a value that already has its zero point subtracted.
    #[inline]
    pub(super) fn code<T: Code>(&self, value: i64) -> T {
        let product = value.wrapping_mul(i64::from(self.requant.multiplier));
        T::from_code(finish(product, u32::from(self.requant.shift), i64::from(self.zero_point), self.clamp))
    }
}

#[cfg(test)]
mod tests {
    extern crate std;
    use super::super::oracle::{Rng, clamp, for_seeds, round};
    use super::*;
    use crate::program::{Clamp, Requant};
    use crate::tensor::ElementType;
    use std::vec::Vec;

    #[test]
    fn add_equals_the_formula_with_operands_apart_and_in_place() {
        for_seeds(400, |rng| {
            let output_type = rng.element_type();
            let len = rng.range(1, 70) as usize;
            let in_place = [rng.flag(), rng.flag()];
            let types = in_place.map(|in_place| if in_place { output_type } else { rng.element_type() });
            let initial = rng.buffer(output_type, len);
            let apart = types.map(|t| rng.buffer(t, len));
            let zero_points = types.map(|t| rng.zero_point(t));
            let multipliers = [rng.range(1, (1 << 31) - 1) as i32, rng.range(1, (1 << 31) - 1) as i32];
            let sum = SumArgs {
                shift: rng.range(24, 40) as u32,
                zero_point: rng.zero_point(output_type),
                clamp: rng.clamp(output_type),
            };
            let operands = [0, 1].map(|k| if in_place[k] { &initial } else { &apart[k] });
            let expected: Vec<i128> = (0..len)
                .map(|i| {
                    let term =
                        |k: usize| (operands[k].get(i) - i128::from(zero_points[k])) * i128::from(multipliers[k]);
                    clamp(i128::from(sum.zero_point) + round(term(0) + term(1), sum.shift), sum.clamp)
                })
                .collect();
            let terms = [0, 1].map(|k| TermArgs {
                codes: (!in_place[k]).then(|| apart[k].codes()),
                zero_point: zero_points[k],
                multiplier: multipliers[k],
            });
            let mut output = initial.clone();
            add(&sum, &terms, output.codes_mut());
            output.assert_equals(&expected, "add");
        });
    }

    #[test]
    fn requantize_equals_the_formula() {
        for_seeds(400, |rng| {
            let (from, to) = (rng.element_type(), rng.element_type());
            let len = rng.range(1, 70) as usize;
            let input = rng.buffer(from, len);
            let bits = |t| if t == ElementType::I8 { 8 } else { 16 };
            let args = RequantArgs {
                input_zero_point: rng.zero_point(from),
                requant: rng.requant(bits(from), bits(to)),
                zero_point: rng.zero_point(to),
                clamp: rng.clamp(to),
            };
            let expected: Vec<i128> = (0..len)
                .map(|i| {
                    let product =
                        (input.get(i) - i128::from(args.input_zero_point)) * i128::from(args.requant.multiplier);
                    clamp(i128::from(args.zero_point) + round(product, u32::from(args.requant.shift)), args.clamp)
                })
                .collect();
            let mut output = rng.buffer(to, len);
            requantize(&args, input.codes(), output.codes_mut());
            output.assert_equals(&expected, "requantize");
        });
    }

    #[test]
    fn operands_of_another_length_leave_the_output_alone() {
        let term = |codes| TermArgs { codes, zero_point: 0, multiplier: 1 };
        let sum = SumArgs { shift: 0, zero_point: 0, clamp: Clamp { min: -128, max: 127 } };
        let mut output = Rng(1).values::<i8>(3, -128, 127);
        let before = output.clone();
        add(&sum, &[term(None), term(Some(Codes::I8(&[1, 2])))], CodesMut::I8(&mut output));
        let requant = Requant { multiplier: 1, shift: 0 };
        let args = RequantArgs { input_zero_point: 0, requant, zero_point: 0, clamp: sum.clamp };
        requantize(&args, Codes::I16(&[1, 2, 3, 4]), CodesMut::I8(&mut output));
        assert_eq!(output, before);
    }

    #[test]
    fn hostile_constants_do_not_panic() {
        let clamp = Clamp { min: i16::MAX, max: i16::MIN };
        let sum = SumArgs { shift: u32::MAX, zero_point: i16::MIN, clamp };
        let term = TermArgs { codes: None, zero_point: i16::MAX, multiplier: i32::MIN };
        let mut output = [i16::MIN; 2];
        add(&sum, &[term, term], CodesMut::I16(&mut output));
        let requant = Requant { multiplier: i32::MIN, shift: 255 };
        let args = RequantArgs { input_zero_point: i16::MAX, requant, zero_point: i16::MAX, clamp };
        requantize(&args, Codes::I16(&[i16::MIN; 2]), CodesMut::I16(&mut output));
        assert_eq!(output, [i16::MIN; 2]);
    }
}
