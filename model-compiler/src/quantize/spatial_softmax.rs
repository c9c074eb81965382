//! Softmax over all pixels, and the pixel that it expects.

use super::factors::bits;
use super::softmax::exponent;
use super::{Builder, bounds_of, tables};
use crate::error::{Error, ErrorCode, Result};
use crate::ir::Node;
use crate::qmodel::QOp;

/// Most rows and most columns: `2^6·Σ e·column ≤ 2^6·2^23·2^16·255 < 2^53`.
const MAX_SIDE: u16 = 256;

impl Builder<'_> {
    pub(super) fn spatial_softmax(&mut self, node: &Node, temperature: f32) -> Result<()> {
        let (input, output) = (self.codes(node.inputs[0])?, self.tensor(node.output));
        let shape = self.model.tensor(input).shape;
        if shape.height.max(shape.width) > MAX_SIDE {
            let message = format!(
                "spatial softmax over {}×{} pixels, expected at most {MAX_SIDE}×{MAX_SIDE}",
                shape.height, shape.width
            );
            return Err(Error::new(ErrorCode::Numeric, "", message).with_help("reduce the network's resolution"));
        }
        let exponent = exponent(self.scale(input) / f64::from(temperature))?;
        let total = f64::from(shape.positions()) * f64::exp2(23.0);
        let last = f64::from(shape.height.max(shape.width) - 1);
        let products = [f64::from(u16::MAX) * f64::from(exponent.multiplier), 64.0 * total * last];
        let op = QOp::SpatialSoftmax { input, output, exponent, exp_table: tables::exp2_table() };
        self.step(node, op, bounds_of(bits(total), &products, 0.0));
        Ok(())
    }
}
