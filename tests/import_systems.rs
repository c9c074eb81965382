//! From a checkpoint's tensors to the optimized float graph, for the published networks and their ablations.

use model_compiler::error::ErrorCode;
use model_compiler::import::{ImportOptions, NamedTensor, NamedTensors, System, TensorData, import};
use model_compiler::ir::verify::verify;
use model_compiler::ir::{Clip, Graph, InputKind, Op, Shape};
use model_compiler::passes::{PassOptions, optimize, optimize_with};
use model_compiler::reference;
use tests::golden::{self, Lbc, Network};

fn import_default(tensors: NamedTensors) -> Graph {
    let graph = import("model", tensors, &ImportOptions::default()).unwrap_or_else(|e| panic!("{e}"));
    assert_eq!(verify(&graph), Ok(()));
    graph
}

/// Multiply-accumulates of the nodes whose names start so, in millions with two decimals.
fn mega_macs(graph: &Graph, prefix: &str) -> f64 {
    let macs: u64 = graph.nodes.iter().filter(|n| n.name.starts_with(prefix)).map(|n| graph.node_macs(n)).sum();
    (macs as f64 / 1e4).round() / 100.0
}

fn count(graph: &Graph, operator: &str) -> usize {
    graph.nodes.iter().filter(|n| n.op.name() == operator).count()
}

fn shape_of(graph: &Graph, name: &str) -> Shape {
    graph.value(graph.find(name).unwrap_or_else(|| panic!("no value {name}"))).shape
}

#[test]
fn published_checkpoints_have_the_published_sizes() {
    for (system, parameters, giga_macs) in [
        (System::Aim, 21_470_722, 4.785),
        (System::LateFusion, 32_644_098, 7.102),
        (System::TransFuser, 66_293_634, 11.632),
        // Of 40,919,554 without image_projection2 and lidar_conv4; of 8.512 G without lidar_conv4.
        (System::GeometricFusion, 39_868_930, 8.495),
        // One branch of six is computed.
        (System::Cilrs, 12_693_331, 2.369),
    ] {
        let mut graph = import_default(golden::checkpoint(system));
        assert_eq!(graph.system, system.name());
        assert_eq!(graph.parameters(), parameters, "{}", system.name());
        assert_eq!((graph.macs() as f64 / 1e6).round() / 1e3, giga_macs, "{}", system.name());
        let (output, shape) = match system {
            System::Cilrs => ("controls", Shape::vector(3)),
            _ => ("waypoints", Shape::tokens(4, 2)),
        };
        assert_eq!(shape_of(&graph, output), shape);
        let taps = golden::expected(system).taps;
        let macs = graph.macs();
        for optimized in [false, true] {
            for (module, frames) in &taps {
                let value = golden::tapped_value(&graph, module).unwrap_or_else(|| panic!("no value for {module}"));
                assert_eq!(usize::from(graph.value(value).shape.channels), frames[0].len(), "{module}");
            }
            if !optimized {
                optimize(&mut graph).unwrap_or_else(|e| panic!("{e}"));
                let saved = if system == System::GeometricFusion { 880_803_840 } else { 0 };
                assert_eq!(graph.macs() + saved, macs, "only pointwise convolutions change places and are cheaper");
            }
        }
    }
}

#[test]
fn parts_of_transfuser_cost_what_the_specification_says() {
    let graph = import_default(Network::published(System::TransFuser).zeros());
    for (prefix, expected) in [
        ("encoder.image_encoder.features.conv1", 154.14),
        ("encoder.image_encoder.features.layer1", 905.97),
        ("encoder.image_encoder.features.layer2", 1140.85),
        ("encoder.image_encoder.features.layer3", 1744.83),
        ("encoder.image_encoder.features.layer4", 838.86),
        ("encoder.lidar_encoder._model", 2317.35),
        ("encoder.transformer1", 67.11),
        ("encoder.transformer2", 234.88),
        ("encoder.transformer3", 872.42),
        ("encoder.transformer4", 3355.44),
        ("join", 0.17),
        ("waypoints", 0.05),
    ] {
        assert_eq!(mega_macs(&graph, prefix), expected, "{prefix}");
    }
}

