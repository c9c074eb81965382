//! Every operator of ONNX that is read, in every form it had from operator set 7 to 20: our f32 interpreter, before and
//! after the passes, gives what ONNX Runtime gives.

use tests::onnx_file::{Attribute, BOOL, OnnxFile, Tensor, float, int, ints, text};
use tests::onnxruntime::{Build, check, check_all, linear};

const IMAGE: [i64; 4] = [1, 3, 9, 8];

#[test]
fn conv() {
    fn plain(f: &mut OnnxFile, dims: &[i64], attributes: &[Attribute]) {
        let (w, b) = (f.weights("w", dims), f.weights("b", &dims[..1]));
        f.node("Conv", &["x", &w, &b], "y", attributes);
    }
    check_all(
        "Conv",
        &IMAGE,
        &[7, 11, 20],
        &[
            |f| plain(f, &[5, 3, 3, 3], &[]),
            |f| plain(f, &[5, 3, 3, 2], &[ints("kernel_shape", &[3, 2]), ints("strides", &[2, 1])]),
            |f| plain(f, &[5, 3, 3, 3], &[ints("pads", &[1, 0, 2, 1]), ints("dilations", &[2, 3])]),
            |f| plain(f, &[6, 1, 3, 3], &[int("group", 3), text("auto_pad", "SAME_UPPER"), ints("strides", &[2, 3])]),
            |f| plain(f, &[5, 3, 4, 2], &[text("auto_pad", "SAME_LOWER")]),
            |f| plain(f, &[5, 3, 2, 2], &[text("auto_pad", "VALID")]),
            |f| plain(f, &[5, 3, 9, 8], &[]),
            |f| {
                let w = f.weights("w", &[4, 3, 1, 1]);
                // More padding than the kernel reaches.
                f.node("Conv", &["x", &w], "y", &[ints("pads", &[1, 1, 1, 1])]);
            },
        ],
    );
}

#[test]
fn batch_normalization() {
    fn norm(f: &mut OnnxFile, input: &str, channels: i64, attributes: &[Attribute]) {
        let names = [f.weights("s", &[channels]), f.weights("b", &[channels]), f.weights("m", &[channels])];
        let v = f.positive("v", &[channels]);
        f.node("BatchNormalization", &[input, &names[0], &names[1], &names[2], &v], "y", attributes);
    }
    check_all(
        "BatchNormalization",
        &IMAGE,
        &[7, 9, 14, 15],
        &[
            |f| norm(f, "x", 3, &[]),
            |f| norm(f, "x", 3, &[float("epsilon", 0.25), float("momentum", 0.5)]),
            |f| {
                let w = f.weights("w", &[4, 3, 3, 3]);
                f.node("Conv", &["x", &w], "c", &[ints("pads", &[1, 1, 1, 1])]);
                norm(f, "c", 4, &[]);
            },
            |f| {
                let w = f.weights("w", &[4, 3 * 9 * 8]);
                f.node("Flatten", &["x"], "flat", &[]).node("Gemm", &["flat", &w, ""], "g", &[int("transB", 1)]);
                if f.opset < 11 {
                    let c = f.weights("c", &[4]);
                    f.nodes[1].input[2] = c;
                }
                norm(f, "g", 4, &[]);
            },
        ],
    );
    check("BatchNormalization, training mode off", &IMAGE, &[14, 15], |f| norm(f, "x", 3, &[int("training_mode", 0)]));
}

#[test]
fn batch_normalization_before_convolutions() {
    fn before(f: &mut OnnxFile, pads: i64) {
        let names = [f.weights("s", &[3]), f.weights("b", &[3]), f.weights("m", &[3]), f.positive("v", &[3])];
        f.node("MaxPool", &["x"], "p", &[ints("kernel_shape", &[2, 2])]);
        f.node("BatchNormalization", &["p", &names[0], &names[1], &names[2], &names[3]], "n", &[]);
        let w = f.weights("w", &[6, 1, 3, 3]);
        f.node("Conv", &["n", &w], "y", &[int("group", 3), ints("pads", &[pads; 4])]);
    }
    check_all("BatchNormalization, Conv", &IMAGE, &[9, 15], &[|f| before(f, 0), |f| before(f, 1)]);
}

