//! What the quantizer makes of operators that move and bound values.

use super::*;
use crate::calibrate::calibrate;
use crate::ir::{Axis, BranchLinear, Clip, InputKind, Linear, Pad, Slice, Weights};
use firmware::program::Requant;
use std::sync::Arc;

const ONE: Requant = Requant { multiplier: 1 << 23, shift: 23 };

fn image(shape: Shape) -> (Graph, ValueId) {
    let mut graph = Graph::default();
    let rgb = graph.push_input("rgb", InputKind::Image, shape);
    (graph, rgb)
}

/// A 1×1 convolution to 4 channels; its results lie around `center`.
fn conv(graph: &mut Graph, name: &str, input: ValueId, center: f32) -> ValueId {
    let channels = usize::from(graph.value(input).shape.channels);
    let data = (0..4 * channels).map(|i| (i * 7 % 11) as f32 / 500.0 - 0.01).collect();
    let weights = Arc::new(Weights { shape: vec![4, 1, 1, channels], data });
    let bias = Some(Arc::new(vec![center; 4]));
    let window = Window::square(1, 1, 0);
    let conv = Conv2d { weights, bias, window, groups: 1, normalization: None, clip: Clip::NONE };
    graph.push(name, Op::Conv2d(conv), &[input]).unwrap()
}

fn quantized(graph: &mut Graph, output: ValueId) -> Result<QModel> {
    graph.outputs.push(output);
    let (input, _) = graph.inputs().next().unwrap();
    let count = graph.value(input).shape.elements();
    let frames = [vec![(0..count).map(|i| (i * 37 % 256) as f32).collect()]];
    let statistics = calibrate(graph, &frames, |_, _| ())?;
    quantize(graph, &frames, &statistics, &QuantizeOptions::default(), |_, _| ())
}

#[test]
fn a_dilated_pool_is_refused_by_name() {
    let (mut graph, rgb) = image(Shape::map(6, 6, 3));
    let x = conv(&mut graph, "x", rgb, 0.0);
    let window = Window { dilation_h: 2, dilation_w: 2, ..Window::square(2, 1, 0) };
    let pool = graph.push("pool", Op::MaxPool(window), &[x]).unwrap();
    let error = quantized(&mut graph, pool).unwrap_err();
    assert_eq!(
        error.to_string(),
        "node pool: max_pool of dilation 2×2 has no integer form\n  help: use a pool of dilation 1"
    );
}

fn names(model: &QModel) -> Vec<(&str, &str)> {
    model.steps.iter().map(|step| (step.name.as_str(), step.op.name())).collect()
}

#[test]
fn operands_of_a_concat_alone_are_moved_and_others_are_rescaled() {
    let (mut graph, rgb) = image(Shape::map(4, 4, 3));
    let (a, b) = (conv(&mut graph, "a", rgb, 0.0), conv(&mut graph, "b", rgb, 3.0));
    let both = graph.push("both", Op::Concat(Axis::Width), &[a, b]).unwrap();
    graph.outputs.push(a);
    let model = quantized(&mut graph, both).unwrap();
    let Some(QOp::Concat { first, second, output, .. }) = model.steps.last().map(|step| &step.op) else {
        panic!("{:?}", names(&model))
    };
    assert_eq!((second.requant, second.zero_point), (ONE, model.tensor(*output).zero_point as i16));
    assert_ne!(first.requant, ONE, "another reader needs the finer scale");
}