#[test]
fn published_lbc_has_the_published_size_at_both_resolutions() {
    for (hack, giga_macs, last) in [(false, 23.20, (18, 32)), (true, 5.80, (9, 16))] {
        let options = ImportOptions { hack, ..Default::default() };
        let mut graph = import("lbc.ckpt", golden::checkpoint(System::Lbc), &options).unwrap();
        assert_eq!((graph.system.as_str(), graph.parameters()), ("lbc", 39_656_472));
        for _ in 0..2 {
            assert_eq!(verify(&graph), Ok(()));
            assert_eq!(shape_of(&graph, "views"), Shape::map(144, 256, 10));
            let head = shape_of(&graph, "net.network.classifier.4");
            assert_eq!(head, Shape::map(last.0, last.1, 4));
            assert_eq!(shape_of(&graph, if hack { "net.upsample" } else { "net.network" }), Shape::map(144, 256, 4));
            assert_eq!(shape_of(&graph, "points"), Shape::tokens(4, 2));
            assert_eq!((graph.macs() as f64 / 1e7).round() / 1e2, giga_macs);
            optimize(&mut graph).unwrap();
        }
        assert_eq!((count(&graph, "conv2d"), count(&graph, "batch_norm"), count(&graph, "relu")), (61, 0, 0));
    }
}

#[test]
fn sizes_of_lbc_come_from_the_tensors_and_prefixes_are_free() {
    let network = Lbc::small();
    let options = ImportOptions { resolution: Some((48, 64)), temperature: Some(2.5), ..Default::default() };
    for wrapper in ["", "net.", "model.net."] {
        let mut tensors = NamedTensors::default();
        for (name, tensor) in network.tensors().iter() {
            tensors.insert(format!("{wrapper}{}", name.strip_prefix("net.").unwrap()), tensor.clone());
        }
        let outer = wrapper.strip_suffix("net.").unwrap_or_default();
        for unused in ["to_heatmap.kernel", "converter.position", "controller.layers.1.weight", "teacher.net.norm.bias"]
        {
            tensors.insert(format!("{outer}{unused}"), floats(&[2, 2]));
        }
        let graph = import("small.ckpt", tensors, &options).unwrap();
        let backbone = format!("{wrapper}network.backbone");
        assert_eq!(shape_of(&graph, &format!("{backbone}.layer1.0")), Shape::map(12, 16, 12));
        assert_eq!(shape_of(&graph, &format!("{backbone}.layer2.1")), Shape::map(6, 8, 16));
        assert_eq!(shape_of(&graph, &format!("{backbone}.layer4.1")), Shape::map(6, 8, 20));
        assert!(graph.find(&format!("{backbone}.layer3.0.downsample.0")).is_none(), "the identity fits");
        assert_eq!(shape_of(&graph, "points"), Shape::tokens(3, 2));
        let dilations = |module: &str| match &graph.producer(graph.find(module).unwrap()).unwrap().op {
            Op::Conv2d(conv) => (conv.window.dilation_h, conv.window.pad_top, conv.window.stride_h),
            op => panic!("{module} is a {}", op.name()),
        };
        for (module, expected) in [
            ("layer2.0.conv2", (1, 1, 2)),
            ("layer3.0.conv2", (1, 1, 1)),
            ("layer3.1.conv2", (2, 2, 1)),
            ("layer4.0.conv2", (2, 2, 1)),
            ("layer4.1.conv2", (4, 4, 1)),
        ] {
            assert_eq!(dilations(&format!("{backbone}.{module}")), expected, "{module}");
        }
        let last = graph.producer(graph.outputs[0]).unwrap();
        assert!(matches!(last.op, Op::SpatialSoftmax { temperature: 2.5 }));
    }
}

