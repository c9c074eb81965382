//! Whole classifiers as exporters write them, and a published one, against ONNX Runtime.

use model_compiler::import::ImportOptions;
use model_compiler::passes::PassOptions;
use model_compiler::{pipeline, reference};
use tests::commands;
use tests::onnx_file::{Attribute, OnnxFile, float, int, ints};
use tests::onnxruntime::{Case, assert_close, channels_first, compare, outputs};

const SEED: u64 = 20;

/// A network under construction: names of values are numbered.
struct Net {
    file: OnnxFile,
    count: usize,
}

impl Net {
    fn new(opset: i64, dims: &[i64]) -> Self {
        let mut file = OnnxFile::new(opset, SEED);
        file.input("image", dims).output("logits");
        Self { file, count: 0 }
    }

    fn name(&mut self, what: &str) -> String {
        self.count += 1;
        format!("{what}{}", self.count)
    }

    fn op(&mut self, op: &str, inputs: &[&str], attributes: &[Attribute]) -> String {
        let output = self.name("t");
        self.file.node(op, inputs, &output, attributes);
        self.file.nodes.last_mut().expect("a node").name = format!("/net/{op}_{}", self.count);
        output
    }

    /// `k×k` with padding that keeps the size at stride 1; weights scaled to keep values of the same size.
    fn conv(&mut self, x: &str, [o, i]: [i64; 2], k: i64, stride: i64, groups: i64) -> String {
        let (w, b) = (self.name("w"), self.name("b"));
        let bound = (3.0 / (i / groups * k * k) as f32).sqrt();
        let values = self.file.draw((o * i / groups * k * k) as usize, -bound, bound);
        self.file.floats(&w, &[o, i / groups, k, k], &values);
        self.file.weights(&b, &[o]);
        let attributes = [
            ints("kernel_shape", &[k, k]),
            ints("strides", &[stride, stride]),
            ints("pads", &[k / 2; 4]),
            ints("dilations", &[1, 1]),
            int("group", groups),
        ];
        self.op("Conv", &[x, &w, &b], &attributes)
    }

    fn norm(&mut self, x: &str, channels: i64) -> String {
        let names = ["s", "b", "m", "v"].map(|what| self.name(what));
        self.file.positive(&names[0], &[channels]);
        self.file.weights(&names[1], &[channels]);
        self.file.weights(&names[2], &[channels]);
        self.file.positive(&names[3], &[channels]);
        self.op("BatchNormalization", &[x, &names[0], &names[1], &names[2], &names[3]], &[float("epsilon", 1e-5)])
    }

    fn relu(&mut self, x: &str) -> String {
        self.op("Relu", &[x], &[])
    }

    fn relu6(&mut self, x: &str) -> String {
        if self.file.opset < 11 {
            return self.op("Clip", &[x], &[float("min", 0.0), float("max", 6.0)]);
        }
        let (min, max) = (self.name("min"), self.name("max"));
        self.file.floats(&min, &[], &[0.0]);
        self.file.floats(&max, &[], &[6.0]);
        self.op("Clip", &[x, &min, &max], &[])
    }

    fn pool(&mut self, op: &str, x: &str, k: i64, stride: i64, pad: i64) -> String {
        let attributes = [ints("kernel_shape", &[k, k]), ints("strides", &[stride, stride]), ints("pads", &[pad; 4])];
        self.op(op, &[x], &attributes)
    }

    fn gemm(&mut self, x: &str, inputs: i64, outputs: i64) -> String {
        let (w, b) = (self.name("w"), self.name("b"));
        let bound = (3.0 / inputs as f32).sqrt();
        let values = self.file.draw((inputs * outputs) as usize, -bound, bound);
        self.file.floats(&w, &[outputs, inputs], &values);
        self.file.weights(&b, &[outputs]);
        self.op("Gemm", &[x, &w, &b], &[int("transB", 1)])
    }

    /// The last value is the output.
    fn case(mut self, name: &str) -> Case {
        self.file.nodes.last_mut().expect("a node").output = vec!["logits".into()];
        Case::new(format!("{name}, opset {}", self.file.opset), &self.file, SEED)
    }
}

