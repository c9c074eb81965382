//! A small image with every step kind, in-place pairs, scratch, shared memory and a known answer.

#![allow(dead_code, reason = "each test uses its own subset")]

use firmware::image::{Region, RegionName, TensorRecord};
use firmware::kernels::plan;
use firmware::program::*;
use firmware::tensor::{ElementType, Shape, TensorId};
use model_compiler::emit::{ConstantsBuilder, ImageParts, ImagePort, KnownAnswer};

const I8: ElementType = ElementType::I8;
const I16: ElementType = ElementType::I16;
const I32: ElementType = ElementType::I32;

/// Indices of the sample's tensors.
pub mod ids {
    pub const RGB: u16 = 0;
    pub const LIDAR: u16 = 1;
    pub const VELOCITY: u16 = 2;
    pub const GOAL: u16 = 3;
    pub const STEM: u16 = 4;
    pub const POOLED: u16 = 5;
    pub const LIDAR_WIDE: u16 = 6;
    pub const LIDAR_NARROW: u16 = 7;
    pub const STREAM: u16 = 8;
    pub const NORMED: u16 = 9;
    pub const QUERY: u16 = 10;
    pub const KEY: u16 = 11;
    pub const VALUE: u16 = 12;
    pub const CONTEXT: u16 = 13;
    pub const STREAM_2: u16 = 14;
    pub const GRID: u16 = 15;
    pub const FUSED: u16 = 16;
    pub const SUM: u16 = 17;
    pub const BLOCK: u16 = 18;
    pub const SMALL: u16 = 19;
    pub const VECTOR: u16 = 20;
    pub const HIDDEN: u16 = 21;
    pub const WAYPOINTS: u16 = 22;
    pub const BOX: u16 = 23;
    pub const JOINED: u16 = 24;
    pub const PROBABILITIES: u16 = 25;
    pub const CELLS: u16 = 26;
    pub const GATHERED: u16 = 27;
    pub const COMMAND: u16 = 28;
    pub const BRANCH: u16 = 29;
    pub const CONTROLS: u16 = 30;
    pub const POINTS: u16 = 31;
    /// First scratch record.
    pub const SCRATCH: u16 = 32;
}

/// Positions of the sample's steps.
pub mod at {
    pub const CONV: usize = 0;
    pub const MAX_POOL: usize = 1;
    pub const GROUPED_CONV: usize = 2;
    pub const REQUANTIZE: usize = 3;
    pub const TOKENS: usize = 4;
    pub const LAYER_NORM: usize = 5;
    pub const LINEAR_QUERY: usize = 6;
    pub const ATTENTION: usize = 9;
    pub const LINEAR_STREAM: usize = 10;
    pub const LAYER_NORM_ROWS: usize = 11;
    pub const RESIZE: usize = 12;
    pub const ADD: usize = 13;
    pub const RESIDUAL_CONV: usize = 14;
    pub const AVERAGE_POOL: usize = 15;
    pub const GLOBAL_POOL: usize = 16;
    pub const LINEAR_WIDE: usize = 17;
    pub const DECODER: usize = 18;
    pub const COPY_BOX: usize = 19;
    pub const CONCAT: usize = 20;
    pub const SOFTMAX: usize = 21;
    pub const GATHER_SUM: usize = 22;
    pub const BRANCH_LINEAR: usize = 23;
    pub const SIGMOID: usize = 24;
    pub const SPATIAL_SOFTMAX: usize = 25;
}

pub const STEPS: usize = 26;

/// Deterministic constants.
struct Numbers {
    state: u64,
    builder: ConstantsBuilder,
}

impl Numbers {
    fn draw(&mut self, low: i64, high: i64) -> i64 {
        self.state = self.state.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
        low + ((self.state >> 33) as i64).rem_euclid(high - low + 1)
    }

    fn push<T: bytemuck::NoUninit>(
        &mut self,
        count: usize,
        low: i64,
        high: i64,
        convert: impl Fn(i64) -> T,
    ) -> ConstRange {
        let elements: Vec<T> = (0..count).map(|_| convert(self.draw(low, high))).collect();
        self.builder.push(&elements).expect("fits")
    }

    fn weights(&mut self, count: usize) -> ConstRange {
        self.push(count, -127, 127, |v| v as i8)
    }

    fn words(&mut self, count: usize, low: i64, high: i64) -> ConstRange {
        self.push(count, low, high, |v| v as i32)
    }

