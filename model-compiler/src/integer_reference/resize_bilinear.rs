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

#[cfg(test)]
mod tests {
    use crate::error::ErrorCode;
    use crate::integer_reference::testing::{Random, clamp, execute_alone, round, rounding_shift};
    use crate::qmodel::{QOp, QTensorId, QTerm};
    use firmware::tensor::{ElementType, Shape};

    /// `[i0, w1]` per output index (numerics, "bilinear resize").
    fn axis(size: u16, factor: u16, weight_bits: u8) -> Vec<[u16; 2]> {
        let unit = f64::from(1u16 << weight_bits);
        (0..size * factor)
            .map(|d| {
                let source = source(d, factor);
                let i0 = source.floor().min(f64::from(size - 1));
                [i0 as u16, round((source - i0) * unit) as u16]
            })
            .collect()
    }

    fn source(d: u16, factor: u16) -> f64 {
        ((f64::from(d) + 0.5) / f64::from(factor) - 0.5).max(0.0)
    }

    /// The same in real numbers at one point of a plane of `height × width`.
    fn interpolate(plane: &[f64], width: u16, height: u16, y: f64, x: f64) -> f64 {
        let at = |row: f64, column: f64| {
            let (row, column) = (row.min(f64::from(height - 1)), column.min(f64::from(width - 1)));
            plane[row as usize * usize::from(width) + column as usize]
        };
        let (fy, fx) = (y - y.floor(), x - x.floor());
        let row = |row: f64| at(row, x.floor()) * (1.0 - fx) + at(row, x.floor() + 1.0) * fx;
        row(y.floor()) * (1.0 - fy) + row(y.floor() + 1.0) * fy
    }

    fn resize(size: u16, factor: u16, weight_bits: u8, input: QTerm, shift: u8) -> QOp {
        QOp::ResizeBilinear {
            input,
            residual: None,
            output: QTensorId(1),
            rows: axis(size, factor, weight_bits),
            columns: axis(size, factor, weight_bits),
            weight_bits,
            shift,
            zero_point: 0,
            clamp: clamp(-32768, 32767),
        }
    }

    #[test]
    fn doubling_a_pair_gives_quarters() {
        let op = QOp::ResizeBilinear {
            input: QTerm { tensor: QTensorId(0), zero_point: 0, multiplier: 1 },
            residual: None,
            output: QTensorId(1),
            rows: vec![[0, 0]],
            columns: axis(2, 2, 4),
            weight_bits: 4,
            shift: 8,
            zero_point: 0,
            clamp: clamp(-128, 127),
        };
        let input = (Shape::map(1, 2, 1), ElementType::I8, vec![-1.0, 1.0]);
        // −1, −1/2, 1/2, 1: ties up.
        let codes = execute_alone(op, &[input], (Shape::map(1, 4, 1), ElementType::I8)).unwrap();
        assert_eq!(codes, [-1.0, 0.0, 1.0, 1.0]);
    }

    #[test]
    fn enlargement_is_bilinear() {
        let seed = 0xb1;
        let mut random = Random(seed);
        // Powers of two are exact up to the last rounding; others have weights rounded to 11 bits.
        for (factor, weight_bits, tolerance) in [(2, 4, 0.5), (4, 4, 0.5), (8, 4, 0.5), (3, 11, 8.5), (5, 11, 8.5)] {
            let size = 8;
            let codes = random.codes(64, -128, 127);
            let term = QTerm { tensor: QTensorId(0), zero_point: -20, multiplier: 1 };
            let output = Shape::map(size * factor, size * factor, 1);
            let input = (Shape::map(size, size, 1), ElementType::I8, codes.clone());
            let op = resize(size, factor, weight_bits, term, 2);
            let result = execute_alone(op, &[input], (output, ElementType::I16)).unwrap();
            for y in 0..output.height {
                for x in 0..output.width {
                    let (sy, sx) = (source(y, factor), source(x, factor));
                    let expected = 64.0 * (interpolate(&codes, size, size, sy, sx) + 20.0);
                    let found = result[usize::from(y) * usize::from(output.width) + usize::from(x)];
                    let error = (found - expected).abs();
                    assert!(error <= tolerance, "×{factor} at {y},{x}: {found}, expected {expected}, seed {seed:#x}");
                }
            }
        }
    }

    #[test]
    fn sum_with_a_map_rounds_once() {
        let seed = 0xb2;
        let mut random = Random(seed);
        let shape = Shape::map(1, 1, 500);
        let (small, big) = (random.codes(500, -128, 127), random.codes(500, -32768, 32767));
        let op = QOp::ResizeBilinear {
            input: QTerm { tensor: QTensorId(0), zero_point: 3, multiplier: 3_456_789 },
            residual: Some(QTerm { tensor: QTensorId(1), zero_point: 0, multiplier: 1_234_567 }),
            output: QTensorId(2),
            rows: vec![[0, 0]],
            columns: vec![[0, 1024]],
            weight_bits: 11,
            shift: 30,
            zero_point: 5,
            clamp: clamp(-100, 127),
        };
        let operands = [(shape, ElementType::I8, small.clone()), (shape, ElementType::I16, big.clone())];
        let codes = execute_alone(op, &operands, (shape, ElementType::I8)).unwrap();
        for (i, &code) in codes.iter().enumerate() {
            let sum = 256 * (small[i] as i128 - 3) * 3_456_789 + big[i] as i128 * 1_234_567;
            assert_eq!(code as i128, (5 + rounding_shift(sum, 30)).clamp(-100, 127), "element {i}, seed {seed:#x}");
        }
    }

    #[test]
    fn indices_outside_the_map_are_malformed() {
        let mut op = resize(2, 2, 4, QTerm { tensor: QTensorId(0), zero_point: 0, multiplier: 1 }, 8);
        if let QOp::ResizeBilinear { rows, .. } = &mut op {
            rows[3] = [2, 0];
        }
        let input = (Shape::map(2, 2, 1), ElementType::I8, vec![0.0; 4]);
        let error = execute_alone(op, &[input], (Shape::map(4, 4, 1), ElementType::I8)).unwrap_err();
        assert_eq!(error.code, ErrorCode::Malformed);
    }
}
