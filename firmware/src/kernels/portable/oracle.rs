//! What the tests of all kernels share: seeded random operands, and the rounding rule and epilogues in i128, written
//! from the formulas and not from the code.

extern crate std;

use crate::fixed_point::EXP_TABLE_LEN;
use crate::kernels::{PoolArgs, RescaleArgs, ResidualArgs, k4n16};
use crate::program::{Clamp, KernelId, Requant, Window};
use crate::tensor::{Codes, CodesMut, ElementType, Shape};
use std::vec::Vec;

/// Any code.
pub(in crate::kernels) const FULL: Clamp = Clamp { min: i16::MIN, max: i16::MAX };

/// Runs `test` for `cases` seeds; the seed of a failing case is printed.
pub(in crate::kernels) fn for_seeds(cases: u64, test: impl Fn(&mut Rng)) {
    struct Seed(u64);
    impl Drop for Seed {
        fn drop(&mut self) {
            if std::thread::panicking() {
                std::eprintln!("failed with seed {}", self.0);
            }
        }
    }
    for seed in 0..cases {
        let seed = Seed(seed);
        test(&mut Rng(seed.0));
    }
}

/// SplitMix64.
pub(in crate::kernels) struct Rng(pub u64);

impl Rng {
    pub(in crate::kernels) fn next(&mut self) -> u64 {
        self.0 = self.0.wrapping_add(0x9e37_79b9_7f4a_7c15);
        let mut z = self.0;
        z = (z ^ (z >> 30)).wrapping_mul(0xbf58_476d_1ce4_e5b9);
        z = (z ^ (z >> 27)).wrapping_mul(0x94d0_49bb_1331_11eb);
        z ^ (z >> 31)
    }

    /// A value of `low..=high`.
    pub(in crate::kernels) fn range(&mut self, low: i64, high: i64) -> i64 {
        low + (self.next() % (high - low + 1) as u64) as i64
    }

    pub(in crate::kernels) fn flag(&mut self) -> bool {
        self.next() & 1 == 1
    }

    /// Random values of `low..=high`, one in eight an extreme.
    pub(in crate::kernels) fn values<T: TryFrom<i64>>(&mut self, count: usize, low: i64, high: i64) -> Vec<T> {
        let value = |rng: &mut Self| match rng.next() % 16 {
            0 => low,
            1 => high,
            _ => rng.range(low, high),
        };
        (0..count).map(|_| T::try_from(value(self)).ok().unwrap()).collect()
    }

    pub(in crate::kernels) fn element_type(&mut self) -> ElementType {
        if self.flag() { ElementType::I8 } else { ElementType::I16 }
    }

    pub(in crate::kernels) fn buffer(&mut self, element_type: ElementType, count: usize) -> Buffer {
        match element_type {
            ElementType::I8 => Buffer::I8(self.values(count, -128, 127)),
            _ => Buffer::I16(self.values(count, -32768, 32767)),
        }
    }

    /// A zero point of this type.
    pub(in crate::kernels) fn zero_point(&mut self, element_type: ElementType) -> i16 {
        if element_type == ElementType::I8 { self.range(-128, 127) as i16 } else { 0 }
    }

    /// A clamp within this type, often the whole of it.
    pub(in crate::kernels) fn clamp(&mut self, element_type: ElementType) -> Clamp {
        let (min, max) = if element_type == ElementType::I8 { (-128, 127) } else { (i16::MIN, i16::MAX) };
        if self.flag() {
            return Clamp { min, max };
        }
        let low = self.range(min.into(), max.into());
        Clamp { min: low as i16, max: self.range(low, max.into()) as i16 }
    }

    /// A multiplier that stands alone.
    pub(in crate::kernels) fn multiplier(&mut self) -> i32 {
        self.range(1 << 23, (1 << 24) - 1) as i32
    }

    /// A factor of about `2^(span − bits)`, which maps sums of `bits` digits to codes of about `span` digits.
    pub(in crate::kernels) fn requant(&mut self, bits: i64, span: i64) -> Requant {
        let jitter = self.range(-1, 3);
        Requant { multiplier: self.multiplier(), shift: (23 + bits - span + jitter).clamp(1, 52) as u8 }
    }
}

/// Codes of either type.
#[derive(Clone, Debug, PartialEq)]
pub(in crate::kernels) enum Buffer {
    I8(Vec<i8>),
    I16(Vec<i16>),
}

