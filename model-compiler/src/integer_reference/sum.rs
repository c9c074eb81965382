//! Element-wise sums of one or two operands: add, and change of scale or type.

use super::arithmetic::{Exactness, Requantizer};
use super::operands::Operands;
use crate::error::Result;
use crate::qmodel::{QTensorId, QTerm};

/// `y = clamp(z_o + R(Σ_k (q_k − z_k)·M_k, n))`, all operands shaped like the output.
pub(super) fn of_terms(
    operands: &Operands,
    terms: &[QTerm],
    output: QTensorId,
    requantizer: &Requantizer,
) -> Result<Vec<f64>> {
    let shape = operands.shape(output)?;
    let mut exact = Exactness::default();
    let mut sums = vec![0.0; shape.elements() as usize];
    for term in terms {
        for (sum, code) in sums.iter_mut().zip(operands.codes_shaped(term.tensor, shape)?) {
            *sum += exact.watch((code - f64::from(term.zero_point)) * f64::from(term.multiplier));
        }
    }
    let codes = sums.iter().map(|&sum| requantizer.code(sum, &mut exact)).collect();
    exact.finish()?;
    Ok(codes)
}

#[cfg(test)]
mod tests {
    use crate::error::ErrorCode;
    use crate::integer_reference::testing::{Random, clamp, execute_alone, rounding_shift};
    use crate::qmodel::{QOp, QTensorId, QTerm};
    use firmware::program::Requant;
    use firmware::tensor::{ElementType, Shape};

    fn add(first: QTerm, second: QTerm, shift: u8, zero_point: i16) -> QOp {
        QOp::Add { first, second, output: QTensorId(2), shift, zero_point, clamp: clamp(-128, 127) }
    }

    fn term(tensor: u32, zero_point: i16, multiplier: i32) -> QTerm {
        QTerm { tensor: QTensorId(tensor), zero_point, multiplier }
    }

    #[test]
    fn add_rounds_the_sum_once() {
        // Halves of 1 and 1: 1/2 + 1/2 = 1, where two roundings would give 2; −1/2 rounds to 0; then saturation.
        let shape = Shape::vector(4);
        let operands = [
            (shape, ElementType::I8, vec![1.0, -1.0, 127.0, -128.0]),
            (shape, ElementType::I8, vec![6.0, 5.0, 127.0, -128.0]),
        ];
        let op = add(term(0, 0, 1), term(1, 5, 1), 1, 0);
        assert_eq!(execute_alone(op, &operands, (shape, ElementType::I8)).unwrap(), [1.0, 0.0, 125.0, -128.0]);
        let op = add(term(0, 0, 2), term(1, 5, 2), 0, 100);
        assert_eq!(execute_alone(op, &operands, (shape, ElementType::I8)).unwrap(), [104.0, 98.0, 127.0, -128.0]);
    }

    #[test]
    fn add_equals_wide_integers() {
        let seed = 0xadd;
        let mut random = Random(seed);
        let shape = Shape::map(9, 9, 7);
        let codes = [random.codes(567, -128, 127), random.codes(567, -32768, 32767)];
        let operands = [(shape, ElementType::I8, codes[0].clone()), (shape, ElementType::I16, codes[1].clone())];
        let op = add(term(0, -77, 2_000_000_001), term(1, 0, 33_333_333), 34, 12);
        let result = execute_alone(op, &operands, (shape, ElementType::I8)).unwrap();
        for i in 0..result.len() {
            let sum = (codes[0][i] as i128 + 77) * 2_000_000_001 + codes[1][i] as i128 * 33_333_333;
            let expected = (12 + rounding_shift(sum, 34)).clamp(-128, 127);
            assert_eq!(result[i] as i128, expected, "element {i}, seed {seed:#x}");
        }
    }

    #[test]
    fn requantize_changes_scale_and_type() {
        let op = QOp::Requantize {
            input: QTensorId(0),
            output: QTensorId(1),
            input_zero_point: 0,
            requant: Requant { multiplier: 12_582_912, shift: 31 },
            zero_point: -128,
            clamp: clamp(-128, 127),
        };
        // Factor 1.5/256: 85.33… steps of the input are half a step of the output.
        let input = vec![0.0, 85.0, 86.0, -85.0, -86.0, 256.0, 32767.0];
        let (shape, expected) = (Shape::vector(7), [-128.0, -128.0, -127.0, -128.0, -128.0, -126.0, 64.0]);
        let result = execute_alone(op, &[(shape, ElementType::I16, input)], (shape, ElementType::I8)).unwrap();
        assert_eq!(result, expected);
    }

    #[test]
    fn operands_must_be_shaped_like_the_output() {
        let operands =
            [(Shape::vector(2), ElementType::I8, vec![0.0; 2]), (Shape::tokens(2, 1), ElementType::I8, vec![0.0; 2])];
        let op = add(term(0, 0, 1), term(1, 0, 1), 1, 0);
        let error = execute_alone(op, &operands, (Shape::vector(2), ElementType::I8)).unwrap_err();
        assert_eq!(error.code, ErrorCode::Malformed);
    }
}
