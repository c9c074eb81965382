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
