//! The independent model of the arithmetic: a quantized network executed in f64, step by step.
//!
//! Written from the normative page on numerics and the formulas at the structs of [`firmware::program`] alone; it
//! shares no arithmetic with the runtime, so equal bytes are evidence. Every value is an integer held in an f64 and
//! every operation on values is an f64 operation: integers below 2^53 and scaling by powers of two are exact there in
//! any order, `floor(a/b)` and `floor(√x)` too (numerics, "Why f64 reproduces it").
//!
//! That premise is checked, not assumed: each intermediate that could grow (accumulators, products, sums before a
//! rounding shift) passes through an exactness watch, and a step where one reaches 2^53 fails as
//! [`ErrorCode::Numeric`] and is named. So does a step whose output code does not fit its tensor's element type.
//!
//! One file per operator family: [`run`] walks the steps, [`execute`] does one. Convolutions become matrix products
//! over tiles of output positions, so memory stays bounded and all cores are used.

mod arithmetic;
mod attention;
mod branch_linear;
mod concat;
mod copy_box;
mod gates;
mod gather_sum;
mod inputs;
mod layer_norm;
mod operands;
mod pool;
mod rescale;
mod resize_bilinear;
mod sigmoid;
mod softmax;
mod spatial_softmax;
mod sum;
#[cfg(test)]
mod testing;
mod tokens;
mod waypoint_decoder;
mod weighted;

pub use inputs::encode_input;

use crate::error::{Error, ErrorCode, Result};
use crate::qmodel::{Port, QModel, QOp, QStep, QTensor, QTensorId, QTerm};
use arithmetic::Requantizer;
use firmware::tensor::ElementType;
use operands::{Operands, expect};

/// Executes the whole model in the order of `model.steps`.
///
/// `inputs` are codes in the order of `model.inputs` ([`encode_input`]); `observe` sees every step's index, the step
/// and its output codes. Returns the codes of `model.outputs`, in order. A tensor is freed after the last step that
/// reads it.
///
/// # Errors
/// [`ErrorCode::Malformed`] where the inputs, shapes and arrays of the model do not fit together or a tensor is read
/// before it is written; [`ErrorCode::Numeric`] where an intermediate reaches 2^53 or an output leaves its type.
pub fn run(
    model: &QModel,
    inputs: &[Vec<f64>],
    mut observe: impl FnMut(usize, &QStep, &[f64]),
) -> Result<Vec<Vec<f64>>> {
    let last_read = last_reads(model)?;
    let mut codes: Vec<Vec<f64>> = vec![Vec::new(); model.tensors.len()];
    expect("number of inputs", inputs.len(), model.inputs.len()).map_err(|e| e.within(&model.name))?;
    for (port, input) in model.inputs.iter().zip(inputs) {
        place_input(model, port, input, &mut codes)?;
    }
    for (position, step) in model.steps.iter().enumerate() {
        let output = execute(model, step, |id| codes[position_of(id)].as_slice())?;
        observe(position, step, &output);
        codes[position_of(step.op.output())] = output;
        for id in step.op.reads() {
            if last_read[position_of(id)] == position {
                codes[position_of(id)] = Vec::new();
            }
        }
    }
    let output = |port: &Port| {
        let tensor = model.tensor(port.tensor);
        let found = &codes[position_of(port.tensor)];
        expect("codes of the output", found.len(), elements(tensor)).map_err(|e| e.within(&port.name))?;
        Ok(found.clone())
    };
    model.outputs.iter().map(output).collect()
}

/// Executes one step: `operand` gives the codes of each tensor that the step reads; returns those it writes.
///
/// # Errors
/// As [`run`]; the location is the step's name.
pub fn execute<'a>(model: &QModel, step: &QStep, operand: impl Fn(QTensorId) -> &'a [f64]) -> Result<Vec<f64>> {
    let operands = Operands::new(model, &operand);
    let result = dispatch(&operands, &step.op).and_then(|codes| {
        check_codes(operands.tensor(step.op.output())?, &codes)?;
        Ok(codes)
    });
    result.map_err(|error| error.within(format!("step {}", step.name)))
}

