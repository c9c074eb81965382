//! Whole small graphs.

use super::*;
use crate::ir::{Clip, Linear, Normalization, Weights};
use std::sync::Arc;

/// BEV → ReLU → add(BEV), and a branch that nobody reads.
fn small() -> Graph {
    let mut graph = Graph { name: "small".into(), ..Graph::default() };
    let bev = graph.push_input("bev", InputKind::Bev, Shape::map(1, 2, 2));
    let negative = Op::Normalize(Arc::new(Normalization { mean: vec![0.5, 0.0], std: vec![1.0, -1.0] }));
    let shifted = graph.push("shifted", negative, &[bev]).unwrap();
    let relu = graph.push("relu", Op::Clip(Clip::RELU), &[shifted]).unwrap();
    graph.push("unread", Op::GlobalPool, &[shifted]).unwrap();
    let sum = graph.push("sum", Op::Add { clip: Clip::NONE }, &[relu, bev]).unwrap();
    graph.outputs = vec![sum, relu];
    graph
}

#[test]
fn counts_are_divided_and_outputs_keep_their_order() {
    let out = run(&small(), &[vec![5.0, 0.0, 1.0, 5.0]], |_, _| ()).unwrap();
    assert_eq!(out, [vec![1.5, 0.0, 0.2, 1.0], vec![0.5, 0.0, 0.0, 0.0]]);
}

#[test]
fn the_observer_sees_every_node_with_the_values_that_run_all_keeps() {
    let graph = small();
    let inputs = [vec![5.0, 0.0, 1.0, 5.0]];
    let kept = run_all(&graph, &inputs).unwrap();
    let mut seen = Vec::new();
    let out = run(&graph, &inputs, |node, value| {
        assert_eq!(kept.get(node.output), Some(value), "{}", node.name);
        seen.push(node.name.clone());
    })
    .unwrap();
    assert_eq!(seen, ["bev", "shifted", "relu", "unread", "sum"]);
    assert_eq!(kept.get(graph.outputs[0]), Some(&out[0][..]));
    assert_eq!(kept.get(ValueId(99)), None);
}

#[test]
fn wrong_inputs_are_named() {
    let graph = small();
    let error = run(&graph, &[], |_, _| ()).unwrap_err();
    assert_eq!(error.code, ErrorCode::Frames);
    assert_eq!(error.to_string(), "network small: found 0 inputs, expected 1 (Bev)");
    let error = run_all(&graph, &[vec![0.0; 3]]).unwrap_err();
    assert_eq!(error.to_string(), "input bev (Bev): found 3 values, expected 1×2×2");
}

#[test]
fn a_graph_out_of_order_is_refused() {
    let mut graph = small();
    graph.nodes.swap(1, 2);
    let error = run(&graph, &[vec![0.0; 4]], |_, _| ()).unwrap_err();
    assert_eq!(error.code, ErrorCode::Malformed);
    assert_eq!(error.to_string(), "relu: value shifted is read before any node writes it");
}

#[test]
fn a_value_of_the_wrong_shape_is_refused() {
    let mut graph = small();
    let sum = graph.outputs[0];
    graph.values[sum.0 as usize].shape = Shape::vector(4);
    let error = run(&graph, &[vec![0.0; 4]], |_, _| ()).unwrap_err();
    assert_eq!(error.code, ErrorCode::Malformed);
    assert!(error.to_string().starts_with("node sum: its value is declared"), "{error}");
}

#[test]
fn a_fused_operator_equals_its_chain() {
    let x = testing::values(1, 6 * 5);
    let residual = testing::values(2, 6 * 7);
    let weights = Arc::new(Weights { shape: vec![7, 5], data: testing::values(3, 7 * 5) });
    let bias = Some(Arc::new(testing::values(4, 7)));
    let (input, output) = (Shape::tokens(6, 5), Shape::tokens(6, 7));
    let layer = |clip: Clip| Op::Linear(Linear { weights: weights.clone(), bias: bias.clone(), clip });

    let apart = evaluate(&layer(Clip::NONE), &[input], &[&x], output);
    let apart = evaluate(&Op::Add { clip: Clip::NONE }, &[output, output], &[&apart, &residual], output);
    let apart = evaluate(&Op::Clip(Clip::RELU), &[output], &[&apart], output);
    assert_eq!(evaluate(&layer(Clip::RELU), &[input, output], &[&x, &residual], output), apart);
}