#[test]
fn the_batch_norm_of_the_views_is_folded_or_lowered() {
    let options = ImportOptions { resolution: Some((48, 64)), ..Default::default() };
    for (dead, operators) in [(false, 0), (true, 1)] {
        let mut tensors = Lbc::small().tensors();
        // In the middle of the grey levels, so that padding has a code; negative gains are folded, too.
        spoil(&mut tensors, "net.norm.running_mean", |v| v.fill(0.5));
        spoil(&mut tensors, "net.norm.weight", |v| v[4] = if dead { 0.0 } else { -1.0 });
        let mut graph = import("small", tensors, &options).unwrap();
        let frame = vec![tests::build::views((48, 64))[0].raw(InputKind::Views).unwrap()];
        let before = reference::run(&graph, &frame, |_, _| ()).unwrap().remove(0);
        optimize(&mut graph).unwrap();
        let after = reference::run(&graph, &frame, |_, _| ()).unwrap().remove(0);
        let worst = before.iter().zip(&after).map(|(b, a)| (b - a).abs()).fold(0.0, f32::max);
        assert!(worst < 1e-3, "{worst} pixels apart");
        let alone = graph.nodes.iter().filter(|n| matches!(&n.op, Op::Conv2d(c) if c.groups == 10)).count();
        assert_eq!(alone, operators);
    }
}

#[test]
fn ablations_have_the_sizes_of_the_paper() {
    let base = Network::published(System::TransFuser);
    for (what, network, parameters, giga_macs) in [
        ("scale 1", Network { scales: vec![4], ..base.clone() }, 57_930_370, 10.458),
        ("scale 2", Network { scales: vec![3, 4], ..base.clone() }, 64_282_242, 11.330),
        ("scale 3", Network { scales: vec![2, 3, 4], ..base.clone() }, 65_885_314, 11.565),
        ("1 attention layer", Network { layers: 1, ..base.clone() }, 36_960_834, 7.668),
        ("4 attention layers", Network { layers: 4, ..base.clone() }, 49_532_034, 9.367),
        ("no positional embedding", Network { position: false, ..base.clone() }, 66_170_754, 11.632),
    ] {
        let mut graph = import_default(network.zeros());
        assert_eq!(graph.parameters(), parameters, "{what}");
        assert_eq!((graph.macs() as f64 / 1e6).round() / 1e3, giga_macs, "{what}");
        optimize(&mut graph).unwrap_or_else(|e| panic!("{what}: {e}"));
        assert_eq!(count(&graph, "tokens"), network.scales.len(), "{what}");
    }
}

#[test]
fn a_shared_transformer_counts_once_and_works_at_every_scale() {
    let network = Network { shared: Some(512), ..Network::published(System::TransFuser) };
    let mut graph = import_default(network.zeros());
    assert_eq!(graph.system, "transfuser");
    assert_eq!(graph.parameters(), 59_902_466);
    // Two ResNets and the head, four times the transformer of 512 channels, 1×1 convolutions as in Geometric Fusion.
    let fusion = 4.0 * 3355.44 + 1006.6;
    assert!((graph.macs() as f64 / 1e6 - (7102.0 + 0.22 + fusion)).abs() < 0.2, "{}", graph.macs());
    assert_eq!(mega_macs(&graph, "encoder.transformer1"), mega_macs(&graph, "encoder.transformer4"));
    assert_eq!(shape_of(&graph, "encoder.transformer1.blocks.7"), Shape::tokens(128, 512));
    assert_eq!(shape_of(&graph, "encoder.image_embedding1"), Shape::map(8, 8, 512));
    optimize(&mut graph).unwrap_or_else(|e| panic!("{e}"));
    assert_eq!(count(&graph, "tokens"), 4);

    let two = Network { shared: Some(12), scales: vec![2, 4], ..Network::small(System::TransFuser) };
    let graph = import_default(two.zeros());
    assert_eq!((count(&graph, "tokens"), shape_of(&graph, "rgb")), (2, Shape::map(64, 64, 3)));
    assert!(graph.find("encoder.image_embedding4").is_none(), "nothing to pool at the last stage");
}

#[test]
fn transfuser_without_any_scale_has_no_velocity_input() {
    let graph = import_default(Network { scales: vec![], ..Network::small(System::TransFuser) }.zeros());
    assert!(graph.inputs().all(|(_, kind)| kind != InputKind::Velocity));
}