#[test]
fn relu_and_clip() {
    check("Relu", &IMAGE, &[7, 13, 14], |f| _ = f.node("Relu", &["x"], "y", &[]));
    check("Clip", &IMAGE, &[7, 10], |f| _ = f.node("Clip", &["x"], "y", &[float("min", -0.5), float("max", 1.0)]));
    check("Clip above", &IMAGE, &[7, 10], |f| _ = f.node("Clip", &["x"], "y", &[float("max", 1.0)]));
    check_all(
        "Clip",
        &IMAGE,
        &[11, 12, 13],
        &[
            |f| {
                let (min, max) = (f.floats("min", &[], &[0.0]), f.floats("max", &[], &[1.5]));
                f.node("Clip", &["x", &min, &max], "y", &[]);
            },
            |f| {
                let max = f.floats("max", &[], &[-0.5]);
                f.node("Clip", &["x", "", &max], "y", &[]);
            },
            |f| {
                let min = f.floats("min", &[], &[0.25]);
                f.node("Clip", &["x", &min], "y", &[]);
            },
            |f| _ = f.node("Clip", &["x"], "y", &[]),
        ],
    );
}

#[test]
fn arithmetic() {
    fn with_constant(f: &mut OnnxFile, op: &str, dims: &[i64]) {
        let c = f.positive("c", dims);
        f.node(op, &["x", &c], "y", &[]);
    }
    check_all(
        "Add",
        &IMAGE,
        &[7, 13, 14],
        &[
            |f| _ = f.node("Relu", &["x"], "r", &[]).node("Add", &["x", "r"], "y", &[]),
            |f| _ = f.node("Add", &["x", "x"], "y", &[]),
            |f| with_constant(f, "Add", &[3, 1, 1]),
            |f| with_constant(f, "Add", &[1, 3, 1, 1]),
            |f| with_constant(f, "Add", &[]),
            |f| with_constant(f, "Add", &[1]),
            |f| with_constant(f, "Sub", &[3, 1, 1]),
            |f| with_constant(f, "Mul", &[1, 3, 1, 1]),
            |f| with_constant(f, "Div", &[3, 1, 1]),
            |f| {
                let c = f.weights("c", &[3, 1, 1]);
                f.node("Sub", &[&c, "x"], "d", &[]).node("Mul", &[&c, "d"], "m", &[]).node("Add", &[&c, "m"], "y", &[]);
            },
            |f| {
                let (w, c) = (f.weights("w", &[4, 3, 3, 3]), f.weights("c", &[1, 4, 1, 1]));
                f.node("Conv", &["x", &w], "conv", &[]).node("Add", &[&c, "conv"], "y", &[]);
            },
        ],
    );
}

#[test]
fn max_pool() {
    fn pool(f: &mut OnnxFile, attributes: &[Attribute]) {
        f.node("MaxPool", &["x"], "y", attributes);
    }
    check_all(
        "MaxPool",
        &IMAGE,
        &[7, 8, 10, 11, 12],
        &[
            |f| pool(f, &[ints("kernel_shape", &[2, 3])]),
            |f| pool(f, &[ints("kernel_shape", &[3, 3]), ints("strides", &[2, 2]), ints("pads", &[1, 1, 1, 1])]),
            |f| pool(f, &[ints("kernel_shape", &[3, 3]), ints("strides", &[2, 2]), text("auto_pad", "SAME_UPPER")]),
            |f| pool(f, &[ints("kernel_shape", &[2, 4]), ints("strides", &[2, 3]), text("auto_pad", "SAME_LOWER")]),
        ],
    );
    check_all(
        "MaxPool",
        &IMAGE,
        &[10, 11, 12],
        &[
            |f| pool(f, &[ints("kernel_shape", &[3, 3]), ints("strides", &[2, 2]), int("ceil_mode", 1)]),
            |f| pool(f, &[ints("kernel_shape", &[2, 2]), ints("dilations", &[3, 2])]),
            |f| {
                pool(
                    f,
                    &[
                        ints("kernel_shape", &[2, 2]),
                        ints("strides", &[2, 2]),
                        ints("pads", &[1, 1, 1, 1]),
                        int("ceil_mode", 1),
                    ],
                )
            },
            |f| pool(f, &[ints("kernel_shape", &[1, 1]), ints("strides", &[3, 5]), int("ceil_mode", 1)]),
        ],
    );
}