#[test]
fn a_pool_takes_the_bounds_behind_it() {
    let (mut graph, rgb) = image(Shape::map(4, 4, 3));
    let a = conv(&mut graph, "a", rgb, 0.0);
    let pool = graph.push("pool", Op::AveragePool(Window::square(2, 2, 0)), &[a]).unwrap();
    let clip = graph.push("clip", Op::Clip(Clip { min: 0.0, max: 1.0 }), &[pool]).unwrap();
    let model = quantized(&mut graph, clip).unwrap();
    assert_eq!(names(&model), [("a", "conv2d"), ("clip", "average_pool")]);
    let step = &model.steps[1];
    let QOp::AveragePool { clamp, zero_point, output, .. } = &step.op else { unreachable!("by its name") };
    let largest = factors::round(1.0 / model.tensor(*output).scale) + f64::from(*zero_point);
    assert_eq!((clamp.min, f64::from(clamp.max)), (*zero_point, largest.min(127.0)));
    assert_eq!(step.bounds.clipped, [true, largest <= 127.0]);
    assert_eq!((model.tensor(*output).name.as_str(), model.outputs[0].name.as_str()), ("clip", "clip"));
}

#[test]
fn bounds_of_a_value_that_others_read_are_a_step() {
    let (mut graph, rgb) = image(Shape::map(4, 4, 3));
    let a = conv(&mut graph, "a", rgb, 0.0);
    let clip = graph.push("clip", Op::Clip(Clip::RELU), &[a]).unwrap();
    graph.outputs.push(a);
    let model = quantized(&mut graph, clip).unwrap();
    assert_eq!(names(&model), [("a", "conv2d"), ("clip", "requantize")]);
}

#[test]
fn slice_and_pad_are_one_step() {
    let (mut graph, rgb) = image(Shape::map(4, 4, 3));
    let slice = Slice { begin: [0; 3], end: [4, 4, 3], stride: [2, 2, 1] };
    let sliced = graph.push("slice", Op::Slice(slice), &[rgb]).unwrap();
    let pad = Pad { before: [0, 0, 1], after: [0, 0, 2], value: 7.0 };
    let padded = graph.push("pad", Op::Pad(pad), &[sliced]).unwrap();
    let model = quantized(&mut graph, padded).unwrap();
    assert_eq!(names(&model), [("pad", "copy_box")]);
    let QOp::CopyBox { stride, size, before, border, .. } = model.steps[0].op else { unreachable!("by its name") };
    assert_eq!((stride, size, before, border), ([2, 2, 1], [2, 2, 3], [0, 0, 1], 7 - 128));
}

#[test]
fn a_border_beyond_the_map_widens_its_range_and_one_beyond_fixed_codes_is_refused() {
    let pad = Pad { before: [1, 1, 0], after: [0; 3], value: 300.0 };
    let (mut graph, rgb) = image(Shape::map(4, 4, 3));
    let padded = graph.push("pad", Op::Pad(pad), &[rgb]).unwrap();
    let error = quantized(&mut graph, padded).unwrap_err();
    assert_eq!((error.code, error.location.as_str()), (ErrorCode::Numeric, "node pad"));
    assert!(error.to_string().contains("border of 300: the codes of the map reach from 0 to 255"), "{error}");
    let (mut graph, rgb) = image(Shape::map(4, 4, 3));
    let a = conv(&mut graph, "a", rgb, 0.0);
    let padded = graph.push("pad", Op::Pad(Pad { value: 20.0, ..pad }), &[a]).unwrap();
    let model = quantized(&mut graph, padded).unwrap();
    let output = model.tensor(model.outputs[0].tensor);
    assert!(output.scale * f64::from(127 - output.zero_point) > 19.9, "{output:?}");
}