impl Buffer {
    pub(in crate::kernels) fn codes(&self) -> Codes<'_> {
        match self {
            Self::I8(codes) => Codes::I8(codes),
            Self::I16(codes) => Codes::I16(codes),
        }
    }

    pub(in crate::kernels) fn codes_mut(&mut self) -> CodesMut<'_> {
        match self {
            Self::I8(codes) => CodesMut::I8(codes),
            Self::I16(codes) => CodesMut::I16(codes),
        }
    }

    pub(in crate::kernels) fn get(&self, index: usize) -> i128 {
        match self {
            Self::I8(codes) => codes[index].into(),
            Self::I16(codes) => codes[index].into(),
        }
    }

    pub(in crate::kernels) fn len(&self) -> usize {
        match self {
            Self::I8(codes) => codes.len(),
            Self::I16(codes) => codes.len(),
        }
    }

    /// Compares with expected codes, element by element.
    pub(in crate::kernels) fn assert_equals(&self, expected: &[i128], what: &str) {
        assert_eq!(self.len(), expected.len(), "{what}: length");
        for (index, expected) in expected.iter().enumerate() {
            assert_eq!(self.get(index), *expected, "{what}: element {index}");
        }
    }
}

/// Scratch of exactly `bytes` bytes, 16-byte aligned, full of garbage.
pub(in crate::kernels) struct Scratch {
    words: Vec<u128>,
    bytes: usize,
}

impl Scratch {
    pub(in crate::kernels) fn new(bytes: u32) -> Self {
        let bytes = bytes as usize;
        Self { words: std::vec![0x5a5a_a5a5_1234_fedc_8001_7fff_dead_beef; bytes.div_ceil(16)], bytes }
    }

    pub(in crate::kernels) fn bytes(&mut self) -> &mut [u8] {
        &mut bytemuck::cast_slice_mut(&mut self.words)[..self.bytes]
    }
}

/// Weights `[groups·outputs][depth]` in a kernel's order.
pub(super) fn pack(kernel: KernelId, weights: &[i8], groups: u16, outputs: u16, depth: usize) -> Vec<i8> {
    if kernel == KernelId::Direct {
        return weights.to_vec();
    }
    let mut packed = std::vec![0; k4n16::packed_bytes(groups, outputs, depth as u64) as usize];
    k4n16::pack(weights, outputs, depth, &mut packed);
    packed
}

/// `R(v, n)`.
pub(in crate::kernels) fn round(value: i128, shift: u32) -> i128 {
    if shift == 0 { value } else { (value + (1 << (shift - 1))).div_euclid(1 << shift) }
}

/// `min(max(v, min), max)`.
pub(in crate::kernels) fn clamp(value: i128, clamp: Clamp) -> i128 {
    value.max(clamp.min.into()).min(clamp.max.into())
}

/// The epilogue of a weighted step; `residual` is the code that a residual operand holds there.
pub(in crate::kernels) fn rescale(args: &RescaleArgs<'_>, channel: usize, acc: i128, residual: i128) -> i128 {
    let t = round(acc, args.pre_shift) * i128::from(args.multipliers[channel]);
    let n = u32::from(args.shifts[channel]);
    let value = match args.residual {
        ResidualArgs::None => i128::from(args.zero_point) + round(t, n),
        ResidualArgs::Scaled { zero_point, multipliers, .. } => {
            let second = (residual - i128::from(zero_point)) * i128::from(multipliers[channel]);
            i128::from(args.zero_point) + round(t + second, n)
        }
        ResidualArgs::Stream { .. } => residual + round(t, n),
    };
    clamp(value, args.clamp)
}

/// Random constants of a [`RescaleArgs`] for sums of about `bits` digits.
pub(in crate::kernels) struct RescaleConstants {
    pub bias: Vec<i32>,
    pub multipliers: Vec<i32>,
    pub shifts: Vec<u8>,
    pub residual_multipliers: Vec<i32>,
    pub output: ElementType,
    pub residual: ResidualKind,
    pub residual_buffer: Buffer,
    pub residual_zero_point: i16,
    pub zero_point: i16,
    pub clamp: Clamp,
    pub pre_shift: u32,
}

/// Second term of a random epilogue.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(in crate::kernels) enum ResidualKind {
    None,
    Scaled { in_place: bool },
    Stream { in_place: bool },
}

