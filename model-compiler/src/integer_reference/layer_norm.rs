//! LayerNorm over the channels of a residual stream.

use super::arithmetic::{Exactness, Requantizer, RoundingShift, bits, isqrt, power_of_two, quotient, to_f64};
use super::operands::{Operands, expect, positions};
use crate::error::{Error, ErrorCode, Result};
use crate::qmodel::QTensorId;
use rayon::prelude::*;

/// Constants of the normalization, per channel but for E.
pub(super) struct Affine<'a> {
    pub(super) epsilon: i64,
    pub(super) gains: &'a [i32],
    pub(super) offsets: &'a [i64],
}

/// `y_i = clamp(z_o + R(t_i·G_i + B_i, n))` of rows `first_row ..`, t in Q14.
pub(super) fn layer_norm(
    operands: &Operands,
    input: QTensorId,
    first_row: usize,
    output: QTensorId,
    affine: &Affine,
    requantizer: &Requantizer,
) -> Result<Vec<f64>> {
    let (shape, out_shape) = (operands.shape(input)?, operands.shape(output)?);
    let channels = usize::from(shape.channels);
    expect("channels of the output", usize::from(out_shape.channels), channels)?;
    expect("gains", affine.gains.len(), channels)?;
    expect("offsets", affine.offsets.len(), channels)?;
    let rows = positions(out_shape);
    if first_row + rows > positions(shape) {
        let message = format!("rows {first_row}..{} of {}", first_row + rows, positions(shape));
        return Err(Error::new(ErrorCode::Malformed, "", message));
    }
    let gains = to_f64(affine.gains);
    // A rounded conversion is at least 2^53, which the watched sum would show.
    let offsets: Vec<f64> = affine.offsets.iter().map(|&b| b as f64).collect();
    let codes = &operands.codes(input)?[first_row * channels..];
    let mut result = vec![0.0; rows * channels];
    result.par_chunks_mut(channels).zip(codes.par_chunks(channels)).try_for_each(|(row, x)| {
        let mut exact = Exactness::default();
        let normalized = normalize(x, affine.epsilon as f64, &mut exact)?;
        for (i, (y, t)) in row.iter_mut().zip(normalized).enumerate() {
            *y = requantizer.code(exact.watch(t * gains[i]) + exact.watch(offsets[i]), &mut exact);
        }
        exact.finish()
    })?;
    Ok(result)
}

/// `t_i` (Q14): deviation from the mean over the standard deviation.
fn normalize(x: &[f64], epsilon: f64, exact: &mut Exactness) -> Result<Vec<f64>> {
    let channels = x.len() as f64;
    let sum: f64 = x.iter().sum();
    let squares: f64 = x.iter().map(|v| v * v).sum();
    let variance = exact.watch(channels * squares) - exact.watch(sum * sum) + exact.watch(epsilon);
    if !(1.0..power_of_two(52)).contains(&variance) {
        let message = format!("scaled variance of a row: found {variance}, expected 1..2^52");
        return Err(Error::new(ErrorCode::Numeric, "", message));
    }
    let half_shift = (52 - bits(variance)) / 2;
    let deviation = isqrt(variance * power_of_two(2 * half_shift as i32));
    let reciprocal = quotient(power_of_two(47), deviation);
    let shift = RoundingShift::new(33 - half_shift);
    Ok(x.iter().map(|v| shift.round((channels * v - sum) * reciprocal, exact)).collect())
}

#[cfg(test)]
mod tests {
    use super::{Exactness, normalize};
    use crate::error::ErrorCode;
    use crate::integer_reference::testing::{Random, clamp, execute_alone, round, rounding_shift};
    use crate::qmodel::{QOp, QTensorId};
    use firmware::tensor::{ElementType, Shape};

    /// `t_i` in wide integers.
    fn wide(x: &[f64], epsilon: i128) -> Vec<i128> {
        let channels = x.len() as i128;
        let sum: i128 = x.iter().map(|&v| v as i128).sum();
        let squares: i128 = x.iter().map(|&v| (v as i128) * (v as i128)).sum();
        let variance = channels * squares - sum * sum + epsilon;
        let digits = 128 - variance.leading_zeros();
        let h = 52u32.saturating_sub(digits) >> 1;
        let reciprocal = (1i128 << 47) / (variance << (2 * h)).isqrt();
        x.iter().map(|&v| rounding_shift((channels * v as i128 - sum) * reciprocal, 33 - h)).collect()
    }

