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

#[cfg(test)]
mod tests {
    use super::*;
    use crate::qmodel::{Bounds, Port, QRescale, QResidual, QStep, QTensor};
    use firmware::program::{Clamp, Requant};
    use firmware::tensor::Shape;

    const CLAMP: Clamp = Clamp { min: -128, max: 127 };
    const REQUANT: Requant = Requant { multiplier: 1 << 23, shift: 23 };

    /// A model of one step over tensors of these shapes, the last of which it writes.
    fn traffic_of(tensors: &[(Shape, ElementType)], op: QOp, kernel: Option<KernelId>) -> (Vec<u64>, u64) {
        let tensor = |&(shape, element): &(Shape, ElementType)| QTensor {
            name: String::new(),
            value: String::new(),
            shape,
            element,
            scale: 1.0,
            zero_point: 0,
            saturation_ppm: None,
        };
        let port = |id| Port { name: String::new(), tensor: QTensorId(id), kind: None };
        let last = tensors.len() as u32 - 1;
        let model = QModel {
            name: String::new(),
            system: String::new(),
            tensors: tensors.iter().map(tensor).collect(),
            steps: vec![QStep { name: String::new(), node: None, op, bounds: Bounds::default() }],
            inputs: (0..last).map(port).collect(),
            outputs: vec![port(last)],
            provenance: vec![],
        };
        let (tensors, scratch) = traffic(&model, &[kernel]);
        (tensors, scratch[0])
    }

    fn rescale(residual: QResidual) -> QRescale {
        let (bias, multipliers, shifts) = (vec![], vec![], vec![]);
        QRescale { pre_shift: 0, bias, multipliers, shifts, zero_point: 0, clamp: CLAMP, residual }
    }

    #[test]
    fn a_convolution_reads_its_windows_and_scratch_per_product() {
        let (input, output) = (Shape::map(4, 4, 2), Shape::map(4, 4, 8));
        let residual = QResidual::Scaled { tensor: QTensorId(1), zero_point: 0, multipliers: vec![] };
        let op = QOp::Conv2d {
            input: QTensorId(0),
            output: QTensorId(2),
            window: Window::square(3, 1, 1),
            groups: 1,
            weights: vec![],
            padding_codes: vec![],
            rescale: rescale(residual),
        };
        let tensors = [(input, ElementType::I8), (output, ElementType::I8), (output, ElementType::I8)];
        let gathered = 16 * 9 * 2;
        // Each port is touched once by the caller; the residual is read and the output written once.
        let expected = vec![32 + gathered, 128 + 128, 128 + 128];
        assert_eq!(traffic_of(&tensors, op, Some(KernelId::Direct)), (expected, 2 * (gathered + gathered * 8)));
    }

    #[test]
    fn a_linear_layer_reads_wide_inputs_where_they_lie_unless_they_are_gathered() {
        let op = || QOp::Linear {
            input: QTensorId(0),
            output: QTensorId(1),
            weights: vec![],
            wide: false,
            rescale: rescale(QResidual::None),
        };
        let (input, output) = (Shape::tokens(3, 10), Shape::tokens(3, 4));
        let of = |element, kernel| traffic_of(&[(input, element), (output, ElementType::I8)], op(), Some(kernel));
        assert_eq!(of(ElementType::I8, KernelId::Direct), (vec![30 + 30, 12 + 12], 2 * (30 + 120)));
        assert_eq!(of(ElementType::I16, KernelId::Direct), (vec![60 + 240, 24], 0));
        assert_eq!(of(ElementType::I16, KernelId::K4N16), (vec![60 + 60, 24], 2 * (30 + 120)));
    }

    #[test]
    fn attention_reads_keys_and_values_once_per_query() {
        let op = QOp::Attention {
            query: QTensorId(0),
            key: QTensorId(1),
            value: QTensorId(2),
            output: QTensorId(3),
            heads: 2,
            exponent: REQUANT,
            exp_table: vec![],
            requant: REQUANT,
            zero_point: 0,
            clamp: CLAMP,
        };
        let (tensors, scratch) = traffic_of(&[(Shape::tokens(5, 8), ElementType::I8); 4], op, None);
        assert_eq!(tensors, [40 + 40, 40 + 200, 40 + 200, 40 + 40]);
        assert_eq!(scratch, 5 * 4 * 2 * 25 + 2 * (40 + 200) + 8 * 200);
    }

    #[test]
    fn an_operand_that_is_read_twice_counts_twice() {
        let term = crate::qmodel::QTerm { tensor: QTensorId(0), zero_point: 0, multiplier: 1 };
        let output = QTensorId(1);
        let op = QOp::Add { first: term, second: term, output, shift: 0, zero_point: 0, clamp: CLAMP };
        assert_eq!(traffic_of(&[(Shape::vector(6), ElementType::I8); 2], op, None), (vec![18, 12], 0));
    }
}
