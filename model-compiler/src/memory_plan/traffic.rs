//! Traffic: the bytes that an inference reads from and writes to each buffer, which decides what belongs into the
//! fastest memory.
//!
//! A measure, not a simulation: known from shapes and kernels alone, and the same on every machine. An element counts
//! once for every time that the loops of the portable kernels name it; what a compiler keeps in registers or a cache
//! saves counts all the same. Weights and tables lie in flash and count nothing.
//!
//! | step | reads |
//! |---|---|
//! | convolution, linear layer | the input once per window that holds it, written to scratch as `i16`; scratch once per product |
//! | linear layer on `i16`, kernel direct | the input once per product |
//! | attention | keys and values once per query, scratch once per product and twice per sum |
//! | pool | the input once per window that holds it |
//! | bilinear resize | four elements of the input per output |
//! | waypoint decoder | scratch once per product of the hidden state |
//! | everything else, residuals, `Add` | every operand once |
//!
//! Every output is written once; the caller writes each input and reads each output once.

use super::needs::tensor_bytes;
use crate::qmodel::{QModel, QOp, QTensorId};
use firmware::program::{KernelId, Window};
use firmware::tensor::ElementType;

/// Bytes of a widened code.
const WIDE: u64 = 2;
/// Bytes of an accumulator.
const SUM: u64 = 4;

/// Traffic per tensor, and of the scratch per step of the model; `kernels` is per step.
pub(super) fn traffic(model: &QModel, kernels: &[Option<KernelId>]) -> (Vec<u64>, Vec<u64>) {
    let mut counter = Counter { model, tensors: vec![0; model.tensors.len()] };
    model.inputs.iter().chain(&model.outputs).for_each(|port| counter.once(port.tensor));
    let scratch = model.steps.iter().zip(kernels).map(|(step, kernel)| counter.step(&step.op, *kernel)).collect();
    (counter.tensors, scratch)
}

struct Counter<'a> {
    model: &'a QModel,
    tensors: Vec<u64>,
}

impl Counter<'_> {
    /// Counts the tensors of a step and returns what its scratch sees.
    fn step(&mut self, op: &QOp, kernel: Option<KernelId>) -> u64 {
        self.once(op.output());
        let mut others = op.reads();
        let mut apart = |tensor: QTensorId| {
            let at = others.iter().position(|read| *read == tensor);
            at.map(|at| others.remove(at));
        };
        let scratch = match op {
            QOp::Conv2d { input, output, window, groups, .. } => {
                apart(*input);
                let gathered = self.windows(*input, *output, *window);
                let products = gathered * (self.channels(*output) / u64::from(*groups).max(1));
                self.add(*input, gathered);
                WIDE * (gathered + products)
            }
            QOp::Linear { input, output, .. } | QOp::BranchLinear { input, output, .. } => {
                apart(*input);
                let tensor = self.model.tensor(*input);
                let products = tensor.shape.elements() * self.channels(*output);
                if tensor.element == ElementType::I16 && kernel != Some(KernelId::K4N16) {
                    self.add(*input, WIDE * products);
                    0
                } else {
                    self.once(*input);
                    WIDE * (tensor.shape.elements() + products)
                }
            }
            QOp::MaxPool { input, output, window } | QOp::AveragePool { input, output, window, .. } => {
                apart(*input);
                let reads = self.windows(*input, *output, *window) * self.element_bytes(*input);
                self.add(*input, reads);
                0
            }
            QOp::ResizeBilinear { input, output, .. } => {
                apart(input.tensor);
                let reads = 4 * self.model.tensor(*output).shape.elements() * self.element_bytes(input.tensor);
                self.add(input.tensor, reads);
                0
            }
            QOp::Attention { query, key, value, heads, .. } => {
                apart(*key);
                apart(*value);
                let shape = self.model.tensor(*query).shape;
                let tokens = u64::from(shape.positions());
                let products = tokens * shape.elements();
                self.add(*key, products);
                self.add(*value, products);
                // A logit is written, compared, read for its power, written as that and read for the mix.
                let logits = 5 * SUM * u64::from(*heads) * tokens * tokens;
                logits + WIDE * (shape.elements() + products) + 2 * SUM * products
            }
            QOp::WaypointDecoder(decoder) => {
                let hidden = self.channels(decoder.hidden);
                let waypoints = u64::from(self.model.tensor(decoder.output).shape.height);
                WIDE * waypoints * 3 * hidden * hidden
            }
            _ => 0,
        };
        others.into_iter().for_each(|tensor| self.once(tensor));
        scratch
    }

    fn add(&mut self, tensor: QTensorId, bytes: u64) {
        self.tensors[tensor.0 as usize] += bytes;
    }

    fn once(&mut self, tensor: QTensorId) {
        self.add(tensor, tensor_bytes(self.model, tensor));
    }

    /// Elements of the input that all windows hold together, padding included.
    fn windows(&self, input: QTensorId, output: QTensorId, window: Window) -> u64 {
        let positions = u64::from(self.model.tensor(output).shape.positions());
        positions * u64::from(window.kernel_h) * u64::from(window.kernel_w) * self.channels(input)
    }

    fn channels(&self, tensor: QTensorId) -> u64 {
        self.model.tensor(tensor).shape.channels.into()
    }

    fn element_bytes(&self, tensor: QTensorId) -> u64 {
        self.model.tensor(tensor).element.bytes().into()
    }
}