#[test]
fn sizes_come_from_the_tensors() {
    let network = Network {
        stem: 12,
        widths: [8, 16, 20, 28],
        image_blocks: [1, 3, 2, 1],
        lidar_blocks: [2, 1, 1, 3],
        layers: 3,
        grid: (3, 3),
        scales: vec![2, 4],
        join: vec![40, 20, 12, 6],
        gru_inputs: 4,
        ..Network::small(System::TransFuser)
    };
    let graph = import_default(network.tensors());
    assert_eq!(shape_of(&graph, "rgb"), Shape::map(96, 96, 3));
    assert_eq!(shape_of(&graph, "bev"), Shape::map(96, 96, 2));
    assert_eq!(shape_of(&graph, "encoder.image_encoder.features.maxpool"), Shape::map(24, 24, 12));
    assert_eq!(shape_of(&graph, "encoder.image_encoder.features.layer2.2"), Shape::map(12, 12, 16));
    assert_eq!(shape_of(&graph, "encoder.lidar_encoder._model.layer4.2"), Shape::map(3, 3, 28));
    assert_eq!(shape_of(&graph, "encoder.transformer2.blocks.2"), Shape::tokens(18, 16));
    assert_eq!(shape_of(&graph, "encoder.transformer2.upsample.lidar"), Shape::map(12, 12, 16));
    assert!(graph.find("encoder.transformer4.upsample.image").is_none(), "nothing to enlarge at the last stage");
    assert_eq!(shape_of(&graph, "join.7"), Shape::vector(6));
    // The stem is wider than the first stage, so that stage projects its shortcut too.
    assert!(graph.find("encoder.image_encoder.features.layer1.0.downsample.0").is_some());
}

#[test]
fn inputs_and_outputs_have_their_names() {
    for (system, inputs) in [
        (System::Aim, vec!["rgb", "goal"]),
        (System::LateFusion, vec!["rgb", "bev", "goal"]),
        (System::TransFuser, vec!["rgb", "bev", "velocity", "goal"]),
        (System::GeometricFusion, vec!["rgb", "bev", "bev_points", "cam_points", "goal"]),
        (System::Cilrs, vec!["rgb", "velocity", "command"]),
    ] {
        let network = Network::small(system);
        let options = ImportOptions { resolution: Some(network.resolution()), ..Default::default() };
        let mut graph = import("small", network.tensors(), &options).unwrap();
        for _ in 0..2 {
            assert_eq!(graph.inputs().map(|(id, _)| graph.value(id).name.as_str()).collect::<Vec<_>>(), inputs);
            let outputs: &[&str] =
                if system == System::Cilrs { &["controls", "predicted_speed"] } else { &["waypoints"] };
            assert_eq!(graph.outputs.iter().map(|&id| &*graph.value(id).name).collect::<Vec<_>>(), outputs);
            assert_eq!(shape_of(&graph, "rgb"), Shape::map(64, 64, 3));
            optimize(&mut graph).unwrap();
        }
    }
}

#[test]
fn optimized_transfuser_consists_of_fused_operators() {
    let mut graph = import_default(Network::published(System::TransFuser).zeros());
    optimize(&mut graph).unwrap();
    for (operator, expected) in [
        ("normalize", 0),
        ("batch_norm", 0),
        ("relu", 0),
        ("conv2d", 36 + 20),
        ("max_pool", 2),
        ("tokens", 4),
        ("layer_norm", 4 * (2 * 8 + 2)),
        ("linear", 4 * 8 * 6 + 3),
        ("attention", 4 * 8),
        ("resize_bilinear", 6),
        // The last stage's two fusion additions: LayerNorm takes no residual.
        ("add", 2),
        ("global_pool", 1),
        ("waypoint_decoder", 1),
    ] {
        assert_eq!(count(&graph, operator), expected, "{operator}");
    }
    assert_eq!(graph.values.len(), graph.nodes.len(), "no dead values");
    let block = graph.producer(graph.find("encoder.image_encoder.features.layer2.0").unwrap()).unwrap();
    assert!(matches!(&block.op, Op::Conv2d(c) if c.clip == Clip::RELU && c.window.kernel_h == 3));
    assert_eq!(graph.value(block.inputs[1]).name, "encoder.image_encoder.features.layer2.0.downsample.1");
    let normalized = |name: &str| match &graph.producer(graph.find(name).unwrap()).unwrap().op {
        Op::Conv2d(conv) => conv.normalization.clone(),
        op => panic!("{name} is a {}", op.name()),
    };
    let image = normalized("encoder.image_encoder.features.relu").expect("raw camera image");
    assert_eq!((&image.mean[..], &image.std[..]), (&[0.485, 0.456, 0.406][..], &[0.229, 0.224, 0.225][..]));
    assert_eq!(normalized("encoder.lidar_encoder._model.relu"), None, "counts are scaled by their input");
}

