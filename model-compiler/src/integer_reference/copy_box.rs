//! A strided box inside a border: slice, pad, or both.

use super::operands::Operands;
use crate::error::{Error, ErrorCode, Result};
use crate::qmodel::QTensorId;

/// One axis of the box: output index `before + i` takes input index `begin + i·stride`, i in `0..size`.
#[derive(Clone, Copy)]
pub(super) struct Span {
    begin: usize,
    stride: usize,
    size: usize,
    before: usize,
}

impl Span {
    pub(super) fn new(begin: u16, stride: u16, size: u16, before: u16) -> Self {
        let [begin, stride, size, before] = [begin, stride, size, before].map(usize::from);
        Self { begin, stride, size, before }
    }

    /// Input index behind an output index; `None` in the border.
    fn source(&self, output: usize) -> Option<usize> {
        let i = output.checked_sub(self.before).filter(|i| *i < self.size)?;
        Some(self.begin + i * self.stride)
    }

    fn fits(&self, input: u16, output: u16) -> bool {
        let last = self.begin + self.size.saturating_sub(1) * self.stride;
        self.size > 0 && last < usize::from(input) && self.before + self.size <= usize::from(output)
    }
}

/// `y[before + i] = q[begin + i·stride]`, elsewhere the border; spans of height, width, channels.
pub(super) fn copy_box(
    operands: &Operands,
    input: QTensorId,
    output: QTensorId,
    spans: [Span; 3],
    border: i16,
) -> Result<Vec<f64>> {
    let (from, to) = (operands.shape(input)?, operands.shape(output)?);
    let axes = [(from.height, to.height), (from.width, to.width), (from.channels, to.channels)];
    if spans.iter().zip(axes).any(|(span, (from, to))| !span.fits(from, to)) {
        return Err(Error::new(ErrorCode::Malformed, "", format!("the box does not fit {from:?} and {to:?}")));
    }
    let codes = operands.codes(input)?;
    let [rows, columns, channels] = [to.height, to.width, to.channels].map(usize::from);
    let mut result = Vec::with_capacity(rows * columns * channels);
    for y in 0..rows {
        for x in 0..columns {
            let pixel = spans[0].source(y).zip(spans[1].source(x));
            let pixel = pixel.map(|(y, x)| (y * usize::from(from.width) + x) * usize::from(from.channels));
            let code = |c| pixel.zip(spans[2].source(c)).map_or(f64::from(border), |(pixel, c)| codes[pixel + c]);
            result.extend((0..channels).map(code));
        }
    }
    Ok(result)
}

#[cfg(test)]
mod tests {
    use crate::error::{ErrorCode, Result};
    use crate::integer_reference::testing::execute_alone;
    use crate::ir::{Op, Pad, Slice};
    use crate::qmodel::{QOp, QTensorId};
    use crate::reference::evaluate;
    use firmware::tensor::{ElementType, Shape};

    fn run(shape: Shape, output: Shape, boxed: [[u16; 3]; 4], border: i16) -> Result<Vec<f64>> {
        let [begin, stride, size, before] = boxed;
        let op = QOp::CopyBox { input: QTensorId(0), output: QTensorId(1), begin, stride, size, before, border };
        let codes = (0..shape.elements()).map(|i| i as f64).collect();
        execute_alone(op, &[(shape, ElementType::I16, codes)], (output, ElementType::I16))
    }

    #[test]
    fn a_box_in_a_border_is_a_slice_then_a_pad() {
        let shape = Shape::map(5, 6, 4);
        let slice = Op::Slice(Slice { begin: [1, 0, 2], end: [5, 6, 4], stride: [2, 3, 1] });
        let pad = Op::Pad(Pad { before: [0, 1, 2], after: [2, 0, 1], value: -7.0 });
        let values: Vec<f32> = (0..shape.elements()).map(|i| i as f32).collect();
        let inner = slice.output_shape(&[shape]).unwrap();
        let outer = pad.output_shape(&[inner]).unwrap();
        let taken = evaluate(&slice, &[shape], &[&values], inner);
        let expected = evaluate(&pad, &[inner], &[&taken], outer);
        let boxed = [[1, 0, 2], [2, 3, 1], [inner.height, inner.width, inner.channels], [0, 1, 2]];
        let found = run(shape, outer, boxed, -7).unwrap();
        assert!(found.iter().map(|code| *code as f32).eq(expected));
    }

    #[test]
    fn a_box_outside_is_refused() {
        let shape = Shape::map(2, 2, 2);
        let fits = [[0; 3], [1; 3], [2; 3], [0; 3]];
        assert!(run(shape, shape, fits, 0).is_ok());
        for at in 0..4 {
            let mut boxed = fits;
            boxed[at][at % 3] += 1;
            assert_eq!(run(shape, shape, boxed, 0).unwrap_err().code, ErrorCode::Malformed, "{boxed:?}");
        }
        let empty = [[0; 3], [1; 3], [2, 0, 2], [0; 3]];
        assert_eq!(run(shape, shape, empty, 0).unwrap_err().code, ErrorCode::Malformed);
    }
}