#[test]
fn average_pool() {
    fn pool(f: &mut OnnxFile, attributes: &[Attribute]) {
        f.node("AveragePool", &["x"], "y", attributes);
    }
    check_all(
        "AveragePool",
        &IMAGE,
        &[7, 10, 11, 19],
        &[
            |f| pool(f, &[ints("kernel_shape", &[3, 2]), ints("strides", &[2, 2])]),
            |f| pool(f, &[ints("kernel_shape", &[3, 3]), ints("pads", &[1, 0, 1, 2]), int("count_include_pad", 1)]),
            |f| pool(f, &[ints("kernel_shape", &[3, 2]), ints("strides", &[3, 2]), text("auto_pad", "SAME_UPPER")]),
        ],
    );
    check("AveragePool, dilated", &IMAGE, &[19, 20], |f| {
        pool(f, &[ints("kernel_shape", &[3, 2]), ints("dilations", &[2, 3])]);
    });
    check("AveragePool, even ceiling", &IMAGE, &[10, 19], |f| {
        pool(f, &[ints("kernel_shape", &[3, 2]), ints("strides", &[3, 2]), int("ceil_mode", 1)]);
    });
}

#[test]
fn global_pools_and_means() {
    check("GlobalAveragePool", &IMAGE, &[7, 20], |f| _ = f.node("GlobalAveragePool", &["x"], "y", &[]));
    check("GlobalMaxPool", &IMAGE, &[7, 20], |f| _ = f.node("GlobalMaxPool", &["x"], "y", &[]));
    check_all(
        "ReduceMean",
        &IMAGE,
        &[7, 11, 13],
        &[
            |f| _ = f.node("ReduceMean", &["x"], "y", &[ints("axes", &[2, 3])]),
            |f| _ = f.node("ReduceMean", &["x"], "y", &[ints("axes", &[3, 2]), int("keepdims", 0)]),
        ],
    );
    check("ReduceMean, from the end", &IMAGE, &[11, 13], |f| {
        f.node("ReduceMean", &["x"], "y", &[ints("axes", &[-1, -2]), int("keepdims", 0)]);
    });
    check_all(
        "ReduceMean",
        &IMAGE,
        &[18, 20],
        &[
            |f| {
                let axes = f.integers("axes", &[-2, -1]);
                f.node("ReduceMean", &["x", &axes], "y", &[int("keepdims", 1)]);
            },
            |f| _ = f.node("ReduceMean", &["x"], "i", &[int("noop_with_empty_axes", 1)]).node("Relu", &["i"], "y", &[]),
        ],
    );
}

#[test]
fn gemm_and_matmul() {
    fn after_flatten(f: &mut OnnxFile, op: &str, inputs: &[&str], attributes: &[Attribute]) {
        f.node("Flatten", &["x"], "flat", &[]).node("Relu", &["flat"], "r", &[]).node("Dropout", &["r"], "d", &[]);
        f.node(op, &[&["d"], inputs].concat(), "y", attributes);
    }
    for dims in [[1, 3, 1, 1], [1, 3, 2, 4]] {
        let build: &[Build] = if dims[2] == 1 { &gemms::<3>() } else { &gemms::<24>() };
        check_all("Gemm", &dims, &[7, 9, 11, 13], build);
    }
    fn gemms<const K: i64>() -> [Build; 4] {
        [
            |f| {
                let (w, b) = (f.weights("w", &[K, 5]), f.weights("b", &[5]));
                after_flatten(f, "Gemm", &[&w, &b], &[]);
            },
            |f| {
                let (w, b) = (f.weights("w", &[5, K]), f.weights("b", &[1, 5]));
                after_flatten(f, "Gemm", &[&w, &b], &[int("transB", 1), float("alpha", 0.5), float("beta", 2.0)]);
            },
            |f| {
                let (w, b) = (f.weights("w", &[5, K]), f.weights("b", &[1]));
                after_flatten(f, "Gemm", &[&w, &b], &[int("transB", 1)]);
            },
            |f| {
                let (w, b) = (f.weights("w", &[K, 5]), f.weights("b", &[5]));
                f.node("Flatten", &["x"], "flat", &[]).node("MatMul", &["flat", &w], "m", &[]);
                f.node("Add", &["m", &b], "y", &[]);
            },
        ]
    }
    check("Gemm without bias", &[1, 3, 1, 1], &[11, 13], |f| {
        let w = f.weights("w", &[3, 5]);
        after_flatten(f, "Gemm", &[&w], &[]);
    });
    check("MatMul", &[1, 3, 2, 2], &[7, 9, 13], |f| {
        let w = f.weights("w", &[12, 5]);
        after_flatten(f, "MatMul", &[&w], &[]);
    });
}