    fn rescale(&mut self, channels: usize, element: ElementType, residual: Residual) -> Rescale {
        let (shift_low, shift_high, factor) = match residual {
            Residual::Scaled { .. } => (30, 34, (1 << 23, 1 << 24)),
            _ => (32, 36, (1 << 23, (1 << 24) - 1)),
        };
        Rescale {
            pre_shift: 0,
            bias: self.words(channels, -5000, 5000),
            multipliers: self.words(channels, factor.0, factor.1),
            shifts: self.push(channels, shift_low, shift_high, |v| v as u8),
            zero_point: if element == I8 { -3 } else { 0 },
            clamp: clamp(element),
            residual,
        }
    }
}

fn clamp(element: ElementType) -> Clamp {
    let codes = element.codes();
    Clamp { min: *codes.start(), max: *codes.end() }
}

fn requant() -> Requant {
    Requant { multiplier: 12_345_678, shift: 24 }
}

fn term(tensor: u16, zero_point: i16) -> Term {
    Term { tensor: TensorId(tensor), zero_point, multiplier: 1 << 30 }
}

/// The whole sample.
pub fn parts() -> ImageParts {
    let mut numbers = Numbers { state: 1, builder: ConstantsBuilder::new() };
    let shapes = shapes();
    let mut steps = steps(&mut numbers);
    let tensors = place(&shapes, &mut steps);
    let arena_bytes = tensors.iter().map(|t| t.end().next_multiple_of(16)).max().expect("tensors") as u32;
    let port =
        |name: &str, tensor| ImagePort { name: name.into(), tensor: TensorId(tensor), scale: 0.5, zero_point: 0 };
    ImageParts {
        name: "sample".into(),
        tensors,
        steps,
        constants: numbers.builder.finish(),
        inputs: vec![
            port("rgb", ids::RGB),
            port("bev", ids::LIDAR),
            port("velocity", ids::VELOCITY),
            port("goal", ids::GOAL),
            port("cells", ids::CELLS),
            port("command", ids::COMMAND),
        ],
        outputs: vec![
            ImagePort { scale: 1.0 / 65536.0, ..port("waypoints", ids::WAYPOINTS) },
            port("probabilities", ids::PROBABILITIES),
            port("gathered", ids::GATHERED),
            port("controls", ids::CONTROLS),
            ImagePort { scale: 1.0 / 64.0, ..port("points", ids::POINTS) },
        ],
        regions: vec![Region { name: RegionName::MAIN, bytes: arena_bytes, alignment: 16 }],
        qmodel_digest: [7; 32],
        build_digest: [9; 32],
        target: "cortex-m4".into(),
        revision: 3,
        known_answer: Some(KnownAnswer { seed: 42, step_crcs: vec![0; STEPS] }),
    }
}

fn shapes() -> Vec<(Shape, ElementType)> {
    let (grid, small, tokens) = (Shape::map(4, 4, 8), Shape::map(2, 2, 8), Shape::tokens(8, 8));
    vec![
        (Shape::map(8, 8, 3), I8),
        (Shape::map(8, 8, 4), I8),
        (Shape::vector(1), I16),
        (Shape::vector(2), I32),
        (Shape::map(8, 8, 8), I8),
        (grid, I8),
        (grid, I16),
        (grid, I8),
        (tokens, I16),
        (tokens, I8),
        (tokens, I8),
        (tokens, I8),
        (tokens, I8),
        (tokens, I8),
        (tokens, I16),
        (small, I8),
        (grid, I8),
        (grid, I8),
        (grid, I8),
        (small, I8),
        (Shape::vector(8), I16),
        (Shape::vector(8), I16),
        (Shape::tokens(4, 2), I32),
        (Shape::map(3, 4, 8), I8),
        (Shape::map(7, 4, 8), I16),
        (Shape::map(7, 4, 8), I16),
        (Shape::map(2, 3, 6), I8),
        (Shape::map(2, 3, 8), I16),
        (Shape::vector(1), I8),
        (Shape::vector(3), I16),
        (Shape::vector(3), I16),
        (Shape::tokens(8, 2), I32),
    ]
}