#[test]
fn optimized_geometric_fusion_runs_its_pointwise_convolutions_on_the_smallest_maps() {
    let mut graph = import_default(Network::published(System::GeometricFusion).zeros());
    assert_eq!(mega_macs(&graph, "encoder.image_conv1"), 134.22);
    optimize(&mut graph).unwrap();
    for (operator, expected) in [
        ("conv2d", 36 + 20),
        ("average_pool", 6),
        ("gather_sum", 8),
        // Seven embeddings, eight projections and ways back.
        ("linear", 7 + 8 * 3 + 8 + 3),
        ("relu", 0),
        ("resize_bilinear", 6),
        ("add", 0),
    ] {
        assert_eq!(count(&graph, operator), expected, "{operator}");
    }
    let grid = (8, 8);
    for node in graph.nodes.iter().filter(|n| ["average_pool", "gather_sum"].contains(&n.op.name())) {
        let shape = graph.value(node.output).shape;
        assert_eq!((shape.height, shape.width), grid, "{}", node.name);
    }
    for node in graph.nodes.iter().filter(|n| n.op.name() == "resize_bilinear") {
        assert_eq!(node.inputs.len(), 2, "{} is added on the way", node.name);
        let deconv = graph.producer(node.inputs[0]).unwrap();
        assert_eq!(deconv.op.name(), "linear", "{}", node.name);
        assert_eq!(graph.value(deconv.output).shape.channels, graph.value(node.output).shape.channels);
    }
    // 64 cells × 512 channels × the stage's.
    for (name, expected) in [
        ("encoder.image_embedding1", 2.10),
        ("encoder.lidar_embedding2", 4.19),
        ("encoder.image_embedding3", 8.39),
        ("encoder.image_conv4", 16.78),
        ("encoder.lidar_upsample1.input", 2.10),
        ("encoder.image_upsample3.input", 8.39),
        ("encoder.lidar_add4", 16.78),
    ] {
        assert_eq!(mega_macs(&graph, name), expected, "{name}");
    }
}

/// Names of the values that the node of this name reads.
fn reads<'a>(graph: &'a Graph, name: &str) -> Vec<&'a str> {
    let node = graph.nodes.iter().find(|n| n.name == name).unwrap_or_else(|| panic!("no node {name}"));
    node.inputs.iter().map(|&id| graph.value(id).name.as_str()).collect()
}

#[test]
fn geometric_fusion_keeps_what_its_weights_were_trained_with() {
    let graph = import_default(Network::small(System::GeometricFusion).tensors());
    assert_eq!(reads(&graph, "encoder.image_gathered2"), ["encoder.image_embedding2", "bev_points"]);
    assert_eq!(reads(&graph, "encoder.image_projection1.0.scale2"), ["encoder.image_gathered2"]);
    assert!(graph.nodes.iter().all(|n| !n.name.starts_with("encoder.image_projection2")), "scale 2 uses the first");
    assert_eq!(reads(&graph, "encoder.lidar_gathered4"), ["encoder.lidar_embedding3", "cam_points"]);
    assert!(graph.find("encoder.lidar_conv4").is_none(), "scale 4 gathers scale 3");
    assert_eq!(reads(&graph, "encoder.image_gathered4"), ["encoder.image_conv4", "bev_points"]);
    // Both embeddings are of the maps before either gets anything.
    assert_eq!(reads(&graph, "encoder.lidar_conv1"), ["encoder.lidar_encoder._model.layer1.0"]);
    assert_eq!(reads(&graph, "encoder.image_conv1"), ["encoder.image_encoder.features.layer1.1"]);
    assert_eq!(reads(&graph, "encoder.lidar_upsample1"), ["encoder.image_projection1.5"]);
    let names = ["encoder.image_projection1.0", "encoder.image_projection1.0.scale2"];
    let weights = names.map(|name| match &graph.producer(graph.find(name).unwrap()).unwrap().op {
        Op::Linear(linear) => linear.weights.data.as_ptr(),
        op => panic!("{name} is a {}", op.name()),
    });
    assert_eq!(weights[0], weights[1], "shared");
}