/// Shortcuts by every other pixel and zero channels (option A), or by convolution (B).
fn resnet(opset: i64, projects: bool) -> Case {
    let mut net = Net::new(opset, &[0, 3, 16, 16]);
    let mut channels = 8;
    let x = net.conv("image", [channels, 3], 3, 1, 1);
    let x = net.norm(&x, channels);
    let mut x = net.relu(&x);
    for (width, stride) in [(8, 1), (16, 2), (32, 2)] {
        let a = net.conv(&x, [width, channels], 3, stride, 1);
        let a = net.norm(&a, width);
        let a = net.relu(&a);
        let a = net.conv(&a, [width, width], 3, 1, 1);
        let a = net.norm(&a, width);
        let skip = if stride == 1 {
            x
        } else if projects {
            let skip = net.conv(&x, [width, channels], 1, stride, 1);
            net.norm(&skip, width)
        } else {
            let lists = [[0, 0], [i64::MAX, i64::MAX], [2, 3], [2, 2]].map(|list| {
                let name = net.name("list");
                net.file.integers(&name, &list)
            });
            let sliced = net.op("Slice", &[&x, &lists[0], &lists[1], &lists[2], &lists[3]], &[]);
            let more = (width - channels) / 2;
            let pads = net.name("pads");
            net.file.integers(&pads, &[0, more, 0, 0, 0, more, 0, 0]);
            net.op("Pad", &[&sliced, &pads], &[])
        };
        let sum = net.op("Add", &[&a, &skip], &[]);
        x = net.relu(&sum);
        channels = width;
    }
    let x = net.op("GlobalAveragePool", &[&x], &[]);
    let x = net.op("Flatten", &[&x], &[int("axis", 1)]);
    net.gemm(&x, channels, 10);
    net.case("ResNet")
}

fn vgg(opset: i64) -> Case {
    let mut net = Net::new(opset, &[1, 3, 16, 12]);
    let mut x = "image".to_owned();
    for [o, i] in [[8, 3], [16, 8]] {
        x = net.conv(&x, [o, i], 3, 1, 1);
        x = net.relu(&x);
        x = net.pool("MaxPool", &x, 2, 2, 0);
    }
    x = net.op("Flatten", &[&x], &[]);
    for [o, i] in [[32, 16 * 4 * 3], [24, 32]] {
        x = net.gemm(&x, i, o);
        x = net.relu(&x);
        x = net.op("Dropout", &[&x], &[]);
    }
    net.gemm(&x, 24, 10);
    net.case("VGG")
}

fn mobilenet_v2(opset: i64) -> Case {
    let mut net = Net::new(opset, &[0, 3, 20, 16]);
    let x = net.conv("image", [8, 3], 3, 2, 1);
    let x = net.norm(&x, 8);
    let mut x = net.relu6(&x);
    for ([o, i], stride) in [([8, 8], 1), ([12, 8], 2), ([12, 12], 1)] {
        let wide = 4 * i;
        let e = net.conv(&x, [wide, i], 1, 1, 1);
        let e = net.norm(&e, wide);
        let e = net.relu6(&e);
        let d = net.conv(&e, [wide, wide], 3, stride, wide);
        let d = net.norm(&d, wide);
        let d = net.relu6(&d);
        let p = net.conv(&d, [o, wide], 1, 1, 1);
        let p = net.norm(&p, o);
        x = if stride == 1 && i == o { net.op("Add", &[&x, &p], &[]) } else { p };
    }
    let x = net.op("ReduceMean", &[&x], &[ints("axes", &[2, 3]), int("keepdims", 0)]);
    net.gemm(&x, 12, 10);
    net.op("Softmax", &[&format!("t{}", net.count)], &[]);
    net.case("MobileNetV2")
}

fn squeezenet(opset: i64) -> Case {
    let mut net = Net::new(opset, &[1, 3, 24, 24]);
    let x = net.conv("image", [8, 3], 3, 2, 1);
    let x = net.relu(&x);
    let attributes = [ints("kernel_shape", &[3, 3]), ints("strides", &[2, 2]), int("ceil_mode", 1)];
    let mut x = net.op("MaxPool", &[&x], &attributes);
    for i in [8, 16] {
        let s = net.conv(&x, [4, i], 1, 1, 1);
        let s = net.relu(&s);
        let a = net.conv(&s, [8, 4], 1, 1, 1);
        let a = net.relu(&a);
        let b = net.conv(&s, [8, 4], 3, 1, 1);
        let b = net.relu(&b);
        x = net.op("Concat", &[&a, &b], &[int("axis", 1)]);
    }
    let x = net.op("Dropout", &[&x], &[]);
    let x = net.conv(&x, [10, 16], 1, 1, 1);
    let x = net.relu(&x);
    let x = net.op("GlobalAveragePool", &[&x], &[]);
    net.op("Flatten", &[&x], &[]);
    net.case("SqueezeNet")
}

