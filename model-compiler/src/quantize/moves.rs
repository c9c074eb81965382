//! Operators that move codes: slice, pad, concat.

use super::factors::{self, bits};
use super::{Builder, bounds_of};
use crate::error::{Error, ErrorCode, Result};
use crate::ir::{Axis, Node, Pad, Shape, Slice};
use crate::qmodel::{Bounds, QConcatSource, QOp, QTensorId};

/// Sizes along height, width and channels.
fn axes(shape: Shape) -> [u16; 3] {
    [shape.height, shape.width, shape.channels]
}

impl Builder<'_> {
    pub(super) fn slice(&mut self, node: &Node, slice: &Slice) -> Result<()> {
        let (input, output) = (self.codes(node.inputs[0])?, self.tensor(node.output));
        let op = QOp::CopyBox {
            input,
            output,
            begin: slice.begin,
            stride: slice.stride,
            size: axes(self.graph.value(node.output).shape),
            before: [0; 3],
            border: self.zero_point(output),
        };
        self.step(node, op, Bounds::default());
        Ok(())
    }

    /// A border around the operand; where a slice gave it, both are one step.
    pub(super) fn pad(&mut self, node: &Node, pad: &Pad) -> Result<()> {
        let input = self.codes(node.inputs[0])?;
        let code = self.border(input, pad.value)?;
        let unbordered = |op: &QOp| matches!(op, QOp::CopyBox { before: [0, 0, 0], .. });
        let inner = axes(self.graph.value(node.inputs[0]).shape);
        if let Some(step) =
            self.take_over(node, |op| unbordered(op) && matches!(op, QOp::CopyBox { size, .. } if *size == inner))
        {
            if let QOp::CopyBox { before, border, .. } = &mut self.model.steps[step].op {
                (*before, *border) = (pad.before, code);
            }
            return Ok(());
        }
        let output = self.tensor(node.output);
        let (begin, stride) = ([0; 3], [1; 3]);
        let op = QOp::CopyBox { input, output, begin, stride, size: inner, before: pad.before, border: code };
        self.step(node, op, Bounds::default());
        Ok(())
    }

    /// The code of a border, which may be half a step off as any other code.
    fn border(&self, map: QTensorId, value: f32) -> Result<i16> {
        let (min, max) = super::code_range(self.model.tensor(map).element);
        let code = self.code(map, value);
        if (f64::from(min)..=f64::from(max)).contains(&code) {
            return Ok(code as i16);
        }
        let real = |code: i16| self.scale(map) * (f64::from(code) - f64::from(self.zero_point(map)));
        let message = format!("border of {value}: the codes of the map reach from {} to {}", real(min), real(max));
        Err(Error::new(ErrorCode::Numeric, "", message)
            .with_help("pad with a value that the map itself may hold; a max pool has padding of its own"))
    }

    pub(super) fn concat(&mut self, node: &Node, axis: Axis) -> Result<()> {
        let [first, second] = node.inputs[..] else {
            let message = format!("{} operands, expected 2", node.inputs.len());
            return Err(Error::new(ErrorCode::Unsupported, "", message)
                .with_help("run the passes on the graph: they join pair by pair"));
        };
        let operands = [self.codes(first)?, self.codes(second)?];
        let output = self.tensor(node.output);
        let mut products = [0.0; 2];
        let mut sources = Vec::with_capacity(2);
        for (&tensor, product) in operands.iter().zip(&mut products) {
            let requant = factors::requant(self.scale(tensor) / self.scale(output))?;
            *product = self.magnitude(tensor) * f64::from(requant.multiplier);
            sources.push(QConcatSource { tensor, zero_point: self.zero_point(tensor), requant });
        }
        let op = QOp::Concat {
            first: sources[0],
            second: sources[1],
            output,
            axis,
            zero_point: self.zero_point(output),
            clamp: self.clamp(output, crate::ir::Clip::NONE),
        };
        let largest = operands.iter().map(|&tensor| self.magnitude(tensor)).fold(0.0, f64::max);
        self.step(node, op, bounds_of(bits(largest), &products, 0.0));
        Ok(())
    }
}
