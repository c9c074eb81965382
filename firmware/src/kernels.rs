//! The kernel interface: one method per operator, each taking a checked view of its step, disjoint operands and its
//! scratch. Every default is [`portable`], the norm that any other backend must equal byte for byte.
//!
//! A backend is a zero-sized token, proof that its instructions exist. It lists the [`KernelId`]s that it can read and
//! overrides the methods that it accelerates; the choice between several at run time is a `&dyn Kernels`. Methods are
//! infallible: `Image::parse` has proved shapes, lengths and alignment, and all arithmetic is total (hostile constants
//! give wrong numbers, never a panic).

use crate::program::{Axis, Clamp, KernelId, Requant, Window};
use crate::tensor::{Codes, CodesMut, Shape};

pub mod k4n16;
pub mod plan;
pub mod portable;
#[cfg(target_arch = "x86_64")]
pub mod x86_64;

/// Arrays per output channel of a [`crate::program::Rescale`]; all of the output channel count.
#[derive(Clone, Copy, Debug)]
pub struct RescaleArgs<'a> {
    /// `p`.
    pub pre_shift: u32,
    /// `b'`.
    pub bias: &'a [i32],
    /// `M`.
    pub multipliers: &'a [i32],
    /// `n`.
    pub shifts: &'a [u8],
    /// `z_o`.
    pub zero_point: i16,
    /// Bounds of the output code.
    pub clamp: Clamp,
    /// Second term.
    pub residual: ResidualArgs<'a>,
}

/// Second term of the epilogue; `None` codes mean that the operand lies in the output buffer (in place).
#[derive(Clone, Copy, Debug)]
pub enum ResidualArgs<'a> {
    /// No second term.
    None,
    /// `(r − z_r)·M_r` inside the rounding.
    Scaled {
        /// `r`, or in place.
        codes: Option<Codes<'a>>,
        /// `z_r`.
        zero_point: i16,
        /// `M_r` per output channel.
        multipliers: &'a [i32],
    },
    /// `r` added after the rounding.
    Stream {
        /// `r`, or in place.
        codes: Option<Codes<'a>>,
    },
}

/// Arguments of [`Kernels::conv2d`].
#[derive(Clone, Copy, Debug)]
pub struct Conv2dArgs<'a> {
    /// Input shape.
    pub input_shape: Shape,
    /// Output shape.
    pub output_shape: Shape,
    /// Kernel, stride, padding, dilation.
    pub window: Window,
    /// Channel groups.
    pub groups: u16,
    /// Packing of `weights`.
    pub kernel: KernelId,
    /// Packed weights.
    pub weights: &'a [i8],
    /// Padding code per input channel.
    pub padding_codes: &'a [i8],
    /// Epilogue.
    pub rescale: RescaleArgs<'a>,
}

/// Arguments of [`Kernels::linear`].
#[derive(Clone, Copy, Debug)]
pub struct LinearArgs<'a> {
    /// Rows of the product.
    pub positions: u32,
    /// Input channels (depth).
    pub inputs: u16,
    /// Output channels.
    pub outputs: u16,
    /// Packing of `weights`.
    pub kernel: KernelId,
    /// Packed weights.
    pub weights: &'a [i8],
    /// 64-bit accumulators.
    pub wide: bool,
    /// Epilogue.
    pub rescale: RescaleArgs<'a>,
}

/// Arguments of [`Kernels::max_pool`] and [`Kernels::average_pool`].
#[derive(Clone, Copy, Debug)]
pub struct PoolArgs {
    /// Input shape.
    pub input_shape: Shape,
    /// Output shape.
    pub output_shape: Shape,
    /// Kernel, stride, padding.
    pub window: Window,
}

/// One-factor epilogue: `y = clamp(z_o + R((Σ…)·M, n))` with the operand's zero point.
#[derive(Clone, Copy, Debug)]
pub struct RequantArgs {
    /// Zero point of the operand.
    pub input_zero_point: i16,
    /// M, n.
    pub requant: Requant,
    /// `z_o`.
    pub zero_point: i16,
    /// Bounds of the output code.
    pub clamp: Clamp,
}

