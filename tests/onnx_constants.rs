//! Constants of ONNX files and what exporters compute of them, against ONNX Runtime.

use tests::onnx_file::{Tensor, float, floats, int, ints, tensor, text};
use tests::onnxruntime::{check, check_all, linear};

const IMAGE: [i64; 4] = [1, 3, 9, 8];

#[test]
fn constants_in_every_form() {
    check("Constant, a tensor", &IMAGE, &[7, 9, 11, 13, 19], |f| {
        let value = Tensor::floats("", &[3, 1, 1], &[1.0, -2.0, 0.5]);
        f.node("Constant", &[], "c", &[tensor("value", value)]).node("Add", &["x", "c"], "y", &[]);
    });
    check_all(
        "Constant",
        &IMAGE,
        &[12, 13],
        &[
            |f| {
                f.node("Constant", &[], "c", &[float("value_float", 0.5)]).node("Add", &["x", "c"], "y", &[]);
            },
            |f| {
                let shape = f.integers("shape", &[3, 1, 1]);
                f.node("Constant", &[], "l", &[floats("value_floats", &[1.0, -2.0, 0.5])]);
                f.node("Reshape", &["l", &shape], "c", &[]).node("Add", &["x", "c"], "y", &[]);
            },
            |f| {
                f.node("Constant", &[], "i", &[int("value_int", -3)]).node("Cast", &["i"], "c", &[int("to", 1)]);
                f.node("Add", &["x", "c"], "y", &[]);
            },
            |f| {
                f.node("Constant", &[], "s", &[ints("value_ints", &[1, 216])]).node(
                    "Reshape",
                    &["x", "s"],
                    "flat",
                    &[],
                );
                linear(f, "flat", 216);
            },
        ],
    );
}

/// What PyTorch writes for `x.view(x.size(0), -1)` and for `F.pad`.
#[test]
fn exported_shape_arithmetic() {
    check("view", &[1, 3, 2, 4], &[9, 11, 12], |f| {
        let zero = Tensor::integers("", &[], &[0]);
        f.node("Shape", &["x"], "shape", &[]).node("Constant", &[], "zero", &[tensor("value", zero)]);
        f.node("Gather", &["shape", "zero"], "n", &[int("axis", 0)]).node(
            "Unsqueeze",
            &["n"],
            "u",
            &[ints("axes", &[0])],
        );
        let rest = f.integers("rest", &[-1]);
        f.node("Concat", &["u", &rest], "s", &[int("axis", 0)]).node("Reshape", &["x", "s"], "flat", &[]);
        linear(f, "flat", 24);
    });
    check("pad", &[1, 3, 2, 4], &[11, 12, 13], |f| {
        // (left, right, top, bottom) with zeros for the other axes, halves exchanged, last axis first.
        let given = f.integers("given", &[1, 2, 0, 1]);
        let zeros = Tensor::integers("", &[1], &[0]);
        let four = f.integers("four", &[4]);
        f.node("ConstantOfShape", &[&four], "zeros", &[tensor("value", zeros)]);
        f.node("Concat", &[&given, "zeros"], "all", &[int("axis", 0)]);
        let (pairs, flat) = (f.integers("pairs", &[-1, 2]), f.integers("flat", &[-1]));
        f.node("Reshape", &["all", &pairs], "matrix", &[]);
        let names = ["s", "e", "a", "step"].map(|name| {
            f.integers(
                name,
                &[match name {
                    "e" => -i64::MAX,
                    "a" => 0,
                    _ => -1,
                }],
            )
        });
        f.node("Slice", &["matrix", &names[0], &names[1], &names[2], &names[3]], "turned", &[]);
        f.node("Transpose", &["turned"], "t", &[ints("perm", &[1, 0])]).node("Reshape", &["t", &flat], "p", &[]);
        f.node("Cast", &["p"], "pads", &[int("to", 7)]).node("Pad", &["x", "pads"], "y", &[text("mode", "constant")]);
    });
    check("part of a shape", &[1, 3, 2, 4], &[15, 19], |f| {
        f.node("Shape", &["x"], "hw", &[int("start", -2)]).node("Shape", &["x"], "nc", &[int("end", 2)]);
        let zero = f.integers("zero", &[0]);
        f.node("Gather", &["hw", &zero], "h", &[]).node("Add", &["h", "h"], "hh", &[]).node(
            "Mul",
            &["hh", "h"],
            "m",
            &[],
        );
        f.node("Div", &["m", "h"], "w", &[]).node("Sub", &["w", "h"], "hs", &[]);
        f.node("Concat", &["nc", "hs", "w"], "s", &[int("axis", 0)]);
        f.node("Flatten", &["x"], "flat", &[]).node("Reshape", &["flat", "s"], "r", &[]).node("Relu", &["r"], "y", &[]);
    });
}
