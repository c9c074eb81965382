//! Bilinear enlargement from stored indices and weights, optionally added to a map of the output's size.

use super::arithmetic::{Exactness, Requantizer, RoundingShift, power_of_two};
use super::operands::{Operands, expect};
use crate::error::{Error, ErrorCode, Result};
use crate::qmodel::{QTensorId, QTerm};

/// Where each output row and column reads: `[i0, w1]`, weights of `weight_bits` bits.
pub(super) struct Grid<'a> {
    pub(super) rows: &'a [[u16; 2]],
    pub(super) columns: &'a [[u16; 2]],
    pub(super) weight_bits: u8,
}

/// `t = R(Σ wy·wx·(q − z), 2w − 8); y = clamp(z_o + R(t·M + (r − z_r)·M_r, n))`.
pub(super) fn resize_bilinear(
    operands: &Operands,
    input: QTerm,
    residual: Option<QTerm>,
    output: QTensorId,
    grid: &Grid,
    requantizer: &Requantizer,
) -> Result<Vec<f64>> {
    let (shape, out_shape) = (operands.shape(input.tensor)?, operands.shape(output)?);
    let channels = usize::from(shape.channels);
    expect("channels of the output", usize::from(out_shape.channels), channels)?;
    expect("output rows", grid.rows.len(), usize::from(out_shape.height))?;
    expect("output columns", grid.columns.len(), usize::from(out_shape.width))?;
    let rows = taps(grid.rows, usize::from(shape.height), grid.weight_bits)?;
    let columns = taps(grid.columns, usize::from(shape.width), grid.weight_bits)?;
    let codes = operands.codes(input.tensor)?;
    let residual_codes = residual.map(|term| operands.codes_shaped(term.tensor, out_shape)).transpose()?;
    let shift = RoundingShift::new(2 * u32::from(grid.weight_bits) - 8);

    let mut exact = Exactness::default();
    let mut result = Vec::with_capacity(out_shape.elements() as usize);
    for row in &rows {
        for column in &columns {
            for channel in 0..channels {
                let mut sum = 0.0;
                for (y, wy) in row {
                    for (x, wx) in column {
                        let code = codes[(y * usize::from(shape.width) + x) * channels + channel];
                        sum += wy * wx * (code - f64::from(input.zero_point));
                    }
                }
                let t = shift.round(sum, &mut exact);
                let mut total = exact.watch(t * f64::from(input.multiplier));
                if let (Some(term), Some(codes)) = (residual, residual_codes) {
                    let code = codes[result.len()];
                    total += exact.watch((code - f64::from(term.zero_point)) * f64::from(term.multiplier));
                }
                result.push(requantizer.code(total, &mut exact));
            }
        }
    }
    exact.finish()?;
    Ok(result)
}

/// Per output index the two input indices with their weights: `(i0, 2^w − w1)` and `(min(i0 + 1, last), w1)`.
fn taps(axis: &[[u16; 2]], size: usize, weight_bits: u8) -> Result<Vec<[(usize, f64); 2]>> {
    if !(4..=11).contains(&weight_bits) {
        return Err(Error::new(ErrorCode::Malformed, "", format!("weight bits: found {weight_bits}, expected 4..=11")));
    }
    let one = power_of_two(i32::from(weight_bits));
    let pair = |&[i0, w1]: &[u16; 2]| {
        let (i0, w1) = (usize::from(i0), f64::from(w1));
        if i0 >= size || w1 > one {
            let message = format!("resize reads index {i0} with weight {w1} of {size} inputs and unit weight {one}");
            return Err(Error::new(ErrorCode::Malformed, "", message));
        }
        Ok([(i0, one - w1), ((i0 + 1).min(size - 1), w1)])
    };
    axis.iter().map(pair).collect()
}