/// The codes as the runtime stores them: little-endian elements of this type.
///
/// # Panics
/// On [`ElementType::Scratch`], which has no codes.
pub fn to_bytes(codes: &[f64], element: ElementType) -> Vec<u8> {
    match element {
        ElementType::I8 => codes.iter().flat_map(|&c| (c as i8).to_le_bytes()).collect(),
        ElementType::I16 => codes.iter().flat_map(|&c| (c as i16).to_le_bytes()).collect(),
        ElementType::I32 => codes.iter().flat_map(|&c| (c as i32).to_le_bytes()).collect(),
        ElementType::Scratch => panic!("scratch memory has no codes"),
    }
}

fn dispatch(operands: &Operands, op: &QOp) -> Result<Vec<f64>> {
    match op {
        QOp::Conv2d { input, output, window, groups, weights, padding_codes, rescale } => {
            let filter = weighted::Filter { window, groups: usize::from(*groups), weights, padding_codes };
            weighted::conv2d(operands, *input, *output, &filter, rescale)
        }
        QOp::Linear { input, output, weights, wide: _, rescale } => {
            weighted::linear(operands, *input, *output, weights, rescale)
        }
        QOp::MaxPool { input, output, window } => pool::max_pool(operands, *input, *output, window),
        QOp::AveragePool { input, output, window, input_zero_point, requant, zero_point, clamp } => {
            let term = QTerm { tensor: *input, zero_point: *input_zero_point, multiplier: requant.multiplier };
            pool::average_pool(operands, term, *output, window, &Requantizer::new(requant.shift, *zero_point, *clamp))
        }
        QOp::GlobalPool { first, second, output, shift, zero_point, clamp } => {
            let terms: Vec<QTerm> = std::iter::once(*first).chain(*second).collect();
            pool::global_pool(operands, &terms, *output, &Requantizer::new(*shift, *zero_point, *clamp))
        }
        QOp::Add { first, second, output, shift, zero_point, clamp } => {
            sum::of_terms(operands, &[*first, *second], *output, &Requantizer::new(*shift, *zero_point, *clamp))
        }
        QOp::Requantize { input, output, input_zero_point, requant, zero_point, clamp } => {
            let term = QTerm { tensor: *input, zero_point: *input_zero_point, multiplier: requant.multiplier };
            sum::of_terms(operands, &[term], *output, &Requantizer::new(requant.shift, *zero_point, *clamp))
        }
        QOp::ResizeBilinear { input, residual, output, rows, columns, weight_bits, shift, zero_point, clamp } => {
            let grid = resize_bilinear::Grid { rows, columns, weight_bits: *weight_bits };
            let requantizer = Requantizer::new(*shift, *zero_point, *clamp);
            resize_bilinear::resize_bilinear(operands, *input, *residual, *output, &grid, &requantizer)
        }
        QOp::Tokens { first, second, velocity, output, velocity_multipliers, position, shift, zero_point, clamp } => {
            let embedding = tokens::Embedding { velocity: *velocity, velocity_multipliers, position };
            let requantizer = Requantizer::new(*shift, *zero_point, *clamp);
            tokens::tokens(operands, &[*first, *second], *output, &embedding, &requantizer)
        }
        QOp::LayerNorm { input, output, first_row, epsilon, gains, offsets, shift, zero_point, clamp } => {
            let affine = layer_norm::Affine { epsilon: *epsilon, gains, offsets };
            let requantizer = Requantizer::new(*shift, *zero_point, *clamp);
            layer_norm::layer_norm(operands, *input, usize::from(*first_row), *output, &affine, &requantizer)
        }
        QOp::Attention { query, key, value, output, heads, exponent, exp_table, requant, zero_point, clamp } => {
            let softmax = softmax::Exponential::new(*exponent, exp_table)?;
            let requantizer = Requantizer::new(requant.shift, *zero_point, *clamp);
            let context = attention::Context { multiplier: f64::from(requant.multiplier), requantizer };
            let tensors = attention::Tensors { query: *query, key: *key, value: *value, output: *output };
            attention::attention(operands, &tensors, usize::from(*heads), &softmax, &context)
        }
        QOp::WaypointDecoder(decoder) => waypoint_decoder::waypoint_decoder(operands, decoder),
        QOp::CopyBox { input, output, begin, stride, size, before, border } => {
            let axis = |k: usize| copy_box::Span::new(begin[k], stride[k], size[k], before[k]);
            copy_box::copy_box(operands, *input, *output, [axis(0), axis(1), axis(2)], *border)
        }
        QOp::Concat { first, second, output, axis, zero_point, clamp } => {
            let sources = [first, second].map(|source| concat::Source {
                tensor: source.tensor,
                zero_point: f64::from(source.zero_point),
                multiplier: f64::from(source.requant.multiplier),
                requantizer: Requantizer::new(source.requant.shift, *zero_point, *clamp),
            });
            concat::concat(operands, &sources, *axis, *output)
        }
        QOp::Softmax { input, output, exponent, exp_table } => {
            softmax::softmax(operands, *input, *output, &softmax::Exponential::new(*exponent, exp_table)?)
        }
        QOp::GatherSum { input, indices, output, input_zero_point, requant, zero_point, clamp } => {
            let term = QTerm { tensor: *input, zero_point: *input_zero_point, multiplier: requant.multiplier };
            let requantizer = Requantizer::new(requant.shift, *zero_point, *clamp);
            gather_sum::gather_sum(operands, term, *indices, *output, &requantizer)
        }
        QOp::BranchLinear { input, command, output, branches, weights, wide: _, rescale } => {
            branch_linear::branch_linear(operands, *input, *command, *output, *branches, weights, rescale)
        }
        QOp::Sigmoid { input, output, input_zero_point, requant, tanh_table } => {
            let term = QTerm { tensor: *input, zero_point: *input_zero_point, multiplier: requant.multiplier };
            sigmoid::sigmoid(operands, term, requant.shift, *output, tanh_table)
        }
        QOp::SpatialSoftmax { input, output, exponent, exp_table } => {
            let exponential = softmax::Exponential::new(*exponent, exp_table)?;
            spatial_softmax::spatial_softmax(operands, *input, *output, &exponential)
        }
    }
}