fn steps(n: &mut Numbers) -> Vec<Step> {
    vec![
        conv(n, (ids::RGB, 3), (ids::STEM, 8, I8), Window::square(3, 1, 1), 1, Residual::None),
        Step::MaxPool(MaxPool {
            input: TensorId(ids::STEM),
            output: TensorId(ids::POOLED),
            window: Window::square(2, 2, 0),
        }),
        conv(n, (ids::LIDAR, 4), (ids::LIDAR_WIDE, 8, I16), Window::square(3, 2, 1), 2, Residual::None),
        Step::Requantize(Requantize {
            input: TensorId(ids::LIDAR_WIDE),
            output: TensorId(ids::LIDAR_NARROW),
            input_zero_point: 0,
            requant: requant(),
            zero_point: 4,
            clamp: clamp(I8),
        }),
        tokens(n),
        layer_norm(n, ids::STREAM, ids::NORMED, 0),
        linear(n, ids::NORMED, (ids::QUERY, I8), false, Residual::None),
        linear(n, ids::NORMED, (ids::KEY, I8), false, Residual::None),
        linear(n, ids::NORMED, (ids::VALUE, I8), false, Residual::None),
        attention(n),
        linear(n, ids::CONTEXT, (ids::STREAM_2, I16), false, Residual::Stream { tensor: TensorId(ids::STREAM) }),
        layer_norm(n, ids::STREAM_2, ids::GRID, 4),
        resize(n),
        Step::Add(Add {
            first: term(ids::FUSED, 2),
            second: term(ids::LIDAR_NARROW, 4),
            output: TensorId(ids::SUM),
            shift: 31,
            zero_point: 0,
            clamp: clamp(I8),
        }),
        residual_conv(n),
        Step::AveragePool(AveragePool {
            input: TensorId(ids::SUM),
            output: TensorId(ids::SMALL),
            window: Window::square(2, 2, 0),
            input_zero_point: 0,
            requant: requant(),
            zero_point: 0,
            clamp: clamp(I8),
        }),
        Step::GlobalPool(GlobalPool {
            first: term(ids::BLOCK, -3),
            second: Some(term(ids::SMALL, 0)),
            output: TensorId(ids::VECTOR),
            shift: 34,
            zero_point: 0,
            clamp: clamp(I16),
        }),
        linear(n, ids::VECTOR, (ids::HIDDEN, I16), true, Residual::None),
        decoder(n),
        Step::CopyBox(CopyBox {
            input: TensorId(ids::BLOCK),
            output: TensorId(ids::BOX),
            begin: [1, 0, 2],
            stride: [2, 1, 3],
            size: [2, 3, 2],
            before: [0, 1, 3],
            border: -3,
        }),
        concat(),
        softmax(n),
        gather_sum(),
        branch_linear(n),
        sigmoid(n),
        spatial_softmax(n),
    ]
}

fn conv(
    n: &mut Numbers,
    (input, channels): (u16, usize),
    (output, outputs, element): (u16, usize, ElementType),
    window: Window,
    groups: u16,
    residual: Residual,
) -> Step {
    let taps = usize::from(window.kernel_h) * usize::from(window.kernel_w);
    Step::Conv2d(Conv2d {
        input: TensorId(input),
        output: TensorId(output),
        window,
        groups,
        kernel: KernelId::Direct,
        weights: n.weights(outputs * taps * channels / usize::from(groups)),
        padding_codes: n.weights(channels),
        rescale: n.rescale(outputs, element, residual),
        scratch: None,
    })
}

fn residual_conv(n: &mut Numbers) -> Step {
    let multipliers = n.words(8, 1 << 28, 1 << 29);
    let residual = Residual::Scaled { tensor: TensorId(ids::FUSED), zero_point: 2, multipliers };
    conv(n, (ids::SUM, 8), (ids::BLOCK, 8, I8), Window::square(1, 1, 0), 1, residual)
}

fn linear(n: &mut Numbers, input: u16, output: (u16, ElementType), wide: bool, residual: Residual) -> Step {
    Step::Linear(Linear {
        input: TensorId(input),
        output: TensorId(output.0),
        kernel: KernelId::Direct,
        weights: n.weights(64),
        wide,
        rescale: n.rescale(8, output.1, residual),
        scratch: None,
    })
}

fn tokens(n: &mut Numbers) -> Step {
    let source =
        |map, zero_point| TokenSource { map: TensorId(map), zero_point, pool_h: 2, pool_w: 2, multiplier: 1 << 20 };
    Step::Tokens(Tokens {
        first: source(ids::POOLED, -3),
        second: source(ids::LIDAR_NARROW, 4),
        velocity: TensorId(ids::VELOCITY),
        output: TensorId(ids::STREAM),
        velocity_multipliers: n.words(8, -(1 << 16), 1 << 16),
        position: n.push(64, -500, 500, |v| v as i16),
        shift: 18,
        zero_point: 0,
        clamp: clamp(I16),
    })
}

fn layer_norm(n: &mut Numbers, input: u16, output: u16, first_row: u16) -> Step {
    Step::LayerNorm(LayerNorm {
        input: TensorId(input),
        output: TensorId(output),
        first_row,
        epsilon: 5,
        gains: n.words(8, -(1 << 23), 1 << 23),
        offsets: n.push(8, -(1 << 40), 1 << 40, |v| v),
        shift: 32,
        zero_point: 1,
        clamp: clamp(I8),
    })
}