impl RescaleConstants {
    pub(in crate::kernels) fn random(rng: &mut Rng, channels: usize, elements: usize, bits: i64) -> Self {
        let output = rng.element_type();
        let in_place = rng.flag();
        let residual = match rng.next() % 3 {
            0 => ResidualKind::None,
            1 => ResidualKind::Scaled { in_place },
            _ => ResidualKind::Stream { in_place },
        };
        let residual_type = if in_place { output } else { rng.element_type() };
        let span = if output == ElementType::I8 { 7 } else { 15 };
        let pre_shift = (rng.next() % 4) as u32;
        let factors: Vec<Requant> = (0..channels).map(|_| rng.requant(bits - i64::from(pre_shift), span)).collect();
        Self {
            bias: rng.values(channels, -(1 << bits.min(20)), 1 << bits.min(20)),
            multipliers: factors.iter().map(|f| f.multiplier).collect(),
            shifts: factors.iter().map(|f| f.shift).collect(),
            residual_multipliers: rng.values(channels, 1, 1 << 24),
            output,
            residual,
            residual_buffer: rng.buffer(residual_type, elements),
            residual_zero_point: rng.zero_point(residual_type),
            zero_point: rng.zero_point(output),
            clamp: rng.clamp(output),
            pre_shift,
        }
    }

    /// The output buffer before the step: the residual where it is in place, else garbage.
    pub(in crate::kernels) fn initial_output(&self, rng: &mut Rng) -> Buffer {
        match self.residual {
            ResidualKind::Scaled { in_place: true } | ResidualKind::Stream { in_place: true } => {
                self.residual_buffer.clone()
            }
            _ => rng.buffer(self.output, self.residual_buffer.len()),
        }
    }

    pub(in crate::kernels) fn args(&self) -> RescaleArgs<'_> {
        let stored = |in_place: bool| (!in_place).then(|| self.residual_buffer.codes());
        RescaleArgs {
            pre_shift: self.pre_shift,
            bias: &self.bias,
            multipliers: &self.multipliers,
            shifts: &self.shifts,
            zero_point: self.zero_point,
            clamp: self.clamp,
            residual: match self.residual {
                ResidualKind::None => ResidualArgs::None,
                ResidualKind::Scaled { in_place } => ResidualArgs::Scaled {
                    codes: stored(in_place),
                    zero_point: self.residual_zero_point,
                    multipliers: &self.residual_multipliers,
                },
                ResidualKind::Stream { in_place } => ResidualArgs::Stream { codes: stored(in_place) },
            },
        }
    }
}

/// An epilogue that no compiler writes.
pub(in crate::kernels) const HOSTILE: RescaleArgs<'static> = RescaleArgs {
    pre_shift: 255,
    bias: &[i32::MIN, i32::MAX],
    multipliers: &[i32::MIN, i32::MAX],
    shifts: &[255, 0],
    zero_point: i16::MIN,
    clamp: Clamp { min: i16::MAX, max: i16::MIN },
    residual: ResidualArgs::Scaled { codes: None, zero_point: i16::MIN, multipliers: &[i32::MIN, i32::MIN] },
};

/// The table of [`crate::fixed_point::exp2_q15`].
pub(in crate::kernels) fn exp_table() -> [i16; EXP_TABLE_LEN] {
    core::array::from_fn(|k| f64::min(32767.0, (32768.0 * f64::exp2(-(k as f64) / 256.0)).round()) as i16)
}

/// `[i0, w1]` of half-pixel centers, as the compiler writes them.
pub(in crate::kernels) fn half_pixel_lines(size: u16, output: u16, weight_bits: u32) -> Vec<[u16; 2]> {
    let entry = |d: u16| {
        let source = ((f64::from(d) + 0.5) * f64::from(size) / f64::from(output) - 0.5).max(0.0);
        let first = source.floor().min(f64::from(size) - 1.0);
        let weight = ((source - first) * f64::from(1 << weight_bits) + 0.5).floor();
        [first as u16, weight as u16]
    };
    (0..output).map(entry).collect()
}

/// A random pool over a small map of up to `channels` channels; `None` where the window does not fit.
pub(in crate::kernels) fn pool_args(rng: &mut Rng, padded: bool, channels: i64) -> Option<PoolArgs> {
    let input_shape = Shape::map(rng.range(1, 9) as u16, rng.range(1, 9) as u16, rng.range(1, channels) as u16);
    let mut byte = |low, high| rng.range(low, high) as u8;
    let (kernel_h, kernel_w, stride_h, stride_w) = (byte(1, 4), byte(1, 4), byte(1, 3), byte(1, 3));
    let mut pad = |kernel: u8| if padded { byte(0, i64::from(kernel) - 1) } else { 0 };
    let window = Window {
        kernel_h,
        kernel_w,
        stride_h,
        stride_w,
        pad_top: pad(kernel_h),
        pad_bottom: pad(kernel_h),
        pad_left: pad(kernel_w),
        pad_right: pad(kernel_w),
        dilation_h: 1,
        dilation_w: 1,
    };
    let (height, width) = window.output_size(input_shape.height, input_shape.width)?;
    Some(PoolArgs { input_shape, output_shape: Shape::map(height, width, input_shape.channels), window })
}
