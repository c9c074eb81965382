//! Time of each heavy operator on every backend of this machine, at shapes of the full-size TransFuser.
//!
//! `cargo bench -p firmware --bench operators` measures all, with `-- conv2d` some of them, and with `-- --test` runs
//! each once. Throughput counts multiply-accumulates for convolutions, linear layers and attention, elements of the
//! input for pools and tokens, elements of the output for the others.
//! Before it is measured, a backend must give the bytes of the portable kernels.

use criterion::{BenchmarkId, Criterion, Throughput};
use firmware::fixed_point::EXP_TABLE_LEN;
use firmware::image::known_answer::Generator;
use firmware::kernels::{
    AttentionArgs, Conv2dArgs, Kernels, LayerNormArgs, LinearArgs, PoolArgs, Portable, RequantArgs, RescaleArgs,
    ResidualArgs, ResizeArgs, SumArgs, TermArgs, TokenSourceArgs, TokensArgs, k4n16, plan,
};
use firmware::program::{Clamp, KernelId, Requant, Window};
use firmware::tensor::{Codes, CodesMut, ElementType, Shape, index};
use std::hint::black_box;
use std::time::Duration;

const CLAMP: Clamp = Clamp { min: -128, max: 127 };
/// Factor 2^-12: sums of some hundred products of codes fill the output's range.
const REQUANT: Requant = Requant { multiplier: 1 << 23, shift: 35 };
const SUM: SumArgs = SumArgs { shift: 24, zero_point: 0, clamp: CLAMP };
/// One half: two terms stay within the output's range.
const MULTIPLIER: i32 = 1 << 23;
const HEADS: u16 = 4;

fn main() {
    let mut criterion = Criterion::default()
        .sample_size(20)
        .warm_up_time(Duration::from_millis(300))
        .measurement_time(Duration::from_secs(2))
        .configure_from_args();
    conv2d(&mut criterion, "3×3 64→64 at 64×64", Shape::map(64, 64, 64), Window::square(3, 1, 1), 64);
    conv2d(&mut criterion, "3×3 512→512 at 8×8", Shape::map(8, 8, 512), Window::square(3, 1, 1), 512);
    conv2d(&mut criterion, "7×7 stride 2 3→64 at 256×256", Shape::map(256, 256, 3), Window::square(7, 2, 3), 64);
    conv2d(&mut criterion, "1×1 stride 2 64→128 at 64×64", Shape::map(64, 64, 64), Window::square(1, 2, 0), 128);
    linear(&mut criterion, 128, 512, 2048);
    linear(&mut criterion, 128, 64, 64);
    attention(&mut criterion, 128, 512);
    attention(&mut criterion, 128, 64);
    layer_norm(&mut criterion, 128, 512);
    layer_norm(&mut criterion, 128, 64);
    max_pool(&mut criterion);
    resize_bilinear(&mut criterion);
    tokens(&mut criterion);
    add(&mut criterion);
    criterion.final_summary();
}

/// A backend by its name in `host-sim`.
struct Backend {
    name: &'static str,
    kernels: Box<dyn Kernels>,
}

/// The backends of this machine.
fn backends() -> Vec<Backend> {
    let portable: Option<Box<dyn Kernels>> = Some(Box::new(Portable));
    #[cfg(target_arch = "x86_64")]
    let vectors: [(&str, Option<Box<dyn Kernels>>); 2] = {
        use firmware::kernels::x86_64::{Avx2, Avx512Vnni};
        [
            ("avx2", Avx2::detect().map(|token| Box::new(token) as _)),
            ("avx512-vnni", Avx512Vnni::detect().map(|token| Box::new(token) as _)),
        ]
    };
    #[cfg(not(target_arch = "x86_64"))]
    let vectors = [];
    let all = [("portable", portable)].into_iter().chain(vectors);
    all.filter_map(|(name, kernels)| Some(Backend { name, kernels: kernels? })).collect()
}

/// Weights as a backend reads them.
struct Packed {
    kernel: KernelId,
    weights: Vec<i8>,
}