fn exp_table() -> Vec<i16> {
    (0..257).map(|k| (2_f64.powf(15.0 - f64::from(k) / 256.0)).round().min(32767.0) as i16).collect()
}

fn attention(n: &mut Numbers) -> Step {
    Step::Attention(Attention {
        query: TensorId(ids::QUERY),
        key: TensorId(ids::KEY),
        value: TensorId(ids::VALUE),
        output: TensorId(ids::CONTEXT),
        heads: 2,
        exponent: requant(),
        exp_table: n.builder.push(&exp_table()).expect("fits"),
        requant: requant(),
        zero_point: 0,
        clamp: clamp(I8),
        scratch: None,
    })
}

fn resize(n: &mut Numbers) -> Step {
    let pairs: [[u16; 2]; 4] = [[0, 0], [0, 4], [0, 12], [1, 4]];
    let table = n.builder.push(&pairs).expect("fits");
    Step::ResizeBilinear(ResizeBilinear {
        input: term(ids::GRID, 1),
        residual: Some(term(ids::POOLED, -3)),
        output: TensorId(ids::FUSED),
        rows: table,
        columns: table,
        weight_bits: 4,
        shift: 38,
        zero_point: 2,
        clamp: clamp(I8),
    })
}

fn tanh_table() -> Vec<i16> {
    (0..513).map(|k| ((f64::from(k) / 64.0).tanh() * 32768.0).round().min(32767.0) as i16).collect()
}

fn decoder(n: &mut Numbers) -> Step {
    Step::WaypointDecoder(WaypointDecoder {
        hidden: TensorId(ids::HIDDEN),
        goal: TensorId(ids::GOAL),
        output: TensorId(ids::WAYPOINTS),
        hidden_fraction_bits: 14,
        concat: false,
        input_weights: n.push(48, -3000, 3000, |v| v as i16),
        hidden_weights: n.push(192, -3000, 3000, |v| v as i16),
        input_pre_shift: 4,
        hidden_pre_shift: 6,
        input_multipliers: n.words(24, 1 << 18, 1 << 20),
        hidden_multipliers: n.words(24, 1 << 18, 1 << 20),
        shifts: n.push(24, 26, 30, |v| v as u8),
        biases: n.push(32, -(1 << 36), 1 << 36, |v| v),
        output_weights: n.push(16, -3000, 3000, |v| v as i16),
        output_bias: n.push(2, -1000, 1000, |v| v),
        output_pre_shift: 0,
        output_requant: [requant(); 2],
        tanh_table: n.builder.push(&tanh_table()).expect("fits"),
        scratch: None,
    })
}

fn concat() -> Step {
    let source = |tensor, zero_point| ConcatSource { tensor: TensorId(tensor), zero_point, requant: requant() };
    Step::Concat(Concat {
        first: source(ids::BOX, -3),
        second: source(ids::BLOCK, -3),
        output: TensorId(ids::JOINED),
        axis: Axis::Height,
        zero_point: 0,
        clamp: clamp(I16),
    })
}

fn softmax(n: &mut Numbers) -> Step {
    Step::Softmax(Softmax {
        input: TensorId(ids::JOINED),
        output: TensorId(ids::PROBABILITIES),
        exponent: Requant { shift: 12, ..requant() },
        exp_table: n.builder.push(&exp_table()).expect("fits"),
    })
}

fn gather_sum() -> Step {
    Step::GatherSum(GatherSum {
        input: TensorId(ids::BLOCK),
        indices: TensorId(ids::CELLS),
        output: TensorId(ids::GATHERED),
        input_zero_point: -3,
        requant: Requant { shift: 16, ..requant() },
        zero_point: 0,
        clamp: clamp(I16),
    })
}

fn branch_linear(n: &mut Numbers) -> Step {
    Step::BranchLinear(BranchLinear {
        input: TensorId(ids::VECTOR),
        command: TensorId(ids::COMMAND),
        output: TensorId(ids::BRANCH),
        branches: 4,
        kernel: KernelId::Direct,
        weights: n.weights(4 * 3 * 8),
        wide: false,
        rescale: n.rescale(4 * 3, I16, Residual::None),
        scratch: None,
    })
}

fn sigmoid(n: &mut Numbers) -> Step {
    Step::Sigmoid(Sigmoid {
        input: TensorId(ids::BRANCH),
        output: TensorId(ids::CONTROLS),
        input_zero_point: 0,
        requant: requant(),
        tanh_table: n.builder.push(&tanh_table()).expect("fits"),
    })
}