#[test]
fn logits_are_kept_in_16_bits_up_to_the_largest_softmax() {
    let (mut graph, rgb) = image(Shape::vector(3));
    let logits = conv(&mut graph, "logits", rgb, 0.0);
    let softmax = graph.push("softmax", Op::Softmax, &[logits]).unwrap();
    let model = quantized(&mut graph, softmax).unwrap();
    assert_eq!(model.tensor(model.steps[0].op.output()).element, ElementType::I16);
    let output = model.tensor(model.outputs[0].tensor);
    assert_eq!((output.element, output.scale), (ElementType::I16, f64::exp2(-15.0)));

    let wide = |channels: u16| {
        let (mut graph, rgb) = image(Shape::vector(1));
        let weights = Weights { shape: vec![channels.into(), 1], data: vec![0.01; channels.into()] };
        let linear = Linear { weights: Arc::new(weights), bias: None, clip: Clip::NONE };
        let logits = graph.push("logits", Op::Linear(linear), &[rgb]).unwrap();
        let softmax = graph.push("softmax", Op::Softmax, &[logits]).unwrap();
        quantized(&mut graph, softmax)
    };
    assert!(wide(1 << 15).is_ok());
    let error = wide((1 << 15) + 1).unwrap_err();
    assert_eq!((error.code, error.location.as_str()), (ErrorCode::Numeric, "node softmax"));
    assert!(error.to_string().contains("softmax over 32769 channels, expected at most 32768"), "{error}");
}

/// Three branches of very different ranges, then a second layer of branches, then sigmoids of small values.
fn branches() -> (Graph, [ValueId; 2]) {
    let (mut graph, x) = image(Shape::vector(3));
    let command = graph.push_input("command", InputKind::Command, Shape::vector(1));
    let layer = |inputs: usize, amplitudes: [f32; 3]| {
        let data = amplitudes.iter().flat_map(|a| (0..4 * inputs).map(move |i| a * ((i * 7 % 11) as f32 - 4.0)));
        let weights = Weights { shape: vec![3, 4, inputs], data: data.collect() };
        let bias = amplitudes.iter().flat_map(|a| (0..4).map(move |i| a * 20.0 * i as f32)).collect();
        Op::BranchLinear(BranchLinear { weights: Arc::new(weights), bias: Some(Arc::new(bias)), clip: Clip::RELU })
    };
    let pooled = graph.push("pooled", Op::GlobalPool, &[x]).unwrap();
    let first = graph.push("first", layer(3, [0.01, 0.1, 1.0]), &[pooled, command]).unwrap();
    let second = graph.push("second", layer(4, [1e-3, 1e-4, 1e-5]), &[first, command]).unwrap();
    let sigmoid = graph.push("sigmoid", Op::Sigmoid, &[second]).unwrap();
    graph.outputs = vec![sigmoid];
    (graph, [first, sigmoid])
}

#[test]
fn a_branch_that_no_frame_selects_is_calibrated_like_any_other() {
    let (graph, [first, sigmoid]) = branches();
    let frames: Vec<_> = (0..40).map(|i| vec![vec![(i * 37 % 256) as f32, 9.0, 200.0], vec![1.0]]).collect();
    let statistics = calibrate(&graph, &frames, |_, _| ()).unwrap();
    let means = &statistics.of(first).channel_mean;
    assert_eq!(means.len(), 12, "four channels of three branches");
    assert!((means[9] / means[1] - 100.0).abs() < 0.1, "{means:?}");
    for bias_correction in [false, true] {
        let options = QuantizeOptions { bias_correction, ..Default::default() };
        let model = quantize(&graph, &frames, &statistics, &options, |_, _| ()).unwrap();
        let stored = |value: ValueId| model.tensors.iter().find(|t| t.value == graph.value(value).name).unwrap();
        assert_eq!((stored(first).element, stored(sigmoid).scale), (ElementType::I16, f64::exp2(-15.0)));
        for command in [1.0, 2.0, 3.0] {
            let raw = [vec![77.0, 9.0, 200.0], vec![command]];
            let expected = crate::reference::run(&graph, &raw, |_, _| ()).unwrap();
            let raw = raw.iter().map(|input| input.iter().map(|&x| f64::from(x)).collect::<Vec<_>>());
            let kinds = model.inputs.iter().filter_map(|port| port.kind);
            let codes: Vec<_> =
                kinds.zip(raw).map(|(kind, raw)| crate::integer_reference::encode_input(kind, &raw)).collect();
            let found = crate::integer_reference::run(&model, &codes, |_, _, _| ()).unwrap();
            for (found, expected) in found[0].iter().zip(&expected[0]) {
                let error = (found / 32768.0 - f64::from(*expected)).abs();
                assert!(error < 0.01, "command {command}: {found} for {expected}");
            }
        }
    }
}