/// Packs canonical weights, `depth` per output, with the kernel that the compiler chooses for a backend.
fn pack(backend: &Backend, weights: &[i8], outputs: u16, depth: usize) -> Packed {
    if backend.name == "portable" {
        return Packed { kernel: KernelId::Direct, weights: weights.to_vec() };
    }
    let mut packed = vec![0; index_of(k4n16::packed_bytes(1, outputs, depth as u64))];
    k4n16::pack(weights, outputs, depth, &mut packed);
    Packed { kernel: KernelId::K4N16, weights: packed }
}

fn index_of(bytes: u64) -> usize {
    usize::try_from(bytes).expect("it fits this machine")
}

/// What is measured: the operator, its shape in words, its work and the elements that it writes.
struct Case<'a> {
    operator: &'a str,
    shape: &'a str,
    work: u64,
    outputs: usize,
}

impl Case<'_> {
    /// Measures `run` on every backend with what `prepare` makes for it.
    fn measure<P>(
        &self,
        criterion: &mut Criterion,
        prepare: impl Fn(&Backend) -> P,
        run: impl Fn(&dyn Kernels, &mut P, &mut [i8]),
    ) {
        let mut group = criterion.benchmark_group(self.operator);
        group.throughput(Throughput::Elements(self.work));
        let mut expected: Option<Vec<i8>> = None;
        for backend in backends() {
            let mut prepared = prepare(&backend);
            let mut output = vec![0; self.outputs];
            run(&*backend.kernels, &mut prepared, &mut output);
            let expected = expected.get_or_insert_with(|| output.clone());
            assert!(output == *expected, "{} {}: {} gives other bytes", self.operator, self.shape, backend.name);
            assert!(output.iter().any(|code| *code != output[0]), "{} {} does nothing", self.operator, self.shape);
            group.bench_function(BenchmarkId::new(self.shape, backend.name), |bencher| {
                bencher.iter(|| run(&*backend.kernels, &mut prepared, black_box(&mut output)));
            });
        }
        group.finish();
    }
}

fn conv2d(criterion: &mut Criterion, words: &str, input_shape: Shape, window: Window, outputs: u16) {
    let (height, width) = window.output_size(input_shape.height, input_shape.width).expect("the window fits");
    let output_shape = Shape::map(height, width, outputs);
    let depth = usize::from(window.kernel_h) * usize::from(window.kernel_w) * usize::from(input_shape.channels);
    let input = codes(1, input_shape);
    let weights = random(2, usize::from(outputs) * depth);
    let epilogue = Epilogue::new(outputs);
    let padding_codes = vec![0; input_shape.channels.into()];
    let work = output_shape.elements() * depth as u64;
    let case = Case { operator: "conv2d", shape: words, work, outputs: elements(output_shape) };
    let prepare = |backend: &Backend| {
        let packed = pack(backend, &weights, outputs, depth);
        let bytes = plan::conv2d_scratch_bytes(packed.kernel, input_shape, output_shape, window, 1);
        (packed, scratch(bytes))
    };
    case.measure(criterion, prepare, |kernels, (packed, scratch), output| {
        let args = Conv2dArgs {
            input_shape,
            output_shape,
            window,
            groups: 1,
            kernel: packed.kernel,
            weights: &packed.weights,
            padding_codes: &padding_codes,
            rescale: epilogue.args(),
        };
        kernels.conv2d(&args, &input, CodesMut::I8(output), bytemuck::cast_slice_mut(scratch));
    });
}

fn linear(criterion: &mut Criterion, rows: u16, inputs: u16, outputs: u16) {
    let input = codes(3, Shape::tokens(rows, inputs));
    let weights = random(4, usize::from(outputs) * usize::from(inputs));
    let epilogue = Epilogue::new(outputs);
    let output_shape = Shape::tokens(rows, outputs);
    let work = output_shape.elements() * u64::from(inputs);
    let words = format!("{rows}×{inputs}→{outputs}");
    let case = Case { operator: "linear", shape: &words, work, outputs: elements(output_shape) };
    let prepare = |backend: &Backend| {
        let packed = pack(backend, &weights, outputs, inputs.into());
        let bytes = plan::linear_scratch_bytes(packed.kernel, rows.into(), inputs, ElementType::I8);
        (packed, scratch(bytes))
    };
    case.measure(criterion, prepare, |kernels, (packed, scratch), output| {
        let args = LinearArgs {
            positions: rows.into(),
            inputs,
            outputs,
            kernel: packed.kernel,
            weights: &packed.weights,
            wide: false,
            rescale: epilogue.args(),
        };
        kernels.linear(&args, Codes::I8(&input), CodesMut::I8(output), bytemuck::cast_slice_mut(scratch));
    });
}