/// One stored operand of a sum. `None` codes: it lies in the output buffer (in place).
#[derive(Clone, Copy, Debug)]
pub struct TermArgs<'a> {
    /// The codes, or in place.
    pub codes: Option<Codes<'a>>,
    /// Zero point.
    pub zero_point: i16,
    /// `M_k`.
    pub multiplier: i32,
}

/// Common end of a sum of terms: `clamp(z_o + R(Σ, n))`.
#[derive(Clone, Copy, Debug)]
pub struct SumArgs {
    /// n.
    pub shift: u32,
    /// `z_o`.
    pub zero_point: i16,
    /// Bounds of the output code.
    pub clamp: Clamp,
}

/// Arguments of [`Kernels::resize_bilinear`].
#[derive(Clone, Copy, Debug)]
pub struct ResizeArgs<'a> {
    /// Shape of the small map.
    pub input_shape: Shape,
    /// Shape of the output.
    pub output_shape: Shape,
    /// The small map (never in place).
    pub input: TermArgs<'a>,
    /// Map to add, if any.
    pub residual: Option<TermArgs<'a>>,
    /// `[i0, w1]` per output row.
    pub rows: &'a [[u16; 2]],
    /// `[i0, w1]` per output column.
    pub columns: &'a [[u16; 2]],
    /// w.
    pub weight_bits: u32,
    /// End of the sum.
    pub sum: SumArgs,
}

/// One map of [`Kernels::tokens`].
#[derive(Clone, Copy, Debug)]
pub struct TokenSourceArgs<'a> {
    /// Codes of the map.
    pub codes: Codes<'a>,
    /// Shape of the map.
    pub shape: Shape,
    /// `z`.
    pub zero_point: i16,
    /// Pooling window, vertical and horizontal.
    pub pool: [u8; 2],
    /// `M`.
    pub multiplier: i32,
}

/// Arguments of [`Kernels::tokens`].
#[derive(Clone, Copy, Debug)]
pub struct TokensArgs<'a> {
    /// The two maps, in token order.
    pub sources: [TokenSourceArgs<'a>; 2],
    /// Velocity, Q8 m/s.
    pub velocity: i16,
    /// `U_c` per channel.
    pub velocity_multipliers: &'a [i32],
    /// `P_tc`, `[T][C]`.
    pub position: &'a [i16],
    /// End of the sum; `P_tc` is added after the rounding.
    pub sum: SumArgs,
}

/// Arguments of [`Kernels::layer_norm`].
#[derive(Clone, Copy, Debug)]
pub struct LayerNormArgs<'a> {
    /// Rows to normalize (the input slice starts at the first of them).
    pub rows: u32,
    /// C.
    pub channels: u16,
    /// E.
    pub epsilon: i64,
    /// `G_i`.
    pub gains: &'a [i32],
    /// `B_i`.
    pub offsets: &'a [i64],
    /// End of the sum.
    pub sum: SumArgs,
}

/// Arguments of [`Kernels::attention`].
#[derive(Clone, Copy, Debug)]
pub struct AttentionArgs<'a> {
    /// Rows of q, k, v and the output.
    pub tokens: u32,
    /// C.
    pub channels: u16,
    /// Heads.
    pub heads: u16,
    /// `M_u`, `n_u`.
    pub exponent: Requant,
    /// 257 entries.
    pub exp_table: &'a [i16],
    /// M, n, with zero point and clamp of the output.
    pub requant: RequantArgs,
}

/// Arguments of [`Kernels::waypoint_decoder`]; see [`crate::program::WaypointDecoder`] for shapes.
#[derive(Clone, Copy, Debug)]
#[allow(missing_docs, reason = "field for field the step's, with ranges resolved")]
pub struct WaypointDecoderArgs<'a> {
    pub hidden_size: u16,
    pub steps: u16,
    pub hidden_fraction_bits: u32,
    pub concat: bool,
    pub input_weights: &'a [i16],
    pub hidden_weights: &'a [i16],
    pub input_pre_shift: u32,
    pub hidden_pre_shift: u32,
    pub input_multipliers: &'a [i32],
    pub hidden_multipliers: &'a [i32],
    pub shifts: &'a [u8],
    pub biases: &'a [i64],
    pub output_weights: &'a [i16],
    pub output_bias: &'a [i64],
    pub output_pre_shift: u32,
    pub output_requant: [Requant; 2],
    pub tanh_table: &'a [i16],
}