    #[test]
    fn normalization_equals_wide_integers() {
        let seed = 0x14;
        let mut random = Random(seed);
        for channels in [1, 2, 3, 64, 72, 512, 1024] {
            for limit in [0, 1, 5, 300, 32767] {
                let mut x = random.codes(channels, -limit - 1, limit);
                if limit == 5 {
                    x[0] = 32767.0; // One outlier: the largest possible |t|.
                }
                let epsilon = 1 + random.below(1 << 20);
                let mut exact = Exactness::default();
                let t = normalize(&x, epsilon as f64, &mut exact).unwrap();
                exact.finish().unwrap();
                let found: Vec<i128> = t.iter().map(|&t| t as i128).collect();
                assert_eq!(found, wide(&x, i128::from(epsilon)), "{channels} channels, ±{limit}, seed {seed:#x}");
            }
        }
    }

    #[test]
    fn two_opposite_values_normalize_to_plus_and_minus_one() {
        let mut exact = Exactness::default();
        // V = 2·2·1000² + 1: the tiny epsilon costs less than half a step of Q14.
        assert_eq!(normalize(&[1000.0, -1000.0], 1.0, &mut exact).unwrap(), [16384.0, -16384.0]);
        assert_eq!(normalize(&[7.0, 7.0, 7.0], 1.0, &mut exact).unwrap(), [0.0; 3]);
    }

    #[test]
    fn rows_equal_a_float_layer_norm() {
        let seed = 0x15;
        let mut random = Random(seed);
        let (rows, first, channels) = (6, 2, 96);
        let (scale, out_scale, epsilon) = (1.0 / 512.0, 1.0 / 4096.0, 1e-5);
        let mut codes = random.codes(rows * channels, -20_000, 20_000);
        codes[3 * channels..4 * channels].iter_mut().for_each(|c| *c = (*c / 10_000.0).trunc());
        let (gamma, beta) = (random.reals(channels, -1.5, 1.5), random.reals(channels, -2.0, 2.0));
        let shift = 30;
        let gain = |g: &f64| round(g / out_scale * f64::from(shift - 14).exp2()) as i32;
        let offset = |b: &f64| round(b / out_scale * f64::from(shift).exp2()) as i64;
        let op = QOp::LayerNorm {
            input: QTensorId(0),
            output: QTensorId(1),
            first_row: first as u16,
            epsilon: round(epsilon * (channels * channels) as f64 / (scale * scale)).max(1.0) as i64,
            gains: gamma.iter().map(gain).collect(),
            offsets: beta.iter().map(offset).collect(),
            shift: shift as u8,
            zero_point: 0,
            clamp: clamp(-32768, 32767),
        };
        let input = (Shape::tokens(rows as u16, channels as u16), ElementType::I16, codes.clone());
        let output = (Shape::map(2, 2, channels as u16), ElementType::I16);
        let result = execute_alone(op, &[input], output).unwrap();
        for (row, found) in codes.chunks_exact(channels).skip(first).zip(result.chunks_exact(channels)) {
            let x: Vec<f64> = row.iter().map(|c| c * scale).collect();
            let mean = x.iter().sum::<f64>() / channels as f64;
            let variance = x.iter().map(|v| (v - mean).powi(2)).sum::<f64>() / channels as f64;
            for c in 0..channels {
                let expected = ((x[c] - mean) / (variance + epsilon).sqrt() * gamma[c] + beta[c]) / out_scale;
                // Half a step of the output, and half a step of t (Q14) seen through the gain.
                assert!((found[c] - expected).abs() < 0.75, "{} for {expected}, channel {c}, seed {seed:#x}", found[c]);
            }
        }
        assert_eq!(result.len(), 4 * channels);
    }

    #[test]
    fn rows_and_variance_out_of_range_are_refused() {
        let run = |first_row: u16, epsilon: i64| {
            let op = QOp::LayerNorm {
                input: QTensorId(0),
                output: QTensorId(1),
                first_row,
                epsilon,
                gains: vec![1; 2],
                offsets: vec![0; 2],
                shift: 14,
                zero_point: 0,
                clamp: clamp(-128, 127),
            };
            let input = (Shape::tokens(2, 2), ElementType::I16, vec![5.0; 4]);
            execute_alone(op, &[input], (Shape::vector(2), ElementType::I8)).map_err(|e| e.code)
        };
        assert_eq!(run(1, 1), Ok(vec![0.0; 2]));
        assert_eq!(run(2, 1), Err(ErrorCode::Malformed));
        assert_eq!(run(0, 0), Err(ErrorCode::Numeric));
        assert_eq!(run(0, 1 << 52), Err(ErrorCode::Numeric));
    }
}
