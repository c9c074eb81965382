//! A network of two steps in all its forms, for tests: camera 4×4 → max pool 2×2 → average pool, a vector of three.

use firmware::image::{Region, RegionName, TensorRecord};
use firmware::program::{self, Clamp, Requant, Step, Window};
use firmware::tensor::{ElementType, Shape, TensorId};
use model_compiler::artifact;
use model_compiler::emit::{AlignedBytes, ImageParts, ImagePort, emit};
use model_compiler::frames::{ByteMap, Frame};
use model_compiler::ir::{Graph, InputKind, Op};
use model_compiler::memory_plan::{ArenaPart, MemoryPlan, Placement, PlanStatus};
use model_compiler::qmodel::{Bounds, Port, QModel, QOp, QStep, QTensor, QTensorId};
use model_compiler::record::Record;

const CAMERA: Shape = Shape::map(4, 4, 3);
const POOLED: Shape = Shape::map(2, 2, 3);
const MEAN: Shape = Shape::vector(3);
const HALVE: Window = Window::square(2, 2, 0);
/// 1/64 per code: an average of four values is exact.
const MEAN_SCALE: f64 = 1.0 / 64.0;
/// `1 / (MEAN_SCALE·4) = 16`.
const REQUANT: Requant = Requant { multiplier: 1 << 23, shift: 19 };
const CLAMP: Clamp = Clamp { min: -32768, max: 32767 };

/// Image and record.
pub struct Sample {
    pub image: AlignedBytes,
    pub record: Record,
}

pub fn sample() -> Sample {
    let bytes = emit(&image_parts()).expect("the sample is a valid image");
    let record = Record {
        image_sha256: artifact::sha256(&bytes),
        target: "portable".into(),
        model: qmodel(),
        plan: MemoryPlan {
            order: vec![0, 1],
            tensors: vec![placement(0, 48, 0, 0), placement(48, 12, 0, 1), placement(64, 6, 1, 1)],
            scratch: vec![None, None],
            kernels: vec![None, None],
            regions: vec![ArenaPart {
                name: "main".into(),
                capacity: None,
                bytes: 80,
                bound_bytes: 64,
                peak_step: 0,
                status: PlanStatus::OptimalBoundNotReachable,
                traffic_bytes: 144,
            }],
            nodes: 1,
            alignment: 16,
        },
    };
    Sample { image: AlignedBytes::from(bytes.as_slice()), record }
}

pub fn graph() -> Graph {
    let mut graph = Graph { name: "sample".into(), system: "aim".into(), ..Graph::default() };
    let camera = graph.push_input("rgb", InputKind::Image, CAMERA);
    let pooled = graph.push("pool", Op::MaxPool(HALVE), &[camera]).unwrap();
    let mean = graph.push("mean", Op::AveragePool(HALVE), &[pooled]).unwrap();
    graph.outputs = vec![mean];
    graph
}

/// A frame whose pixels follow from a seed.
pub fn frame(seed: u8) -> Frame {
    let data = (0..48_u8).map(|i| i.wrapping_mul(37).wrapping_add(seed.wrapping_mul(91))).collect();
    Frame { name: format!("frame {seed}"), rgb: Some(ByteMap { shape: CAMERA, data }), ..Frame::default() }
}

fn qmodel() -> QModel {
    let tensor = |name: &str, shape, element, scale, zero_point| QTensor {
        name: name.into(),
        value: name.into(),
        shape,
        element,
        scale,
        zero_point,
        saturation_ppm: None,
    };
    let step = |name: &str, op| QStep { name: name.into(), node: Some(name.into()), op, bounds: Bounds::default() };
    let mean = QOp::AveragePool {
        input: QTensorId(1),
        output: QTensorId(2),
        window: HALVE,
        input_zero_point: -128,
        requant: REQUANT,
        zero_point: 0,
        clamp: CLAMP,
    };
    let port = |name: &str, id, kind| Port { name: name.into(), tensor: QTensorId(id), kind };
    QModel {
        name: "sample".into(),
        system: "aim".into(),
        tensors: vec![
            tensor("rgb", CAMERA, ElementType::I8, 1.0, -128),
            tensor("pool", POOLED, ElementType::I8, 1.0, -128),
            tensor("mean", MEAN, ElementType::I16, MEAN_SCALE, 0),
        ],
        steps: vec![
            step("pool", QOp::MaxPool { input: QTensorId(0), output: QTensorId(1), window: HALVE }),
            step("mean", mean),
        ],
        inputs: vec![port("rgb", 0, Some(InputKind::Image))],
        outputs: vec![port("mean", 2, None)],
        provenance: vec![("calibration_frames".into(), frame(1).short_digest())],
    }
}

fn image_parts() -> ImageParts {
    let record = |element, shape, offset, bytes, first_step, last_step| TensorRecord {
        element,
        shape,
        region: 0,
        offset,
        bytes,
        first_step,
        last_step,
        in_place_of: None,
    };
    let port =
        |name: &str, id, scale, zero_point| ImagePort { name: name.into(), tensor: TensorId(id), scale, zero_point };
    let mean = program::AveragePool {
        input: TensorId(1),
        output: TensorId(2),
        window: HALVE,
        input_zero_point: -128,
        requant: REQUANT,
        zero_point: 0,
        clamp: CLAMP,
    };
    ImageParts {
        name: "sample".into(),
        tensors: vec![
            record(ElementType::I8, CAMERA, 0, 48, 0, 0),
            record(ElementType::I8, POOLED, 48, 12, 0, 1),
            record(ElementType::I16, MEAN, 64, 6, 1, 1),
        ],
        steps: vec![
            Step::MaxPool(program::MaxPool { input: TensorId(0), output: TensorId(1), window: HALVE }),
            Step::AveragePool(mean),
        ],
        constants: vec![],
        inputs: vec![port("rgb", 0, 1.0, -128)],
        outputs: vec![port("mean", 2, MEAN_SCALE as f32, 0)],
        regions: vec![Region { name: RegionName::MAIN, bytes: 80, alignment: 16 }],
        qmodel_digest: [0; 32],
        build_digest: [0; 32],
        target: String::new(),
        revision: 0,
        known_answer: None,
    }
}

fn placement(offset: u64, bytes: u64, first_step: u32, last_step: u32) -> Placement {
    Placement { region: 0, offset, bytes, first_step, last_step, in_place_of: None }
}