fn densenet(opset: i64) -> Case {
    let mut net = Net::new(opset, &[0, 3, 16, 16]);
    let mut channels = 8;
    let x = net.conv("image", [channels, 3], 3, 1, 1);
    let mut x = net.pool("MaxPool", &x, 3, 2, 1);
    for block in 0..2 {
        for _ in 0..3 {
            let n = net.norm(&x, channels);
            let n = net.relu(&n);
            let n = net.conv(&n, [16, channels], 1, 1, 1);
            let n = net.norm(&n, 16);
            let n = net.relu(&n);
            let n = net.conv(&n, [4, 16], 3, 1, 1);
            x = net.op("Concat", &[&x, &n], &[int("axis", 1)]);
            channels += 4;
        }
        if block == 0 {
            let n = net.norm(&x, channels);
            let n = net.relu(&n);
            let n = net.conv(&n, [channels / 2, channels], 1, 1, 1);
            x = net.pool("AveragePool", &n, 2, 2, 0);
            channels /= 2;
        }
    }
    let x = net.norm(&x, channels);
    let x = net.relu(&x);
    let x = net.op("GlobalAveragePool", &[&x], &[]);
    let shape = net.name("shape");
    net.file.integers(&shape, &[-1, channels]);
    let x = net.op("Reshape", &[&x, &shape], &[]);
    net.gemm(&x, channels, 10);
    net.case("DenseNet")
}

#[test]
fn generated_networks_agree() {
    let mut cases = Vec::new();
    for opset in [11, 13, 17] {
        cases.extend([resnet(opset, false), resnet(opset, true), densenet(opset), mobilenet_v2(opset)]);
    }
    for opset in [7, 9] {
        cases.extend([resnet(opset, true), densenet(opset), mobilenet_v2(opset)]);
    }
    for opset in [7, 13, 20] {
        cases.push(vgg(opset));
    }
    for opset in [10, 13, 20] {
        cases.push(squeezenet(opset));
    }
    compare(&cases);
}

/// Raw pixels through the default normalization, against ONNX Runtime on pixels normalized by the published rule.
#[test]
fn the_published_resnet20_agrees() {
    let Some(path) = commands::shared("data/models/resnet20-12fca82f.onnx") else { return };
    let Some(images) = commands::shared("data/cifar10/test") else { return };
    let mut files: Vec<_> = std::fs::read_dir(images).unwrap().map(|e| e.unwrap().path()).collect();
    files.retain(|file| file.extension().is_some_and(|e| e == "png"));
    files.sort();
    let graph = pipeline::load_graph(&path, &ImportOptions::default(), &PassOptions::default()).unwrap();
    assert_eq!(graph.system, "classifier");
    let output = graph.value(graph.outputs[0]);
    assert_eq!((output.name.as_str(), output.shape.channels), ("logits", 10));
    let (input, _) = graph.inputs().next().unwrap();
    let shape = graph.value(input).shape;
    let model = std::fs::read(&path).unwrap();
    let (mean, std) = ([0.485, 0.456, 0.406], [0.229, 0.224, 0.225]);
    let mut cases = Vec::new();
    let mut found = Vec::new();
    for file in files.iter().take(8) {
        let raw: Vec<f32> = image::open(file).unwrap().into_rgb8().iter().map(|&v| f32::from(v)).collect();
        let normalized = |(i, v): (usize, &f32)| ((f64::from(*v) / 255.0 - mean[i % 3]) / std[i % 3]) as f32;
        let pixels: Vec<f32> = raw.iter().enumerate().map(normalized).collect();
        let image = channels_first(&pixels, shape);
        cases.push(Case { name: file.display().to_string(), model: model.clone(), dims: vec![1, 3, 32, 32], image });
        found.push(reference::run(&graph, &[raw], |_, _| ()).unwrap().remove(0));
    }
    let Some(expected) = outputs(&cases) else { return };
    assert_eq!(found.len(), 8);
    for ((case, found), expected) in cases.iter().zip(&found).zip(&expected) {
        assert_close(&case.name, found, expected);
    }
}