fn position_of(id: QTensorId) -> usize {
    id.0 as usize
}

fn elements(tensor: &QTensor) -> usize {
    tensor.shape.elements() as usize
}

fn place_input(model: &QModel, port: &Port, input: &[f64], codes: &mut [Vec<f64>]) -> Result<()> {
    let tensor = model.tensor(port.tensor);
    expect("codes of the input", input.len(), elements(tensor))
        .and_then(|()| check_codes(tensor, input))
        .map_err(|e| e.within(format!("input {}", port.name)))?;
    codes[position_of(port.tensor)] = input.to_vec();
    Ok(())
}

/// Position of the last step that reads each tensor; outputs are read by no step that may free them.
fn last_reads(model: &QModel) -> Result<Vec<usize>> {
    let known = |id: QTensorId, place: &str| {
        let message = || format!("tensor {} of {} does not exist", id.0, model.tensors.len());
        let missing = || Error::new(ErrorCode::Malformed, place, message());
        model.tensors.get(position_of(id)).map(|_| position_of(id)).ok_or_else(missing)
    };
    let mut last = vec![usize::MAX; model.tensors.len()];
    for (position, step) in model.steps.iter().enumerate() {
        known(step.op.output(), &step.name)?;
        for id in step.op.reads() {
            last[known(id, &step.name)?] = position;
        }
    }
    for port in &model.inputs {
        known(port.tensor, &port.name)?;
    }
    for port in &model.outputs {
        last[known(port.tensor, &port.name)?] = usize::MAX;
    }
    Ok(last)
}

/// Every code is an integer of the tensor's element type.
fn check_codes(tensor: &QTensor, codes: &[f64]) -> Result<()> {
    let (min, max) = match tensor.element {
        ElementType::I8 => (-128.0, 127.0),
        ElementType::I16 => (-32768.0, 32767.0),
        ElementType::I32 => (-2147483648.0, 2147483647.0),
        ElementType::Scratch => return Err(Error::new(ErrorCode::Malformed, &tensor.name, "is scratch memory")),
    };
    let bad = |&code: &f64| !(min..=max).contains(&code) || code.fract() != 0.0;
    match codes.iter().position(bad) {
        None => Ok(()),
        Some(at) => {
            let message = format!("code {} at element {at}, expected an integer {min}..={max}", codes[at]);
            Err(Error::new(ErrorCode::Numeric, format!("tensor {}", tensor.name), message))
        }
    }
}

#[cfg(test)]
mod tests {
    use super::testing::{self, clamp};
    use super::*;
    use firmware::program::Requant;
    use firmware::tensor::Shape;