fn spatial_softmax(n: &mut Numbers) -> Step {
    Step::SpatialSoftmax(SpatialSoftmax {
        input: TensorId(ids::PROBABILITIES),
        output: TensorId(ids::POINTS),
        exponent: Requant { shift: 18, ..requant() },
        exp_table: n.builder.push(&exp_table()).expect("fits"),
    })
}

/// Pairs of output and overwritten operand.
fn in_place(shapes: &[(Shape, ElementType)]) -> Vec<(u16, u16)> {
    let mut pairs = vec![
        (ids::CONTEXT, ids::QUERY),
        (ids::STREAM_2, ids::STREAM),
        (ids::FUSED, ids::POOLED),
        (ids::SUM, ids::LIDAR_NARROW),
        (ids::BLOCK, ids::FUSED),
        (ids::PROBABILITIES, ids::JOINED),
        (ids::CONTROLS, ids::BRANCH),
    ];
    let [input, output] = [ids::STEM, ids::POOLED].map(|id| shapes[usize::from(id)].0);
    if plan::max_pool_in_place(input, output, Window::square(2, 2, 0)) {
        pairs.push((ids::POOLED, ids::STEM));
    }
    pairs
}

/// First fit in the order of writing, scratch included. Attention always has scratch, so that there is some.
fn place(shapes: &[(Shape, ElementType)], steps: &mut [Step]) -> Vec<TensorRecord> {
    let pairs = in_place(shapes);
    let last = (steps.len() - 1) as u16;
    let mut records: Vec<TensorRecord> = shapes
        .iter()
        .enumerate()
        .map(|(id, (shape, element))| {
            let id = TensorId(id as u16);
            let first = steps.iter().position(|s| s.output() == id).unwrap_or(0) as u16;
            let read = steps.iter().rposition(|s| s.reads().contains(&Some(id)));
            TensorRecord {
                element: *element,
                shape: *shape,
                region: 0,
                offset: 0,
                bytes: shape.elements() as u32 * element.bytes(),
                first_step: first,
                last_step: read.map_or(last, |read| read as u16),
                in_place_of: pairs.iter().find(|pair| pair.0 == id.0).map(|pair| TensorId(pair.1)),
            }
        })
        .collect();
    for (position, step) in steps.iter_mut().enumerate() {
        let needed = scratch_bytes(step, &records);
        if needed > 0 {
            set_scratch(step, TensorId(records.len() as u16));
            records.push(TensorRecord::scratch(0, needed, position as u16));
        }
    }
    let mut order: Vec<usize> = (0..records.len()).collect();
    order.sort_by_key(|id| records[*id].first_step);
    for (placed, id) in order.iter().enumerate() {
        if let Some(operand) = records[*id].in_place_of {
            records[*id].offset = records[usize::from(operand.0)].offset;
            continue;
        }
        let blocked = |record: &TensorRecord| {
            order[..placed].iter().any(|other| {
                let other = &records[*other];
                other.last_step >= record.first_step && other.overlaps(record)
            })
        };
        let mut record = records[*id];
        while blocked(&record) {
            record.offset += 16;
        }
        records[*id].offset = record.offset;
    }
    records
}

fn scratch_bytes(step: &Step, records: &[TensorRecord]) -> u32 {
    let record = |id: TensorId| records[usize::from(id.0)];
    match step {
        Step::Conv2d(s) => {
            let (input, output) = (record(s.input).shape, record(s.output).shape);
            plan::conv2d_scratch_bytes(s.kernel, input, output, s.window, s.groups)
        }
        Step::Linear(s) => {
            let input = record(s.input);
            plan::linear_scratch_bytes(s.kernel, input.shape.positions(), input.shape.channels, input.element)
        }
        Step::BranchLinear(s) => {
            let input = record(s.input);
            plan::linear_scratch_bytes(s.kernel, input.shape.positions(), input.shape.channels, input.element)
        }
        Step::Attention(s) => {
            let shape = record(s.output).shape;
            plan::attention_scratch_bytes(shape.positions(), shape.channels, s.heads).max(16)
        }
        Step::WaypointDecoder(s) => plan::waypoint_decoder_scratch_bytes(record(s.hidden).shape.channels),
        _ => 0,
    }
}

fn set_scratch(step: &mut Step, id: TensorId) {
    match step {
        Step::Conv2d(s) => s.scratch = Some(id),
        Step::Linear(s) => s.scratch = Some(id),
        Step::BranchLinear(s) => s.scratch = Some(id),
        Step::Attention(s) => s.scratch = Some(id),
        Step::WaypointDecoder(s) => s.scratch = Some(id),
        _ => unreachable!("no scratch"),
    }
}
