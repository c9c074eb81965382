//! Softmax over the channels of each position.

use super::factors::{self, bits};
use super::{Builder, bounds_of, tables};
use crate::error::{Error, ErrorCode, Result};
use crate::ir::Node;
use crate::qmodel::QOp;
use firmware::program::Requant;

/// `S ≤ 32767·N < 2^30` keeps the dividend `2^(c+22)` of the reciprocal at 2^52 or less.
const MAX_CHANNELS: u16 = 1 << 15;

/// Factors between which the exponent of a distance of codes moves. Above, one step is already beyond 31 powers of two;
/// below, the largest distance rounds to none.
const EXPONENT_FACTORS: (f64, f64) = (1.0 / (1u64 << 29) as f64, (1u64 << 22) as f64);

/// From a distance of logits of this scale to the base-2 exponent, Q16.
pub(super) fn exponent(scale: f64) -> Result<Requant> {
    let factor = scale * std::f64::consts::LOG2_E * f64::exp2(16.0);
    factors::requant(factor.clamp(EXPONENT_FACTORS.0, EXPONENT_FACTORS.1))
}

impl Builder<'_> {
    pub(super) fn softmax(&mut self, node: &Node) -> Result<()> {
        let (input, output) = (self.codes(node.inputs[0])?, self.tensor(node.output));
        let channels = self.model.tensor(input).shape.channels;
        if channels > MAX_CHANNELS {
            let message = format!("softmax over {channels} channels, expected at most {MAX_CHANNELS}");
            return Err(Error::new(ErrorCode::Numeric, "", message)
                .with_help("end the network at the logits: the largest of them is the largest probability"));
        }
        let exponent = exponent(self.scale(input))?;
        let (distance, sum) = (f64::from(u16::MAX), f64::from(channels) * 32767.0);
        // e·R_s < 2^15·2^23: R_s is largest where S is a power of two.
        let products =
            [distance * f64::from(exponent.multiplier), f64::exp2(38.0), f64::exp2(f64::from(bits(sum)) + 22.0)];
        let op = QOp::Softmax { input, output, exponent, exp_table: tables::exp2_table() };
        self.step(node, op, bounds_of(bits(sum), &products, 0.0));
        Ok(())
    }
}
