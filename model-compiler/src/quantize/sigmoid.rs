//! Logistic function of each element.

use super::factors::{self, bits};
use super::{Builder, bounds_of, tables};
use crate::error::Result;
use crate::ir::Node;
use crate::qmodel::QOp;

/// Factors to Q12 between which a code's step moves. Above, one step is beyond the table; below, the largest code
/// rounds to 0.
const FACTORS: (f64, f64) = (1.0 / (1u64 << 29) as f64, (1u64 << 17) as f64);

impl Builder<'_> {
    pub(super) fn sigmoid(&mut self, node: &Node) -> Result<()> {
        let (input, output) = (self.codes(node.inputs[0])?, self.tensor(node.output));
        let factor = self.scale(input) * f64::exp2(12.0);
        let requant = factors::requant(factor.clamp(FACTORS.0, FACTORS.1))?;
        let bound = self.magnitude(input);
        let (input_zero_point, tanh_table) = (self.zero_point(input), tables::tanh_table());
        let op = QOp::Sigmoid { input, output, input_zero_point, requant, tanh_table };
        self.step(node, op, bounds_of(bits(bound), &[bound * f64::from(requant.multiplier)], 0.0));
        Ok(())
    }
}