#[test]
fn geometric_fusion_fuses_as_many_of_the_last_stages_as_it_is_told() {
    let tensors = Network::small(System::GeometricFusion).tensors();
    for scales in 1..=4 {
        let options = ImportOptions { fusion_scales: Some(scales), ..Default::default() };
        let mut graph = import("m", tensors.clone(), &options).unwrap();
        assert_eq!(verify(&graph), Ok(()));
        assert_eq!(count(&graph, "gather_sum"), 2 * usize::from(scales));
        let fourth = if scales == 1 { "encoder.lidar_conv4" } else { "encoder.lidar_embedding3" };
        assert_eq!(reads(&graph, "encoder.lidar_gathered4")[0], fourth, "{scales} scales");
        optimize(&mut graph).unwrap();
    }
    let options = ImportOptions { fusion_scales: Some(2), ..Default::default() };
    let error = import("m", Network::small(System::TransFuser).tensors(), &options).unwrap_err();
    assert_eq!(error.code, ErrorCode::Usage);
    assert_eq!(
        error.to_string(),
        "m: --fusion-scales has no effect on transfuser\n  \
         help: leave it out; the tensors of other systems tell their scales"
    );
}

#[test]
fn sizes_of_geometric_fusion_come_from_the_tensors() {
    let network = Network {
        widths: [8, 16, 20, 28],
        image_blocks: [1, 3, 2, 1],
        embedding: 10,
        projection: vec![6, 14],
        gru_inputs: 4,
        ..Network::small(System::GeometricFusion)
    };
    let options = ImportOptions { resolution: Some((96, 96)), ..Default::default() };
    let graph = import("m", network.tensors(), &options).unwrap_or_else(|e| panic!("{e}"));
    assert_eq!(shape_of(&graph, "cam_points"), Shape::map(3, 3, 10));
    assert_eq!(shape_of(&graph, "encoder.image_conv2"), Shape::map(12, 12, 10));
    assert_eq!(shape_of(&graph, "encoder.lidar_embedding2"), Shape::map(3, 3, 10));
    assert_eq!(shape_of(&graph, "encoder.lidar_projection2.3"), Shape::map(3, 3, 14));
    assert_eq!(shape_of(&graph, "encoder.image_add2"), Shape::map(12, 12, 16));
    let mut tensors = network.tensors();
    tensors.insert("encoder.image_projection2.0.weight", floats(&[6, 11]));
    tensors.remove("encoder.lidar_conv4.bias");
    tensors.insert("encoder.lidar_deconv1.weight", floats(&[8, 14, 3, 3]));
    let error = import("model.pth", tensors, &options).unwrap_err();
    let expected = "\
model.pth: 3 tensors do not fit the system geometric_fusion:
  encoder.image_projection2.0.weight  found [6, 11]        expected [6, 10]
  encoder.lidar_deconv1.weight        found [8, 14, 3, 3]  expected [8, 14, 1, 1]
  encoder.lidar_conv4.bias            missing              expected [10]
  help: the checkpoint must hold exactly the network's tensors; --system overrides the detection";
    assert_eq!(error.to_string(), expected);
}

#[test]
fn residuals_stay_additions_when_switched_off() {
    let mut graph = import_default(Network::small(System::TransFuser).tensors());
    optimize_with(&mut graph, PassOptions { fuse_residual: false }).unwrap();
    let with_residual = |kind: &str| graph.nodes.iter().filter(|n| n.op.name() == kind && n.inputs.len() == 2).count();
    assert_eq!((with_residual("conv2d"), with_residual("linear"), with_residual("resize_bilinear")), (0, 0, 6));
    assert_eq!(count(&graph, "add"), 5 + 4 + 4 * 2 * 2 + 2);
    assert_eq!(count(&graph, "relu"), 0);
}

