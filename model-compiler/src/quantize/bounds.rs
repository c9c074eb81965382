//! Bounds of output codes: the graph's clips, inside a step where it can carry them, else as a step of their own.

use super::{Builder, bounds_of, code_range, factors};
use crate::error::Result;
use crate::ir::{Clip, Node};
use crate::qmodel::{QOp, QTensorId};
use firmware::program::Clamp;

impl Builder<'_> {
    /// Bounds of an output code: those of its type, and the codes nearest to the clip (ReLU: the zero point).
    pub(super) fn clamp(&self, id: QTensorId, clip: Clip) -> Clamp {
        let (min, max) = code_range(self.model.tensor(id).element);
        let code = |bound| self.code(id, bound).clamp(f64::from(min), f64::from(max)) as i16;
        Clamp { min: code(clip.min), max: code(clip.max) }
    }

    /// Which bounds of the output code are the clip's and not the ends of the code's range.
    pub(super) fn clipped(&self, id: QTensorId, clip: Clip) -> [bool; 2] {
        let (min, max) = code_range(self.model.tensor(id).element);
        [self.code(id, clip.min) >= f64::from(min), self.code(id, clip.max) <= f64::from(max)]
    }

    /// The code nearest to a real value, whatever its type holds.
    pub(super) fn code(&self, id: QTensorId, real: f32) -> f64 {
        let tensor = self.model.tensor(id);
        factors::round(f64::from(real) / tensor.scale) + f64::from(tensor.zero_point)
    }

    /// A clip that no layer took: the bounds go to the step that computes its operand, or into a change of scale.
    pub(super) fn clip(&mut self, node: &Node, clip: Clip) -> Result<()> {
        let input = self.codes(node.inputs[0])?;
        if let Some(step) = self.take_over(node, QOp::has_clamp) {
            let (next, clipped) = (self.clamp(input, clip), self.clipped(input, clip));
            let step = &mut self.model.steps[step];
            if let Some(clamp) = step.op.clamp_mut() {
                let within = |code: i16| code.clamp(next.min, next.max);
                *clamp = Clamp { min: within(clamp.min), max: within(clamp.max) };
            }
            let before = step.bounds.clipped;
            step.bounds.clipped = [before[0] || clipped[0], before[1] || clipped[1]];
            return Ok(());
        }
        let output = self.tensor(node.output);
        let requant = factors::requant(self.scale(input) / self.scale(output))?;
        let op = QOp::Requantize {
            input,
            output,
            input_zero_point: self.zero_point(input),
            requant,
            zero_point: self.zero_point(output),
            clamp: self.clamp(output, clip),
        };
        let bound = self.magnitude(input);
        let mut bounds = bounds_of(factors::bits(bound), &[bound * f64::from(requant.multiplier)], 0.0);
        bounds.clipped = self.clipped(output, clip);
        self.step(node, op, bounds);
        Ok(())
    }
}
