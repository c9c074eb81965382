//! Concatenation: each operand brought to the output's scale.

use super::arithmetic::{Exactness, Requantizer};
use super::operands::{Operands, expect};
use crate::error::Result;
use crate::qmodel::QTensorId;
use firmware::program::Axis;
use firmware::tensor::Shape;

/// One operand with its factor.
pub(super) struct Source {
    pub(super) tensor: QTensorId,
    pub(super) zero_point: f64,
    pub(super) multiplier: f64,
    pub(super) requantizer: Requantizer,
}

/// `y = clamp(z_o + R((q − z)·M, n))`, the second operand behind the first along the axis.
pub(super) fn concat(operands: &Operands, sources: &[Source; 2], axis: Axis, output: QTensorId) -> Result<Vec<f64>> {
    let [first, second] = sources;
    let joined = joined(operands.shape(first.tensor)?, operands.shape(second.tensor)?, axis);
    let shape = operands.shape(output)?;
    for (what, found, expected) in [
        ("output rows", shape.height, joined[0]),
        ("output columns", shape.width, joined[1]),
        ("output channels", shape.channels, joined[2]),
    ] {
        expect(what, found.into(), expected)?;
    }
    let mut exact = Exactness::default();
    let mut requantized = |source: &Source| -> Result<Vec<f64>> {
        let codes = operands.codes(source.tensor)?.iter();
        let sums = codes.map(|code| (code - source.zero_point) * source.multiplier);
        Ok(sums.map(|sum| source.requantizer.code(sum, &mut exact)).collect())
    };
    let (front, behind) = (requantized(first)?, requantized(second)?);
    exact.finish()?;
    let run = |source: &Source| Ok::<_, crate::error::Error>(axis.run(operands.shape(source.tensor)?) as usize);
    let runs = front.chunks_exact(run(first)?).zip(behind.chunks_exact(run(second)?));
    Ok(runs.flat_map(|(front, behind)| front.iter().chain(behind).copied()).collect())
}

/// Height, width and channels of the result; 0 where the operands disagree.
fn joined(first: Shape, second: Shape, axis: Axis) -> [usize; 3] {
    let size = |along: Axis, a: u16, b: u16| match (along == axis, a == b) {
        (true, _) => usize::from(a) + usize::from(b),
        (false, true) => usize::from(a),
        (false, false) => 0,
    };
    [
        size(Axis::Height, first.height, second.height),
        size(Axis::Width, first.width, second.width),
        size(Axis::Channels, first.channels, second.channels),
    ]
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::error::ErrorCode;
    use crate::integer_reference::testing::{clamp, execute_alone, requant};
    use crate::qmodel::{QConcatSource, QOp};
    use firmware::tensor::ElementType;

    fn run(axis: Axis, shapes: [Shape; 2], output: Shape) -> Result<Vec<f64>> {
        let source = |tensor, zero_point, factor| QConcatSource {
            tensor: QTensorId(tensor),
            zero_point,
            requant: requant(factor),
        };
        let op = QOp::Concat {
            first: source(0, -10, 1.0),
            second: source(1, 0, 0.5),
            output: QTensorId(2),
            axis,
            zero_point: -10,
            clamp: clamp(-128, 100),
        };
        let codes = |shape: Shape, first: u64| (0..shape.elements()).map(|i| (first + i) as f64).collect();
        let operands =
            [(shapes[0], ElementType::I8, codes(shapes[0], 0)), (shapes[1], ElementType::I16, codes(shapes[1], 101))];
        execute_alone(op, &operands, (output, ElementType::I8))
    }

    #[test]
    fn operands_of_another_scale_and_type_meet_along_each_axis() {
        // The second operand: halves of 101, 102, … with ties up, less 10.
        let (first, second) = (Shape::map(1, 2, 2), Shape::map(1, 2, 1));
        let channels = run(Axis::Channels, [first, second], Shape::map(1, 2, 3)).unwrap();
        assert_eq!(channels, [0.0, 1.0, 41.0, 2.0, 3.0, 41.0]);
        let second = Shape::map(1, 1, 2);
        assert_eq!(run(Axis::Width, [first, second], Shape::map(1, 3, 2)).unwrap(), [0.0, 1.0, 2.0, 3.0, 41.0, 41.0]);
        let second = Shape::map(1, 2, 2);
        let rows = run(Axis::Height, [first, second], Shape::map(2, 2, 2)).unwrap();
        assert_eq!(rows, [0.0, 1.0, 2.0, 3.0, 41.0, 41.0, 42.0, 42.0]);
    }

    #[test]
    fn operands_that_do_not_meet_are_refused() {
        for (axis, second, output) in [
            (Axis::Channels, Shape::map(2, 2, 1), Shape::map(1, 2, 3)),
            (Axis::Channels, Shape::map(1, 2, 1), Shape::map(1, 2, 4)),
            (Axis::Height, Shape::map(1, 2, 1), Shape::map(2, 2, 2)),
        ] {
            let error = run(axis, [Shape::map(1, 2, 2), second], output).unwrap_err();
            assert_eq!(error.code, ErrorCode::Malformed, "{axis:?} {second:?} {output:?}");
        }
    }
}