/// Arguments of [`Kernels::copy_box`]; see [`crate::program::CopyBox`].
#[derive(Clone, Copy, Debug)]
pub struct CopyBoxArgs {
    /// Input shape.
    pub input_shape: Shape,
    /// Output shape.
    pub output_shape: Shape,
    /// First index of the input per axis.
    pub begin: [u16; 3],
    /// Distance of neighbors in the input per axis.
    pub stride: [u16; 3],
    /// Elements taken per axis.
    pub size: [u16; 3],
    /// Border in front of them per axis.
    pub before: [u16; 3],
    /// Code of the border.
    pub border: i16,
}

/// One operand of [`Kernels::concat`].
#[derive(Clone, Copy, Debug)]
pub struct ConcatSourceArgs<'a> {
    /// Codes of the map.
    pub codes: Codes<'a>,
    /// Shape of the map.
    pub shape: Shape,
    /// To the output's scale, with the output's zero point and bounds.
    pub requant: RequantArgs,
}

/// Arguments of [`Kernels::softmax`].
#[derive(Clone, Copy, Debug)]
pub struct SoftmaxArgs<'a> {
    /// Values of one softmax.
    pub channels: u16,
    /// `M_u`, `n_u`.
    pub exponent: Requant,
    /// 257 entries.
    pub exp_table: &'a [i16],
}

/// Arguments of [`Kernels::gather_sum`]; see [`crate::program::GatherSum`].
#[derive(Clone, Copy, Debug)]
pub struct GatherSumArgs<'a> {
    /// Input shape.
    pub input_shape: Shape,
    /// Output shape.
    pub output_shape: Shape,
    /// Row and column of each cell, as many pairs for every output position.
    pub indices: &'a [i8],
    /// From the sum to the output's scale.
    pub requant: RequantArgs,
}

/// Arguments of [`Kernels::sigmoid`].
#[derive(Clone, Copy, Debug)]
pub struct SigmoidArgs<'a> {
    /// `z`.
    pub input_zero_point: i16,
    /// M, n: to Q12.
    pub requant: Requant,
    /// 513 entries.
    pub tanh_table: &'a [i16],
}

/// Arguments of [`Kernels::spatial_softmax`].
#[derive(Clone, Copy, Debug)]
pub struct SpatialSoftmaxArgs<'a> {
    /// Shape of the logits.
    pub shape: Shape,
    /// `M_u`, `n_u`.
    pub exponent: Requant,
    /// 257 entries.
    pub exp_table: &'a [i16],
}

/// One method per operator (branches of linear layers run [`Self::linear`]); see the module page. Operand layouts are
/// those of [`crate::tensor`].
pub trait Kernels {
    /// The kernels that this backend can read.
    fn supported(&self) -> &'static [KernelId];

    /// Convolution. `scratch`: [`plan::conv2d_scratch_bytes`]. All scratch is aligned to 4 bytes.
    fn conv2d(&self, args: &Conv2dArgs<'_>, input: &[i8], output: CodesMut<'_>, scratch: &mut [u8]) {
        portable::conv2d::conv2d(args, input, output, scratch);
    }

    /// Matrix product per position. `scratch`: [`plan::linear_scratch_bytes`].
    fn linear(&self, args: &LinearArgs<'_>, input: Codes<'_>, output: CodesMut<'_>, scratch: &mut [u8]) {
        portable::linear::linear(args, input, output, scratch);
    }

    /// Max pool. `input` is `None` in place: then `output` holds the whole input and its front receives the result.
    fn max_pool(&self, args: &PoolArgs, input: Option<Codes<'_>>, output: CodesMut<'_>) {
        portable::pool::max_pool(args, input, output);
    }