#[test]
fn flatten_and_reshape() {
    check("Flatten", &[1, 3, 2, 4], &[7, 9, 11, 13], |f| {
        f.node("Flatten", &["x"], "flat", &[int("axis", 1)]);
        linear(f, "flat", 24);
    });
    check("Flatten from the end", &[1, 3, 2, 4], &[11, 13], |f| {
        f.node("Flatten", &["x"], "flat", &[int("axis", -3)]);
        linear(f, "flat", 24);
    });
    check_all(
        "Reshape",
        &[1, 3, 2, 4],
        &[7, 13, 14, 19],
        &[
            |f| {
                let shape = f.integers("shape", &[-1, 24]);
                f.node("Reshape", &["x", &shape], "flat", &[]);
                linear(f, "flat", 24);
            },
            |f| {
                let (through, shape) = (f.integers("through", &[0, 0, 8]), f.integers("shape", &[0, -1]));
                f.node("Reshape", &["x", &through], "rows", &[]).node("Reshape", &["rows", &shape], "flat", &[]);
                linear(f, "flat", 24);
            },
            |f| {
                let shape = f.integers("shape", &[0, 3, 2, -1]);
                f.node("Flatten", &["x"], "flat", &[]).node("Reshape", &["flat", &shape], "back", &[]);
                f.node("Relu", &["back"], "y", &[]);
            },
        ],
    );
    check("Reshape, zeros allowed", &[1, 3, 2, 4], &[14, 19], |f| {
        let shape = f.integers("shape", &[1, 24]);
        f.node("Reshape", &["x", &shape], "flat", &[int("allowzero", 1)]);
        linear(f, "flat", 24);
    });
}

#[test]
fn squeeze_unsqueeze_transpose() {
    let vector = [1, 3, 5, 4];
    check_all(
        "Squeeze",
        &vector,
        &[7, 11],
        &[
            |f| {
                f.node("GlobalAveragePool", &["x"], "p", &[]).node("Squeeze", &["p"], "s", &[ints("axes", &[2, 3])]);
                linear(f, "s", 3);
            },
            |f| {
                f.node("GlobalAveragePool", &["x"], "p", &[]).node("Squeeze", &["p"], "s", &[]);
                f.node("Unsqueeze", &["s"], "u", &[ints("axes", &[0])]);
                linear(f, "u", 3);
            },
        ],
    );
    check("Squeeze", &vector, &[13, 20], |f| {
        let (axes, batch) = (f.integers("axes", &[-1, 0, 2]), f.integers("batch", &[0]));
        f.node("GlobalAveragePool", &["x"], "p", &[]).node("Squeeze", &["p", &axes], "s", &[]);
        f.node("Unsqueeze", &["s", &batch], "u", &[]);
        linear(f, "u", 3);
    });
    check("Transpose", &vector, &[7, 13], |f| {
        f.node("GlobalAveragePool", &["x"], "p", &[]).node("Transpose", &["p"], "t", &[ints("perm", &[0, 2, 3, 1])]);
        f.node("Flatten", &["t"], "flat", &[]);
        linear(f, "flat", 3);
    });
    check("Transpose of a constant", &[1, 3, 1, 1], &[7, 13], |f| {
        let w = f.weights("w", &[4, 3]);
        f.node("Flatten", &["x"], "flat", &[]).node("Transpose", &[&w], "t", &[]);
        f.node("MatMul", &["flat", "t"], "y", &[]);
    });
}

#[test]
fn pad() {
    check_all(
        "Pad",
        &IMAGE,
        &[7, 10],
        &[
            |f| _ = f.node("Pad", &["x"], "y", &[ints("pads", &[0, 1, 2, 0, 0, 2, 0, 1]), float("value", 0.5)]),
            |f| _ = f.node("Pad", &["x"], "y", &[ints("pads", &[0, 0, 1, 1, 0, 0, 1, 1]), text("mode", "constant")]),
        ],
    );
    check_all(
        "Pad",
        &IMAGE,
        &[11, 13, 18, 19],
        &[
            |f| {
                let (pads, value) = (f.integers("pads", &[0, 1, 2, 0, 0, 2, 0, 1]), f.floats("value", &[], &[-0.25]));
                f.node("Pad", &["x", &pads, &value], "y", &[]);
            },
            |f| {
                let (pads, w) = (f.integers("pads", &[0, 0, 1, 1, 0, 0, 2, 0]), f.weights("w", &[4, 3, 3, 3]));
                f.node("Pad", &["x", &pads], "p", &[]).node("Conv", &["p", &w], "y", &[]);
            },
            |f| {
                let (pads, value) =
                    (f.integers("pads", &[0, 0, 1, 1, 0, 0, 1, 1]), f.floats("v", &[], &[f32::NEG_INFINITY]));
                f.node("Pad", &["x", &pads, &value], "p", &[]);
                f.node("MaxPool", &["p"], "y", &[ints("kernel_shape", &[3, 3]), ints("strides", &[2, 2])]);
            },
        ],
    );
    check("Pad of axes", &IMAGE, &[18, 19], |f| {
        let (pads, axes) = (f.integers("pads", &[1, 2, 0, 3]), f.integers("axes", &[-1, 1]));
        f.node("Pad", &["x", &pads, "", &axes], "y", &[]);
    });
}