#[test]
fn a_plain_layer_behind_branches_is_corrected_by_the_mean_of_all() {
    let means = [1.0, 2.0, 5.0, 10.0];
    assert_eq!(calibrate::branch_means(&means, 2, Some(1)), [5.0, 10.0]);
    assert_eq!(calibrate::branch_means(&means, 2, Some(7)), [5.0, 10.0], "the last serves further commands");
    assert_eq!(calibrate::branch_means(&means, 2, None), [3.0, 6.0]);
    assert_eq!(calibrate::branch_means(&means, 4, Some(3)), means);
}

#[test]
fn sums_of_cells_and_layers_behind_them_have_room_for_cells_that_were_not_seen() {
    let (mut graph, rgb) = image(Shape::map(2, 2, 3));
    let map = conv(&mut graph, "map", rgb, 0.0);
    let lists = graph.push_input("bev_points", InputKind::BevPoints, Shape::map(1, 1, 8));
    let sums = graph.push("sums", Op::GatherSum, &[map, lists]).unwrap();
    let weights = Arc::new(Weights { shape: vec![2, 4], data: vec![0.5; 8] });
    let linear = Linear { weights, bias: None, clip: Clip::NONE };
    let behind = graph.push("behind", Op::Linear(linear), &[sums]).unwrap();
    graph.outputs.push(behind);
    let pixels = (0..12).map(|i| (i * 37 % 256) as f32).collect();
    let frames = [vec![pixels, vec![0.0, 0.0, 0.0, 1.0, 1.0, 0.0, 1.0, 1.0]]];
    let statistics = calibrate(&graph, &frames, |_, _| ()).unwrap();
    let model = quantize(&graph, &frames, &statistics, &QuantizeOptions::default(), |_, _| ()).unwrap();
    assert_eq!(names(&model), [("map", "conv2d"), ("sums", "gather_sum"), ("behind", "linear")]);
    let seen = |value: ValueId| statistics.of(value).max_abs();
    let reach = |step: usize| {
        let tensor = model.tensor(model.steps[step].op.output());
        assert_eq!(tensor.element, ElementType::I16);
        tensor.scale * 32767.0
    };
    let four_times_the_largest = 4.0 * seen(map);
    assert!(seen(sums) < 0.9 * four_times_the_largest, "the cells differ");
    assert!(reach(1) > 1.2 * four_times_the_largest && reach(1) < 1.3 * four_times_the_largest);
    assert!(reach(2) > 1.2 * seen(behind) * four_times_the_largest / seen(sums));
}

#[test]
fn indices_are_an_input() {
    let (mut graph, rgb) = image(Shape::map(2, 2, 3));
    let map = conv(&mut graph, "map", rgb, 0.0);
    let sums = graph.push("sums", Op::GatherSum, &[map, map]).unwrap();
    let error = quantized(&mut graph, sums).unwrap_err();
    assert_eq!(
        error.to_string(),
        "node sums: indices map: found computed values, expected an input of cells\n  \
         help: gather by an input, not by a result"
    );
}

#[test]
fn fixed_point_is_no_operand_of_a_copy() {
    let mut graph = Graph::default();
    let goal = graph.push_input("goal", InputKind::Goal, Shape::vector(2));
    let slice = Slice { begin: [0; 3], end: [1, 1, 1], stride: [1; 3] };
    let right = graph.push("right", Op::Slice(slice), &[goal]).unwrap();
    let error = quantized(&mut graph, right).unwrap_err();
    assert_eq!((error.code, error.location.as_str()), (ErrorCode::Unsupported, "node right: operand goal"));
}
