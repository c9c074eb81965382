//! Sums of cells that a second operand names.

use super::factors::{self, bits};
use super::{Builder, bounds_of};
use crate::error::{Error, ErrorCode, Result};
use crate::ir::{Clip, Node};
use crate::qmodel::{QOp, QTensorId};
use firmware::tensor::ElementType;

impl Builder<'_> {
    pub(super) fn gather_sum(&mut self, node: &Node) -> Result<()> {
        let (input, indices) = (self.codes(node.inputs[0])?, self.indices(node)?);
        let output = self.tensor(node.output);
        let cells = self.model.tensor(indices).shape.channels / 2;
        let bound = self.magnitude(input) * f64::from(cells);
        if bits(bound) > 28 {
            let message = format!("the sum of {cells} cells exceeds 28 bits");
            return Err(Error::new(ErrorCode::Numeric, "", message).with_help("gather fewer cells per position"));
        }
        let requant = factors::requant(self.scale(input) / self.scale(output))?;
        let op = QOp::GatherSum {
            input,
            indices,
            output,
            input_zero_point: self.zero_point(input),
            requant,
            zero_point: self.zero_point(output),
            clamp: self.clamp(output, Clip::NONE),
        };
        self.step(node, op, bounds_of(bits(bound), &[bound * f64::from(requant.multiplier)], 0.0));
        Ok(())
    }

    /// The indices, which must be stored as the numbers that they are.
    fn indices(&mut self, node: &Node) -> Result<QTensorId> {
        let id = self.tensor(node.inputs[1]);
        let tensor = self.model.tensor(id);
        if (tensor.element, tensor.scale, tensor.zero_point) == (ElementType::I8, 1.0, 0) {
            return Ok(id);
        }
        let message = format!("indices {}: found computed values, expected an input of cells", tensor.name);
        Err(Error::new(ErrorCode::Unsupported, "", message).with_help("gather by an input, not by a result"))
    }
}