#[test]
fn slice_and_concat() {
    check_all(
        "Slice",
        &IMAGE,
        &[7, 9],
        &[
            |f| _ = f.node("Slice", &["x"], "y", &[ints("starts", &[0, 1, 2]), ints("ends", &[1, 3, -1])]),
            |f| {
                _ = f.node(
                    "Slice",
                    &["x"],
                    "y",
                    &[ints("axes", &[3]), ints("starts", &[-4]), ints("ends", &[i64::MAX])],
                )
            },
        ],
    );
    check_all(
        "Slice",
        &IMAGE,
        &[10, 11, 13],
        &[
            |f| {
                let names = [f.integers("s", &[0, 1]), f.integers("e", &[i64::MAX, -1]), f.integers("a", &[2, 3])];
                let steps = f.integers("steps", &[2, 3]);
                f.node("Slice", &["x", &names[0], &names[1], &names[2], &steps], "y", &[]);
            },
            |f| {
                let (s, e) = (f.integers("s", &[0, 1]), f.integers("e", &[1, 3]));
                f.node("Slice", &["x", &s, &e], "y", &[]);
            },
        ],
    );
    check_all(
        "Concat",
        &IMAGE,
        &[7, 11, 13],
        &[
            |f| _ = f.node("Relu", &["x"], "r", &[]).node("Concat", &["x", "r", "x"], "y", &[int("axis", 1)]),
            |f| _ = f.node("Relu", &["x"], "r", &[]).node("Concat", &["x", "r"], "y", &[int("axis", 2)]),
            |f| _ = f.node("Relu", &["x"], "r", &[]).node("Concat", &["r", "x"], "y", &[int("axis", 3)]),
        ],
    );
    check("Concat from the end", &IMAGE, &[11, 13], |f| {
        f.node("Relu", &["x"], "r", &[]).node("Concat", &["x", "r"], "y", &[int("axis", -3)]);
    });
}

#[test]
fn softmax() {
    check("Softmax", &[1, 3, 1, 1], &[7, 11, 13], |f| {
        f.node("Flatten", &["x"], "flat", &[]).node("Softmax", &["flat"], "y", &[int("axis", 1)]);
    });
    check_all(
        "Softmax",
        &[1, 3, 1, 1],
        &[7, 11],
        &[
            |f| _ = f.node("Softmax", &["x"], "y", &[]),
            |f| _ = f.node("Flatten", &["x"], "flat", &[]).node("Softmax", &["flat"], "y", &[]),
        ],
    );
    check("Softmax per pixel", &IMAGE, &[13, 20], |f| _ = f.node("Softmax", &["x"], "y", &[int("axis", -3)]));
}

#[test]
fn identity_and_dropout() {
    check("Identity", &IMAGE, &[7, 13, 14, 16, 19], |f| {
        f.node("Relu", &["x"], "r", &[]).node("Identity", &["r"], "y", &[]);
    });
    check("Dropout", &IMAGE, &[7, 10], |f| _ = f.node("Dropout", &["x"], "y", &[float("ratio", 0.9)]));
    check("Dropout", &IMAGE, &[12, 13], |f| {
        let ratio = f.floats("ratio", &[], &[0.9]);
        let off = Tensor { data_type: BOOL, name: "off".into(), raw_data: vec![0], ..Default::default() };
        f.tensors.push(off);
        f.node("Dropout", &["x", &ratio, "off"], "y", &[]);
    });
}

/// Two outputs keep their names and order, and an output may be a value that others read.
#[test]
fn several_outputs() {
    check("outputs", &IMAGE, &[13], |f| {
        f.output("z");
        f.node("Relu", &["x"], "z", &[]).node("GlobalAveragePool", &["z"], "y", &[]);
    });
}