    /// `input → (·2) → middle → (+ input) → output`, all i16 vectors of three.
    fn doubling_chain() -> QModel {
        let shape = Shape::vector(3);
        let mut model = testing::model(&[
            ("input", shape, ElementType::I16),
            ("middle", shape, ElementType::I16),
            ("output", shape, ElementType::I16),
        ]);
        let wide = clamp(-32768, 32767);
        let double = QOp::Requantize {
            input: QTensorId(0),
            output: QTensorId(1),
            input_zero_point: 0,
            requant: Requant { multiplier: 1 << 23, shift: 22 },
            zero_point: 0,
            clamp: wide,
        };
        let term = |id| QTerm { tensor: QTensorId(id), zero_point: 0, multiplier: 1 };
        let add =
            QOp::Add { first: term(1), second: term(0), output: QTensorId(2), shift: 0, zero_point: 0, clamp: wide };
        model.steps = vec![testing::step("double", double), testing::step("add", add)];
        model.inputs = vec![testing::port("input", 0, None)];
        model.outputs = vec![testing::port("output", 2, None)];
        model
    }

    #[test]
    fn run_executes_in_order_and_shows_every_step() {
        let mut seen = Vec::new();
        let observe = |i: usize, step: &QStep, codes: &[f64]| seen.push((i, step.name.clone(), codes.to_vec()));
        let outputs = run(&doubling_chain(), &[vec![1.0, -5.0, 20000.0]], observe).unwrap();
        assert_eq!(outputs, [[3.0, -15.0, 32767.0]]);
        assert_eq!(seen[0], (0, "double".to_string(), vec![2.0, -10.0, 32767.0]));
        assert_eq!(seen[1], (1, "add".to_string(), vec![3.0, -15.0, 32767.0]));
    }

    #[test]
    fn run_refuses_wrong_inputs_and_unwritten_tensors() {
        let mut model = doubling_chain();
        let none = |_: usize, _: &QStep, _: &[f64]| {};
        assert_eq!(run(&model, &[], none).unwrap_err().code, ErrorCode::Malformed);
        assert_eq!(run(&model, &[vec![0.0]], none).unwrap_err().code, ErrorCode::Malformed);
        assert_eq!(run(&model, &[vec![0.0, 0.5, 0.0]], none).unwrap_err().code, ErrorCode::Numeric);
        model.steps.swap(0, 1);
        let error = run(&model, &[vec![0.0; 3]], none).unwrap_err();
        assert!(error.location.starts_with("step add"), "{error}");
        model.outputs[0].tensor = QTensorId(9);
        assert!(run(&model, &[vec![0.0; 3]], none).unwrap_err().message.contains("does not exist"));
    }

    #[test]
    fn a_code_outside_its_type_is_an_error_of_the_step() {
        let mut model = doubling_chain();
        model.tensors[1].element = ElementType::I8;
        let error = execute(&model, &model.steps[0], |_| &[1.0, 2.0, 64.0]).unwrap_err();
        assert_eq!(error.code, ErrorCode::Numeric);
        assert!(error.to_string().contains("code 128 at element 2"), "{error}");
    }

    #[test]
    fn inexact_intermediates_are_an_error_of_the_step() {
        let mut model = doubling_chain();
        model.tensors[0].element = ElementType::I32;
        if let QOp::Requantize { requant, .. } = &mut model.steps[0].op {
            *requant = Requant { multiplier: 1 << 23, shift: 52 };
        }
        let big = [f64::from(1 << 29), 0.0, 0.0];
        assert_eq!(execute(&model, &model.steps[0], |_| &big).unwrap(), [1.0, 0.0, 0.0]);
        let too_big = [f64::from(1 << 30), 0.0, 0.0];
        let error = execute(&model, &model.steps[0], |_| &too_big).unwrap_err();
        assert_eq!((error.code, error.location.as_str()), (ErrorCode::Numeric, "step double"));
    }

    #[test]
    fn bytes_are_little_endian_two_complement() {
        assert_eq!(to_bytes(&[-128.0, 0.0, 127.0], ElementType::I8), [0x80, 0, 0x7f]);
        assert_eq!(to_bytes(&[-2.0, 258.0], ElementType::I16), [0xfe, 0xff, 2, 1]);
        assert_eq!(to_bytes(&[-2147483648.0], ElementType::I32), [0, 0, 0, 0x80]);
    }
}