fn spoil(tensors: &mut NamedTensors, name: &str, change: impl FnOnce(&mut Vec<f32>)) {
    match tensors.get_mut(name) {
        Some(NamedTensor { data: TensorData::Float(values), .. }) => change(values),
        _ => panic!("no float tensor {name}"),
    }
}

fn floats(shape: &[usize]) -> NamedTensor {
    NamedTensor { shape: shape.to_vec(), data: TensorData::Float(vec![0.5; shape.iter().product()]) }
}

#[test]
fn all_wrong_tensors_are_listed_at_once() {
    let mut tensors = Network::small(System::TransFuser).tensors();
    tensors.remove("encoder.image_encoder.features.layer2.0.bn1.running_mean");
    tensors.remove("encoder.transformer3.blocks.1.attn.query.weight");
    tensors.insert("encoder.lidar_encoder._model.layer3.0.conv2.weight", floats(&[24, 24, 1, 1]));
    tensors.insert("encoder.image_encoder.features.fc.weight", floats(&[1000, 32]));
    tensors.insert("join.2.bias", floats(&[17]));
    tensors.insert("output.bias", NamedTensor { shape: vec![2], data: TensorData::Integer });
    spoil(&mut tensors, "decoder.weight_hh", |v| v[7] = f32::NAN);
    spoil(&mut tensors, "encoder.transformer1.pos_emb", |v| v[3] = f32::INFINITY);
    spoil(&mut tensors, "encoder.image_encoder.features.bn1.running_var", |v| v[2] = -1.0);
    let error = import("model.pth", tensors, &ImportOptions::default()).unwrap_err();
    assert_eq!(error.code, ErrorCode::Tensors);
    let expected = "\
model.pth: 9 tensors do not fit the system transfuser:
  encoder.transformer1.pos_emb                              inf at index 3                expected [1, 8, 8]
  encoder.transformer3.blocks.1.attn.query.weight           missing                       expected [24, 24]
  encoder.image_encoder.features.bn1.running_var            negative variance at index 2  expected [8]
  encoder.image_encoder.features.layer2.0.bn1.running_mean  missing                       expected [16]
  encoder.lidar_encoder._model.layer3.0.conv2.weight        found [24, 24, 1, 1]          expected [24, 24, 3, 3]
  join.2.bias                                               found [17]                    expected [16]
  decoder.weight_hh                                         NaN at index 7                expected [48, 16]
  output.bias                                               found integers [2]            expected [2]
  encoder.image_encoder.features.fc.weight                  found [1000, 32]              surplus
  help: the checkpoint must hold exactly the network's tensors; --system overrides the detection";
    assert_eq!(error.to_string(), expected);
}

#[test]
fn missing_whole_parts_are_listed_and_the_list_is_cut() {
    let mut tensors = Network::small(System::TransFuser).tensors();
    let names: Vec<_> = tensors.under("encoder.image_encoder.").map(|(name, _)| name.to_string()).collect();
    names.iter().for_each(|name| drop(tensors.remove(name)));
    let text = import("model.pth", tensors, &ImportOptions::default()).unwrap_err().to_string();
    assert!(text.starts_with("model.pth: 60 tensors do not fit the system transfuser:\n"), "{text}");
    assert!(text.contains("features.layer4.0.conv1.weight               missing  expected [32, 24, 3, 3]\n"), "{text}");
    assert!(text.contains("\n  … and 10 more\n  help: "), "{text}");
    assert_eq!(text.lines().count(), 1 + 50 + 2);
}

