//! Sums of cells that a second operand names.

use super::arithmetic::{Exactness, Requantizer};
use super::operands::{Operands, expect, positions};
use crate::error::{Error, ErrorCode, Result};
use crate::qmodel::{QTensorId, QTerm};

/// `y_ijc = clamp(z_o + R(Σ_k (q[p_ijk]_c − z)·M, n))`; an index outside the map means the nearest row or column.
pub(super) fn gather_sum(
    operands: &Operands,
    map: QTerm,
    indices: QTensorId,
    output: QTensorId,
    requantizer: &Requantizer,
) -> Result<Vec<f64>> {
    let (shape, out_shape, index_shape) =
        (operands.shape(map.tensor)?, operands.shape(output)?, operands.shape(indices)?);
    expect("output channels", out_shape.channels.into(), shape.channels.into())?;
    expect("rows of indices", index_shape.height.into(), out_shape.height.into())?;
    expect("columns of indices", index_shape.width.into(), out_shape.width.into())?;
    if !index_shape.channels.is_multiple_of(2) {
        let message = format!("{} channels of indices, expected pairs", index_shape.channels);
        return Err(Error::new(ErrorCode::Malformed, "", message));
    }
    let (codes, channels) = (operands.codes(map.tensor)?, usize::from(shape.channels));
    let cell = |pair: &[f64]| {
        let row = pair[0].max(0.0).min(f64::from(shape.height) - 1.0) as usize;
        let column = pair[1].max(0.0).min(f64::from(shape.width) - 1.0) as usize;
        &codes[(row * usize::from(shape.width) + column) * channels..][..channels]
    };
    let mut exact = Exactness::default();
    let mut result = Vec::with_capacity(positions(out_shape) * channels);
    for pairs in operands.codes(indices)?.chunks_exact(index_shape.channels.into()) {
        let mut sums = vec![0.0; channels];
        for pair in pairs.chunks_exact(2) {
            sums.iter_mut().zip(cell(pair)).for_each(|(sum, code)| *sum += code - f64::from(map.zero_point));
        }
        result.extend(sums.iter().map(|sum| requantizer.code(sum * f64::from(map.multiplier), &mut exact)));
    }
    exact.finish()?;
    Ok(result)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::integer_reference::testing::{clamp, execute_alone, requant};
    use crate::qmodel::QOp;
    use firmware::tensor::{ElementType, Shape};

    fn run(indices: (Shape, Vec<f64>), output: Shape) -> Result<Vec<f64>> {
        let op = QOp::GatherSum {
            input: QTensorId(0),
            indices: QTensorId(1),
            output: QTensorId(2),
            input_zero_point: 10,
            requant: requant(0.5),
            zero_point: -5,
            clamp: clamp(-128, 20),
        };
        // Rows of 2 cells of 2 channels: 10 and 11 in cell (0,0), up to 80 and 81 in cell (1,1), less the zero point.
        let map = vec![20.0, 21.0, 40.0, 41.0, 60.0, 61.0, 90.0, 91.0];
        let operands = [(Shape::map(2, 2, 2), ElementType::I8, map), (indices.0, ElementType::I8, indices.1)];
        execute_alone(op, &operands, (output, ElementType::I8))
    }

    #[test]
    fn cells_are_summed_around_the_zero_point_rounded_once_and_clamped() {
        // (0,0) twice: 10 + 10 and 11 + 11; (0,1) and, from outside, (1,0): 30 + 50 and 31 + 51, beyond the bound.
        let indices = vec![0.0, 0.0, 0.0, 0.0, 0.0, 1.0, 127.0, -128.0];
        let found = run((Shape::map(1, 2, 4), indices), Shape::map(1, 2, 2)).unwrap();
        assert_eq!(found, [5.0, 6.0, 20.0, 20.0]);
        // One cell alone: a tie rounds up.
        assert_eq!(run((Shape::map(1, 1, 2), vec![0.0, 0.0]), Shape::map(1, 1, 2)).unwrap(), [0.0, 1.0]);
    }

    #[test]
    fn shapes_that_do_not_fit_are_refused() {
        for (indices, output) in [
            (Shape::map(1, 1, 3), Shape::map(1, 1, 2)),
            (Shape::map(2, 1, 2), Shape::map(1, 1, 2)),
            (Shape::map(1, 2, 2), Shape::map(1, 1, 2)),
            (Shape::map(1, 1, 2), Shape::map(1, 1, 3)),
        ] {
            let values = vec![0.0; indices.elements() as usize];
            let error = run((indices, values), output).unwrap_err();
            assert_eq!(error.code, ErrorCode::Malformed, "{indices:?} {output:?}");
        }
    }
}
