//! Logistic function of each element.

use super::arithmetic::{Exactness, RoundingShift};
use super::gates::Gates;
use super::operands::Operands;
use crate::error::Result;
use crate::qmodel::{QTensorId, QTerm};

/// `σ(R((q − z)·M, n))` (Q15) of each element.
pub(super) fn sigmoid(
    operands: &Operands,
    input: QTerm,
    shift: u8,
    output: QTensorId,
    table: &[i16],
) -> Result<Vec<f64>> {
    let codes = operands.codes_shaped(input.tensor, operands.shape(output)?)?;
    let (gates, shift) = (Gates::new(table)?, RoundingShift::new(u32::from(shift)));
    let (zero_point, multiplier) = (f64::from(input.zero_point), f64::from(input.multiplier));
    let mut exact = Exactness::default();
    let mut code = |q: &f64| {
        let x = shift.round((q - zero_point) * multiplier, &mut exact);
        gates.sigmoid(x, &mut exact)
    };
    let codes = codes.iter().map(&mut code).collect();
    exact.finish()?;
    Ok(codes)
}

#[cfg(test)]
mod tests {
    use crate::integer_reference::testing::{Random, execute_alone, requant};
    use crate::qmodel::{QOp, QTensorId};
    use crate::quantize::tables::tanh_table;
    use firmware::tensor::{ElementType, Shape};

    #[test]
    fn follows_the_logistic_function() {
        let seed = 0x516;
        let mut random = Random(seed);
        for (element, limit, zero_point, scale) in [
            (ElementType::I8, 127, -7_i16, 0.06),
            (ElementType::I16, 32767, 0, 3e-4),
            (ElementType::I16, 32767, 0, 0.01),
        ] {
            let shape = Shape::map(3, 5, 7);
            let codes = random.codes(105, -limit - 1, limit);
            let op = QOp::Sigmoid {
                input: QTensorId(0),
                output: QTensorId(1),
                input_zero_point: zero_point,
                requant: requant(scale * 4096.0),
                tanh_table: tanh_table(),
            };
            let found = execute_alone(op, &[(shape, element, codes.clone())], (shape, ElementType::I16)).unwrap();
            for (found, code) in found.iter().zip(&codes) {
                let x = scale * (code - f64::from(zero_point));
                // The table and the rounding of x to Q12, where the function rises by at most a quarter.
                let expected = 32768.0 / (1.0 + (-x).exp());
                assert!((found - expected).abs() < 2.6, "{found} for σ({x}) = {expected}, seed {seed:#x}");
            }
        }
    }

    #[test]
    fn another_table_length_is_malformed() {
        let op = QOp::Sigmoid {
            input: QTensorId(0),
            output: QTensorId(1),
            input_zero_point: 0,
            requant: requant(1.0),
            tanh_table: vec![0; 512],
        };
        let shape = Shape::vector(1);
        let error = execute_alone(op, &[(shape, ElementType::I16, vec![1.0])], (shape, ElementType::I16)).unwrap_err();
        assert!(error.to_string().contains("entries of the tanh table: found 512, expected 513"), "{error}");
    }
}