#[test]
fn surplus_counters_are_no_problem_and_other_leftovers_are() {
    let mut tensors = Network::small(System::Aim).tensors();
    tensors.insert("other.num_batches_tracked", NamedTensor { shape: vec![], data: TensorData::Integer });
    import("model", tensors.clone(), &ImportOptions::default()).unwrap();
    tensors.insert("step", NamedTensor { shape: vec![], data: TensorData::Integer });
    let error = import("model", tensors, &ImportOptions::default()).unwrap_err();
    assert_eq!(error.message, "1 tensor does not fit the system aim:\n  step  found []  surplus");
}

#[test]
fn unfitting_options_are_refused_by_name() {
    let tensors = Network::small(System::TransFuser).tensors();
    let heads = ImportOptions { heads: Some(3), ..Default::default() };
    let error = import("m", tensors.clone(), &heads).unwrap_err();
    assert_eq!(
        error.to_string(),
        "m: attention encoder.transformer1.blocks.0.attn.context: 8 channels are not divisible by 3 heads\n  \
         help: --heads sets the number of heads"
    );
    let resolution = ImportOptions { resolution: Some((128, 64)), ..Default::default() };
    let error = import("m", tensors.clone(), &resolution).unwrap_err();
    assert!(error.message.contains("encoder.transformer4.pos_emb  found [1, 8, 32]  expected [1, 16, 32]"), "{error}");
    let resolution = ImportOptions { resolution: Some((72, 64)), ..Default::default() };
    let error = import("m", tensors, &resolution).unwrap_err();
    assert_eq!(
        error.to_string(),
        "m: an input of 72×64 pixels does not divide into tokens\n  \
         help: height and width must be multiples of 32 pixels"
    );
    let tensors = Network::small(System::GeometricFusion).tensors();
    let resolution = ImportOptions { resolution: Some((64, 96)), ..Default::default() };
    let error = import("m", tensors, &resolution).unwrap_err();
    assert_eq!(
        error.to_string(),
        "m: an input of 64×96 pixels is not square\n  \
         help: this network takes columns of the image for rows, so it needs as many of both"
    );
}

#[test]
fn options_of_lbc_are_refused_where_they_do_not_fit() {
    let refused = |tensors, options: ImportOptions| import("m", tensors, &options).unwrap_err().to_string();
    let hack = ImportOptions { hack: true, ..Default::default() };
    assert_eq!(
        refused(Network::small(System::Aim).tensors(), hack.clone()),
        "m: --hack and --temperature have no effect on aim\n  help: leave them out; they belong to lbc"
    );
    let temperature = ImportOptions { temperature: Some(1.0), ..Default::default() };
    assert!(
        refused(Network::small(System::TransFuser).tensors(), temperature).contains("--temperature have no effect")
    );
    let halves = ImportOptions { resolution: Some((56, 64)), ..hack };
    assert_eq!(
        refused(Lbc::small().tensors(), halves.clone()),
        "m: an input of 56×64 pixels does not divide into the network's last map\n  \
         help: height and width must be multiples of 16 pixels"
    );
    import("m", Lbc::small().tensors(), &ImportOptions { hack: false, ..halves }).unwrap();
    let mut tensors = Lbc::small().tensors();
    tensors.remove("net.network.classifier.0.project.1.bias");
    tensors.insert("net.network.classifier.4.bias", floats(&[2]));
    tensors.insert("net.network.classifier.5.bias", floats(&[5]));
    let text = refused(tensors, ImportOptions::default());
    assert!(text.starts_with("m: 3 tensors do not fit the system lbc:\n"), "{text}");
    for line in [
        "net.network.classifier.0.project.1.bias  missing    expected [10]",
        "net.network.classifier.4.bias            found [2]  expected [3]",
        "net.network.classifier.5.bias            found [5]  surplus",
    ] {
        assert!(text.contains(line), "{text}");
    }
}

#[test]
fn generated_checkpoint_is_finite_and_its_statistics_are_positive() {
    let network = Network::small(System::TransFuser);
    let tensors = network.tensors();
    assert_eq!(tensors.len(), network.shapes().len());
    for (name, tensor) in tensors.iter() {
        if let TensorData::Float(values) = &tensor.data {
            assert!(values.iter().all(|v| v.is_finite()), "{name}");
            assert!(!name.ends_with("running_var") || values.iter().all(|&v| v > 0.0), "{name}");
        }
    }
}
