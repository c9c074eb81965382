//! The pixel that each channel expects under a softmax over all of its pixels.

use super::arithmetic::{Exactness, power_of_two, quotient};
use super::operands::{Operands, expect};
use super::softmax::Exponential;
use crate::error::Result;
use crate::qmodel::QTensorId;

/// `column = floor(2^6·Σ e_j·column_j / Σ e_j)` with `e_j` in Q23, `row` alike.
pub(super) fn spatial_softmax(
    operands: &Operands,
    input: QTensorId,
    output: QTensorId,
    exponential: &Exponential,
) -> Result<Vec<f64>> {
    let (shape, codes) = (operands.shape(input)?, operands.codes(input)?);
    let channels = usize::from(shape.channels);
    expect("points of the output", operands.shape(output)?.elements() as usize, 2 * channels)?;
    let mut exact = Exactness::default();
    let mut points = Vec::with_capacity(2 * channels);
    for channel in 0..channels {
        let logits: Vec<f64> = codes.iter().skip(channel).step_by(channels).copied().collect();
        let largest = logits.iter().copied().fold(f64::NEG_INFINITY, f64::max);
        let weights: Vec<f64> =
            logits.iter().map(|logit| exponential.fine_weight(largest - logit, &mut exact)).collect();
        let total = exact.watch(weights.iter().sum());
        let mut expected = |index: &dyn Fn(usize) -> usize| {
            let sum: f64 = weights.iter().enumerate().map(|(pixel, weight)| weight * index(pixel) as f64).sum();
            quotient(exact.watch(sum * power_of_two(6)), total)
        };
        let width = usize::from(shape.width);
        points.extend([expected(&|pixel| pixel % width), expected(&|pixel| pixel / width)]);
    }
    exact.finish()?;
    Ok(points)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::error::ErrorCode;
    use crate::integer_reference::testing::{Random, execute_alone, requant};
    use crate::qmodel::QOp;
    use crate::quantize::tables::exp2_table;
    use firmware::tensor::{ElementType, Shape};

    fn run(shape: Shape, codes: Vec<f64>, scale: f64) -> Result<Vec<f64>> {
        let op = QOp::SpatialSoftmax {
            input: QTensorId(0),
            output: QTensorId(1),
            exponent: requant(scale * std::f64::consts::LOG2_E * 65536.0),
            exp_table: exp2_table(),
        };
        let output = (Shape::tokens(shape.channels, 2), ElementType::I32);
        execute_alone(op, &[(shape, ElementType::I16, codes)], output)
    }

    #[test]
    fn points_equal_those_of_a_float_softmax() {
        let seed = 0x5af7;
        let mut random = Random(seed);
        for (shape, scale) in [
            (Shape::map(3, 5, 2), 1e-3),
            (Shape::map(144, 256, 4), 1e-4),
            // Most pixels lie 15 to 25 powers of two below the peaks: together they outweigh none of them.
            (Shape::map(72, 128, 3), 4e-4),
            (Shape::map(256, 256, 1), 1e-5),
        ] {
            let codes = random.codes(shape.elements() as usize, -32767, 32767);
            let points = run(shape, codes.clone(), scale).unwrap();
            let channels = usize::from(shape.channels);
            for channel in 0..channels {
                let logits: Vec<f64> = codes.iter().skip(channel).step_by(channels).copied().collect();
                let largest = logits.iter().copied().fold(f64::MIN, f64::max);
                let weights: Vec<f64> = logits.iter().map(|logit| ((logit - largest) * scale).exp()).collect();
                let total: f64 = weights.iter().sum();
                let width = usize::from(shape.width);
                let mean = |index: &dyn Fn(usize) -> usize| {
                    weights.iter().enumerate().map(|(j, w)| w * index(j) as f64).sum::<f64>() / total
                };
                for (axis, expected) in [mean(&|j| j % width), mean(&|j| j / width)].into_iter().enumerate() {
                    let found = points[2 * channel + axis] / 64.0;
                    let error = found - expected;
                    assert!((-0.04..0.03).contains(&error), "{found} for {expected}, {shape:?}, seed {seed:#x}");
                }
            }
        }
    }

    #[test]
    fn faint_pixels_do_not_draw_a_point_away_from_its_peak() {
        let shape = Shape::map(144, 256, 1);
        let mut codes = vec![-20_000.0; 144 * 256];
        codes[100 * 256 + 10] = 0.0;
        // 24 to 31 powers of two below the peak.
        for powers in [24.0_f64, 27.5, 31.0, 40.0] {
            let scale = powers * std::f64::consts::LN_2 / 20_000.0;
            assert_eq!(run(shape, codes.clone(), scale).unwrap(), [640.0, 6400.0], "{powers}");
        }
    }

    #[test]
    fn more_pixels_than_are_exact_are_refused() {
        let last = Shape::map(1, 256, 1);
        let mut codes = vec![-32767.0; 256];
        codes[255] = 32767.0;
        assert_eq!(run(last, codes, 0.01).unwrap(), [255.0 * 64.0, 0.0]);
        let shape = Shape::map(512, 512, 1);
        let error = run(shape, vec![5.0; 512 * 512], 0.1).unwrap_err();
        assert_eq!(error.code, ErrorCode::Numeric);
    }
}
