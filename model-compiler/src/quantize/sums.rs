//! Operators that add stored operands with one rounding: pools, add, resize.

use super::factors::{self, Factor, Terms, bits};
use super::{Builder, bounds_of, tables};
use crate::error::{Error, ErrorCode, Result};
use crate::ir::{Clip, Node, ValueId};
use crate::qmodel::{Bounds, QOp, QTensorId, QTerm};
use firmware::program::Window;

impl Builder<'_> {
    fn term(&self, tensor: QTensorId, multiplier: i32) -> QTerm {
        QTerm { tensor, zero_point: self.zero_point(tensor), multiplier }
    }

    /// The factor of a stored operand that enters as a sum of `count` codes divided by `divisor`.
    fn factor(&self, tensor: QTensorId, output: QTensorId, count: f64, divisor: f64) -> Factor {
        Factor { m: self.scale(tensor) / (self.scale(output) * divisor), bound: self.magnitude(tensor) * count }
    }

    fn sum_bounds(terms: &Terms, accumulator: f64) -> Bounds {
        bounds_of(bits(accumulator), &[terms.bound], terms.rounding)
    }

    pub(super) fn average_pool(&mut self, node: &Node, window: &Window) -> Result<()> {
        let (input, output) = (self.tensor(node.inputs[0]), self.tensor(node.output));
        let count = f64::from(window.kernel_h) * f64::from(window.kernel_w);
        let bound = self.magnitude(input) * count;
        if bits(bound) > 28 {
            return Err(Error::new(ErrorCode::Numeric, "", "the sum of a pooling window exceeds 28 bits"));
        }
        let requant = factors::requant(self.scale(input) / (self.scale(output) * count))?;
        let op = QOp::AveragePool {
            input,
            output,
            window: *window,
            input_zero_point: self.zero_point(input),
            requant,
            zero_point: self.zero_point(output),
            clamp: self.clamp(output, Clip::NONE),
        };
        self.step(node, op, bounds_of(bits(bound), &[bound * f64::from(requant.multiplier)], 0.0));
        Ok(())
    }

    pub(super) fn global_pool(&mut self, node: &Node) -> Result<()> {
        let output = self.tensor(node.output);
        let maps: Vec<QTensorId> = node.inputs.iter().map(|&v| self.tensor(v)).collect();
        let positions = |id: ValueId| f64::from(self.graph.value(id).shape.positions());
        let factors: Vec<Factor> = maps
            .iter()
            .zip(&node.inputs)
            .map(|(&map, &value)| self.factor(map, output, positions(value), positions(value)))
            .collect();
        let terms = factors::terms(&factors, 0.0, 40)?;
        let largest = factors.iter().map(|f| f.bound).fold(0.0, f64::max);
        let op = QOp::GlobalPool {
            first: self.term(maps[0], terms.multipliers[0]),
            second: maps.get(1).map(|&map| self.term(map, terms.multipliers[1])),
            output,
            shift: terms.shift,
            zero_point: self.zero_point(output),
            clamp: self.clamp(output, Clip::NONE),
        };
        self.step(node, op, Self::sum_bounds(&terms, largest));
        Ok(())
    }

    pub(super) fn add(&mut self, node: &Node, clip: Clip) -> Result<()> {
        let output = self.tensor(node.output);
        let (a, b) = (self.tensor(node.inputs[0]), self.tensor(node.inputs[1]));
        let factors = [self.factor(a, output, 1.0, 1.0), self.factor(b, output, 1.0, 1.0)];
        let terms = factors::terms(&factors, 0.0, 40)?;
        let op = QOp::Add {
            first: self.term(a, terms.multipliers[0]),
            second: self.term(b, terms.multipliers[1]),
            output,
            shift: terms.shift,
            zero_point: self.zero_point(output),
            clamp: self.clamp(output, clip),
        };
        let mut bounds = Self::sum_bounds(&terms, factors[0].bound.max(factors[1].bound));
        bounds.clipped = self.clipped(output, clip);
        self.step(node, op, bounds);
        Ok(())
    }

    pub(super) fn resize_bilinear(&mut self, node: &Node, factor: (u16, u16)) -> Result<()> {
        let output = self.tensor(node.output);
        let input = self.tensor(node.inputs[0]);
        let residual = node.inputs.get(1).map(|&value| self.tensor(value));
        let (from, to) = (self.model.tensor(input).shape, self.model.tensor(output).shape);
        let weight_bits = tables::resize_weight_bits([factor.0, factor.1]);
        let mut factors = vec![self.factor(input, output, 256.0, 256.0)];
        factors.extend(residual.map(|r| self.factor(r, output, 1.0, 1.0)));
        let terms = factors::terms(&factors, 0.0, 40)?;
        let op = QOp::ResizeBilinear {
            input: self.term(input, terms.multipliers[0]),
            residual: residual.map(|r| self.term(r, terms.multipliers[1])),
            output,
            rows: tables::resize_axis(from.height, to.height, weight_bits),
            columns: tables::resize_axis(from.width, to.width, weight_bits),
            weight_bits,
            shift: terms.shift,
            zero_point: self.zero_point(output),
            clamp: self.clamp(output, Clip::NONE),
        };
        let weighted = self.magnitude(input) * f64::exp2(2.0 * f64::from(weight_bits));
        self.step(node, op, Self::sum_bounds(&terms, weighted));
        Ok(())
    }
}