fn attention(criterion: &mut Criterion, tokens: u16, channels: u16) {
    let shape = Shape::tokens(tokens, channels);
    let [query, key, value] = [5, 6, 7].map(|seed| codes(seed, shape));
    let power = |k: usize| (32767.0 * (-(k as f64) / 256.0).exp2()).round() as i16;
    let exp_table: Vec<i16> = (0..EXP_TABLE_LEN).map(power).collect();
    let requant = Requant { multiplier: 1 << 23, shift: 34 };
    let args = AttentionArgs {
        tokens: tokens.into(),
        channels,
        heads: HEADS,
        exponent: Requant { multiplier: 1 << 23, shift: 20 },
        exp_table: &exp_table,
        requant: RequantArgs { input_zero_point: 0, requant, zero_point: 0, clamp: CLAMP },
    };
    let work = 2 * shape.elements() * u64::from(tokens);
    let words = format!("{tokens} tokens, {channels} channels");
    let case = Case { operator: "attention", shape: &words, work, outputs: elements(shape) };
    let prepare = |_: &Backend| scratch(plan::attention_scratch_bytes(tokens.into(), channels, HEADS));
    case.measure(criterion, prepare, |kernels, scratch, output| {
        let scratch = bytemuck::cast_slice_mut(scratch);
        kernels.attention(&args, Some(&query), &key, &value, CodesMut::I8(output), scratch);
    });
}

fn layer_norm(criterion: &mut Criterion, rows: u16, channels: u16) {
    let shape = Shape::tokens(rows, channels);
    let input: Vec<i16> = codes(8, shape).into_iter().map(|code| 200 * i16::from(code)).collect();
    let (gains, offsets) = (vec![MULTIPLIER; channels.into()], vec![0; channels.into()]);
    // Q14 times the gain 2^23 gives some 30 codes per standard deviation.
    let sum = SumArgs { shift: 32, ..SUM };
    let args = LayerNormArgs { rows: rows.into(), channels, epsilon: 1, gains: &gains, offsets: &offsets, sum };
    let words = format!("{rows}×{channels}");
    let case = Case { operator: "layer_norm", shape: &words, work: shape.elements(), outputs: elements(shape) };
    case.measure(
        criterion,
        |_| (),
        |kernels, (), output| {
            kernels.layer_norm(&args, Codes::I16(&input), CodesMut::I8(output));
        },
    );
}

fn max_pool(criterion: &mut Criterion) {
    let (input_shape, output_shape) = (Shape::map(128, 128, 64), Shape::map(64, 64, 64));
    let input = codes(9, input_shape);
    let args = PoolArgs { input_shape, output_shape, window: Window::square(3, 2, 1) };
    let (work, outputs) = (input_shape.elements(), elements(output_shape));
    let case = Case { operator: "max_pool", shape: "3×3 stride 2 at 128×128×64", work, outputs };
    case.measure(
        criterion,
        |_| (),
        |kernels, (), output| {
            kernels.max_pool(&args, Some(Codes::I8(&input)), CodesMut::I8(output));
        },
    );
}