    /// Average pool over full windows.
    fn average_pool(&self, args: &PoolArgs, requant: &RequantArgs, input: Codes<'_>, output: CodesMut<'_>) {
        portable::pool::average_pool(args, requant, input, output);
    }

    /// Mean over all positions of the maps (all of `channels` channels), added.
    fn global_pool(&self, channels: u16, sum: &SumArgs, terms: &[TermArgs<'_>], output: CodesMut<'_>) {
        portable::pool::global_pool(channels, sum, terms, output);
    }

    /// Element-wise sum.
    fn add(&self, sum: &SumArgs, terms: &[TermArgs<'_>; 2], output: CodesMut<'_>) {
        portable::elementwise::add(sum, terms, output);
    }

    /// Change of scale or type.
    fn requantize(&self, args: &RequantArgs, input: Codes<'_>, output: CodesMut<'_>) {
        portable::elementwise::requantize(args, input, output);
    }

    /// Bilinear enlargement, with an optional sum.
    fn resize_bilinear(&self, args: &ResizeArgs<'_>, output: CodesMut<'_>) {
        portable::resize_bilinear::resize_bilinear(args, output);
    }

    /// Pooled maps, velocity and position to tokens.
    fn tokens(&self, args: &TokensArgs<'_>, output: CodesMut<'_>) {
        portable::tokens::tokens(args, output);
    }

    /// LayerNorm per row.
    fn layer_norm(&self, args: &LayerNormArgs<'_>, input: Codes<'_>, output: CodesMut<'_>) {
        portable::layer_norm::layer_norm(args, input, output);
    }

    /// Attention. `query` is `None` in place: then `output` holds the queries. `scratch`:
    /// [`plan::attention_scratch_bytes`].
    fn attention(
        &self,
        args: &AttentionArgs<'_>,
        query: Option<&[i8]>,
        key: &[i8],
        value: &[i8],
        output: CodesMut<'_>,
        scratch: &mut [u8],
    ) {
        portable::attention::attention(args, query, key, value, output, scratch);
    }

    /// GRU and output layer. `goal`: two Q16 values; `waypoints`: `2·steps` Q16 values. `scratch`:
    /// [`plan::waypoint_decoder_scratch_bytes`].
    fn waypoint_decoder(
        &self,
        args: &WaypointDecoderArgs<'_>,
        hidden: &[i16],
        goal: &[i32],
        waypoints: &mut [i32],
        scratch: &mut [u8],
    ) {
        portable::waypoint_decoder::waypoint_decoder(args, hidden, goal, waypoints, scratch);
    }

    /// A strided box of the input inside a border.
    fn copy_box(&self, args: &CopyBoxArgs, input: Codes<'_>, output: CodesMut<'_>) {
        portable::copy_box::copy_box(args, input, output);
    }

    /// Two maps one behind the other along an axis.
    fn concat(&self, axis: Axis, sources: &[ConcatSourceArgs<'_>; 2], output: CodesMut<'_>) {
        portable::concat::concat(axis, sources, output);
    }

    /// Softmax over the channels of each position. `input` is `None` in place: then `output` holds the logits.
    fn softmax(&self, args: &SoftmaxArgs<'_>, input: Option<Codes<'_>>, output: &mut [i16]) {
        portable::softmax::softmax(args, input, output);
    }

    /// Sums of gathered cells of a map.
    fn gather_sum(&self, args: &GatherSumArgs<'_>, input: Codes<'_>, output: CodesMut<'_>) {
        portable::gather_sum::gather_sum(args, input, output);
    }

    /// Logistic function of each element. `input` is `None` in place: then `output` holds the codes.
    fn sigmoid(&self, args: &SigmoidArgs<'_>, input: Option<Codes<'_>>, output: &mut [i16]) {
        portable::sigmoid::sigmoid(args, input, output);
    }

    /// Expected pixel per channel. `points`: `[column, row]` of each channel, in 1/64 pixel.
    fn spatial_softmax(&self, args: &SpatialSoftmaxArgs<'_>, input: &[i16], points: &mut [i32]) {
        portable::spatial_softmax::spatial_softmax(args, input, points);
    }
}

/// A borrowed backend is one: every method goes to the backend behind the reference.
impl<K: Kernels + ?Sized> Kernels for &K {
    fn supported(&self) -> &'static [KernelId] {
        (**self).supported()
    }

    fn conv2d(&self, args: &Conv2dArgs<'_>, input: &[i8], output: CodesMut<'_>, scratch: &mut [u8]) {
        (**self).conv2d(args, input, output, scratch);
    }

    fn linear(&self, args: &LinearArgs<'_>, input: Codes<'_>, output: CodesMut<'_>, scratch: &mut [u8]) {
        (**self).linear(args, input, output, scratch);
    }

    fn max_pool(&self, args: &PoolArgs, input: Option<Codes<'_>>, output: CodesMut<'_>) {
        (**self).max_pool(args, input, output);
    }

    fn average_pool(&self, args: &PoolArgs, requant: &RequantArgs, input: Codes<'_>, output: CodesMut<'_>) {
        (**self).average_pool(args, requant, input, output);
    }

    fn global_pool(&self, channels: u16, sum: &SumArgs, terms: &[TermArgs<'_>], output: CodesMut<'_>) {
        (**self).global_pool(channels, sum, terms, output);
    }

    fn add(&self, sum: &SumArgs, terms: &[TermArgs<'_>; 2], output: CodesMut<'_>) {
        (**self).add(sum, terms, output);
    }

    fn requantize(&self, args: &RequantArgs, input: Codes<'_>, output: CodesMut<'_>) {
        (**self).requantize(args, input, output);
    }

    fn resize_bilinear(&self, args: &ResizeArgs<'_>, output: CodesMut<'_>) {
        (**self).resize_bilinear(args, output);
    }

    fn tokens(&self, args: &TokensArgs<'_>, output: CodesMut<'_>) {
        (**self).tokens(args, output);
    }

    fn layer_norm(&self, args: &LayerNormArgs<'_>, input: Codes<'_>, output: CodesMut<'_>) {
        (**self).layer_norm(args, input, output);
    }

    fn attention(
        &self,
        args: &AttentionArgs<'_>,
        query: Option<&[i8]>,
        key: &[i8],
        value: &[i8],
        output: CodesMut<'_>,
        scratch: &mut [u8],
    ) {
        (**self).attention(args, query, key, value, output, scratch);
    }

    fn waypoint_decoder(
        &self,
        args: &WaypointDecoderArgs<'_>,
        hidden: &[i16],
        goal: &[i32],
        waypoints: &mut [i32],
        scratch: &mut [u8],
    ) {
        (**self).waypoint_decoder(args, hidden, goal, waypoints, scratch);
    }

    fn copy_box(&self, args: &CopyBoxArgs, input: Codes<'_>, output: CodesMut<'_>) {
        (**self).copy_box(args, input, output);
    }

    fn concat(&self, axis: Axis, sources: &[ConcatSourceArgs<'_>; 2], output: CodesMut<'_>) {
        (**self).concat(axis, sources, output);
    }

    fn softmax(&self, args: &SoftmaxArgs<'_>, input: Option<Codes<'_>>, output: &mut [i16]) {
        (**self).softmax(args, input, output);
    }

    fn gather_sum(&self, args: &GatherSumArgs<'_>, input: Codes<'_>, output: CodesMut<'_>) {
        (**self).gather_sum(args, input, output);
    }

    fn sigmoid(&self, args: &SigmoidArgs<'_>, input: Option<Codes<'_>>, output: &mut [i16]) {
        (**self).sigmoid(args, input, output);
    }

    fn spatial_softmax(&self, args: &SpatialSoftmaxArgs<'_>, input: &[i16], points: &mut [i32]) {
        (**self).spatial_softmax(args, input, points);
    }
}

/// The norm: plain Rust, any target.
#[derive(Clone, Copy, Debug, Default)]
pub struct Portable;

impl Kernels for Portable {
    fn supported(&self) -> &'static [KernelId] {
        KernelId::ALL
    }
}