fn resize_bilinear(criterion: &mut Criterion) {
    let (input_shape, output_shape) = (Shape::map(8, 8, 64), Shape::map(64, 64, 64));
    let (input, residual) = (codes(10, input_shape), codes(11, output_shape));
    // Centers of pixels in sixteenths: (y + 1/2) / 8 − 1/2, at least 0.
    let lines: Vec<[u16; 2]> = (0..64_u16).map(|y| (2 * y).saturating_sub(7)).map(|at| [at / 16, at % 16]).collect();
    let args = ResizeArgs {
        input_shape,
        output_shape,
        // Interpolated values have 8 bits more.
        input: TermArgs { codes: Some(Codes::I8(&input)), zero_point: 0, multiplier: MULTIPLIER >> 8 },
        residual: Some(term(&residual)),
        rows: &lines,
        columns: &lines,
        weight_bits: 4,
        sum: SUM,
    };
    let (work, outputs) = (output_shape.elements(), elements(output_shape));
    let case = Case { operator: "resize_bilinear", shape: "8×8×64 to 64×64×64, added", work, outputs };
    case.measure(criterion, |_| (), |kernels, (), output| kernels.resize_bilinear(&args, CodesMut::I8(output)));
}

fn tokens(criterion: &mut Criterion) {
    let shape = Shape::map(64, 64, 64);
    let (image, bev) = (codes(12, shape), codes(13, shape));
    // The mean of 8×8 codes.
    let source = |map| TokenSourceArgs {
        codes: Codes::I8(map),
        shape,
        zero_point: 0,
        pool: [8, 8],
        multiplier: MULTIPLIER >> 5,
    };
    let output_shape = Shape::tokens(128, 64);
    let position: Vec<i16> = codes(14, output_shape).into_iter().map(i16::from).collect();
    let velocity_multipliers = vec![1 << 12; 64];
    let args = TokensArgs {
        sources: [source(&image), source(&bev)],
        velocity: 5 << 8,
        velocity_multipliers: &velocity_multipliers,
        position: &position,
        sum: SUM,
    };
    let (work, outputs) = (2 * shape.elements(), elements(output_shape));
    let case = Case { operator: "tokens", shape: "two maps of 64×64×64 to 128×64", work, outputs };
    case.measure(criterion, |_| (), |kernels, (), output| kernels.tokens(&args, CodesMut::I8(output)));
}

fn add(criterion: &mut Criterion) {
    let shape = Shape::map(64, 64, 64);
    let (first, second) = (codes(15, shape), codes(16, shape));
    let terms = [term(&first), term(&second)];
    let case = Case { operator: "add", shape: "64×64×64", work: shape.elements(), outputs: elements(shape) };
    case.measure(criterion, |_| (), |kernels, (), output| kernels.add(&SUM, &terms, CodesMut::I8(output)));
}

/// The arrays of an epilogue without a second term.
struct Epilogue {
    bias: Vec<i32>,
    multipliers: Vec<i32>,
    shifts: Vec<u8>,
}

impl Epilogue {
    fn new(outputs: u16) -> Self {
        let filled = |value| vec![value; outputs.into()];
        Self {
            bias: filled(1000),
            multipliers: filled(REQUANT.multiplier),
            shifts: vec![REQUANT.shift; outputs.into()],
        }
    }

    fn args(&self) -> RescaleArgs<'_> {
        RescaleArgs {
            pre_shift: 0,
            bias: &self.bias,
            multipliers: &self.multipliers,
            shifts: &self.shifts,
            zero_point: 0,
            clamp: CLAMP,
            residual: ResidualArgs::None,
        }
    }
}

fn term(codes: &[i8]) -> TermArgs<'_> {
    TermArgs { codes: Some(Codes::I8(codes)), zero_point: 0, multiplier: MULTIPLIER }
}

fn codes(seed: u64, shape: Shape) -> Vec<i8> {
    random(seed, elements(shape))
}

/// Codes in −127..=127, which suit weights, queries, keys and values too.
fn random(seed: u64, count: usize) -> Vec<i8> {
    let mut bytes = vec![0_u8; count];
    Generator::new(seed).fill(ElementType::I8, &mut bytes);
    bytes.into_iter().map(|byte| byte.cast_signed().max(-127)).collect()
}

/// Scratch memory, aligned to more than the 4 bytes that kernels expect.
fn scratch(bytes: u32) -> Vec<u128> {
    vec![0; index(bytes).div_ceil(size_of::<u128>())]
}

fn elements(shape: Shape) -> usize {
    shape.elements() as usize
}
