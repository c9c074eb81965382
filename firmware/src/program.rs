//! The program section: one typed [`Step`] per operator, stored as postcard and decoded one at a time (no RAM).
//!
//! A step names tensors by [`TensorId`] and constants by [`ConstRange`]. Shapes and element types of operands are in
//! the tensor table and are not repeated here; a step holds only what the table cannot say. All integer rules
//! (`R(v, n)`, requantize, epilogues) are those of [`crate::fixed_point`].
//!
//! Evolution: a variant is never changed, only added at the end, and each kind has a feature bit
//! ([`Step::feature`]), so an older runtime refuses a newer image by name.

#![deny(
    clippy::indexing_slicing,
    clippy::arithmetic_side_effects,
    clippy::unwrap_used,
    clippy::expect_used,
    clippy::panic
)]

use crate::tensor::{Shape, TensorId};
use serde::{Deserialize, Serialize};

mod window;

pub use window::Window;

/// A byte range of the constants section, 16-byte aligned, little-endian elements.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash, Serialize, Deserialize)]
pub struct ConstRange {
    /// First byte, relative to the constants section; a multiple of 16.
    pub offset: u32,
    /// Length in bytes, without padding.
    pub bytes: u32,
}

/// Algorithm and packing of one weighted step: weights, bias and multipliers are stored in this kernel's order.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash, Serialize, Deserialize)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub enum KernelId {
    /// Canonical order: weights `[output][kh][kw][input]` (`[output][input]` for linear), depth contiguous.
    Direct,
    /// Blocks of 16 outputs × 4 depth elements: [`crate::kernels::k4n16`].
    K4N16,
}

impl KernelId {
    /// All kernels of this format.
    pub const ALL: &'static [Self] = &[Self::Direct, Self::K4N16];

    /// Bit of the header's `features` word that an image with this kernel must set.
    pub const fn feature(self) -> u64 {
        1 << match self {
            Self::Direct => 32,
            Self::K4N16 => 33,
        }
    }
}

/// Saturation bounds of an output, in codes; ReLU is a lower bound equal to the zero point.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash, Serialize, Deserialize)]
pub struct Clamp {
    /// Smallest code.
    pub min: i16,
    /// Largest code.
    pub max: i16,
}

/// One factor for all channels: `R(v · multiplier, shift)`.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash, Serialize, Deserialize)]
pub struct Requant {
    /// Integer factor; in `[2^23, 2^24)` where it stands alone, below `2^31` as a term of a sum.
    pub multiplier: i32,
    /// Right shift, 0..=52.
    pub shift: u8,
}

/// How the accumulators of a weighted step become output codes. Arrays are per output channel.
///
/// With `t = R(acc, pre_shift)`, `acc = bias + Σ w·q`:
/// * `Requant`: `y = clamp(z_o + R(t·M, n))`, M in `[2^23, 2^24)`, n in 1..=52
/// * `Residual`: `y = clamp(z_o + R(t·M + (r − z_r)·M_r, n))`, one rounding, M and M_r below 2^31, n ≤ 40
/// * `Stream`: `y = clamp(r + R(t·M, n))`, r and y of the same scale
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct Rescale {
    /// `p`: right shift of the accumulator before the multiplication, 0..=36.
    pub pre_shift: u8,
    /// `i32` per output channel: the effective bias `b'`.
    pub bias: ConstRange,
    /// `i32` per output channel: `M`.
    pub multipliers: ConstRange,
    /// `u8` per output channel: `n`.
    pub shifts: ConstRange,
    /// `z_o`, the output's zero point.
    pub zero_point: i16,
    /// Bounds of the output code.
    pub clamp: Clamp,
    /// The second term, if any.
    pub residual: Residual,
}

/// Second term of a [`Rescale`].
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub enum Residual {
    /// None: plain requantization.
    None,
    /// A stored operand with its own scale.
    Scaled {
        /// `r`, shaped like the output. May be the tensor that the output overwrites.
        tensor: TensorId,
        /// `z_r`.
        zero_point: i16,
        /// `i32` per output channel: `M_r`.
        multipliers: ConstRange,
    },
    /// A stored operand of the output's own scale: the factor is exactly 1.
    Stream {
        /// `r`, shaped like the output. May be the tensor that the output overwrites.
        tensor: TensorId,
    },
}

/// `acc = bias + Σ w·q` over a window; see [`Rescale`] for what follows. i8 input, i8 weights, i32 accumulator.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct Conv2d {
    /// i8 map `H×W×C`.
    pub input: TensorId,
    /// i8 or i16 map.
    pub output: TensorId,
    /// Kernel, stride, padding, dilation.
    pub window: Window,
    /// Channel groups: input and output channels are both divided by it.
    pub groups: u16,
    /// Packing of `weights`.
    pub kernel: KernelId,
    /// `i8` weights `[O][kh][kw][C/groups]`, in the order of `kernel`.
    pub weights: ConstRange,
    /// `i8` per input channel: the code that stands for padding.
    pub padding_codes: ConstRange,
    /// From accumulator to output code.
    pub rescale: Rescale,
    /// Working memory of the kernel.
    pub scratch: Option<TensorId>,
}

/// `acc = bias + Σ w·q` per position: matrix product over the channels. i8 or i16 input, i8 weights.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct Linear {
    /// i8 or i16, `positions × I`.
    pub input: TensorId,
    /// i8 or i16, `positions × O`.
    pub output: TensorId,
    /// Packing of `weights`.
    pub kernel: KernelId,
    /// `i8` weights `[O][I]`, in the order of `kernel`.
    pub weights: ConstRange,
    /// Accumulate in 64 bits (the compiler's bound exceeds 31 bits).
    pub wide: bool,
    /// From accumulator to output code.
    pub rescale: Rescale,
    /// Working memory of the kernel.
    pub scratch: Option<TensorId>,
}

/// Largest code of each window; padding never wins. Input and output have the same type, scale and channels.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct MaxPool {
    /// i8 or i16 map.
    pub input: TensorId,
    /// Map of the same type; may overwrite the input where row order allows.
    pub output: TensorId,
    /// Kernel, stride, padding (dilation 1).
    pub window: Window,
}

/// `y = clamp(z_o + R(Σ(q − z)·M, n))` over full windows, in the output's own scale.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct AveragePool {
    /// i8 or i16 map.
    pub input: TensorId,
    /// i8 or i16 map.
    pub output: TensorId,
    /// Kernel and stride (no padding, dilation 1).
    pub window: Window,
    /// `z`.
    pub input_zero_point: i16,
    /// `M = s_x / (s_o · N)` and n.
    pub requant: Requant,
    /// `z_o`.
    pub zero_point: i16,
    /// Bounds of the output code.
    pub clamp: Clamp,
}

/// One stored operand of a sum: `(q − zero_point) · multiplier`.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct Term {
    /// The operand.
    pub tensor: TensorId,
    /// Its zero point.
    pub zero_point: i16,
    /// `M_k < 2^31`.
    pub multiplier: i32,
}

/// Mean over all positions of one or two maps, added: `y_c = clamp(z_o + R(Σ_k M_k·Σ_p (q_kpc − z_k), n))`.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct GlobalPool {
    /// First map.
    pub first: Term,
    /// Second map of the same channel count, if any.
    pub second: Option<Term>,
    /// Vector `1×1×C`.
    pub output: TensorId,
    /// n, at most 40.
    pub shift: u8,
    /// `z_o`.
    pub zero_point: i16,
    /// Bounds of the output code.
    pub clamp: Clamp,
}

/// Sum of two operands of the same shape: `y = clamp(z_o + R((a − z_a)·M_a + (b − z_b)·M_b, n))`.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct Add {
    /// First operand.
    pub first: Term,
    /// Second operand.
    pub second: Term,
    /// i8 or i16; may overwrite either operand of the same element type.
    pub output: TensorId,
    /// n, at most 40.
    pub shift: u8,
    /// `z_o`.
    pub zero_point: i16,
    /// Bounds of the output code.
    pub clamp: Clamp,
}

/// Change of scale or type: `y = clamp(z_o + R((q − z)·M, n))`.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct Requantize {
    /// i8 or i16.
    pub input: TensorId,
    /// i8 or i16, same shape.
    pub output: TensorId,
    /// `z`.
    pub input_zero_point: i16,
    /// M and n.
    pub requant: Requant,
    /// `z_o`.
    pub zero_point: i16,
    /// Bounds of the output code.
    pub clamp: Clamp,
}

/// Bilinear enlargement by a whole factor with half-pixel centers, optionally added to a map of the output's size.
///
/// Per axis, output index d reads rows `i0(d)`, `i1 = min(i0+1, last)` with weights `2^w − w1(d)` and `w1(d)`, stored
/// in `rows` / `columns` as pairs `(i0: u16, w1: u16)`. `t = R(Σ wy·wx·(q − z), 2w − 8)` (1/256 of the input LSB);
/// `y = clamp(z_o + R(t·M + (r − z_r)·M_r, n))`.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct ResizeBilinear {
    /// The small map (its multiplier is `s_x/s_o·2^-8`).
    pub input: Term,
    /// Map of the output's shape to add.
    pub residual: Option<Term>,
    /// i8 or i16; may overwrite the residual of the same element type.
    pub output: TensorId,
    /// `(i0: u16, w1: u16)` per output row.
    pub rows: ConstRange,
    /// `(i0: u16, w1: u16)` per output column.
    pub columns: ConstRange,
    /// w, 4..=11.
    pub weight_bits: u8,
    /// n, at most 40.
    pub shift: u8,
    /// `z_o`.
    pub zero_point: i16,
    /// Bounds of the output code.
    pub clamp: Clamp,
}

/// One map that becomes tokens: it is average-pooled to the token grid.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct TokenSource {
    /// i8 or i16 map `H×W×C`.
    pub map: TensorId,
    /// `z` of the map.
    pub zero_point: i16,
    /// Pooling window and stride, vertical (divides H).
    pub pool_h: u8,
    /// Pooling window and stride, horizontal (divides W).
    pub pool_w: u8,
    /// `M`, of `s_map / (s_x·N)`, N = pool_h·pool_w.
    pub multiplier: i32,
}

/// Tokens of up to two maps with positional embedding and velocity, straight into the residual stream:
/// `x_tc = clamp(z_o + R(Σ(q − z)·M + v·U_c, n) + P_tc)`; tokens of `first` come first.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct Tokens {
    /// First map (camera).
    pub first: TokenSource,
    /// Second map (LiDAR).
    pub second: TokenSource,
    /// i16 Q8 m/s, one value.
    pub velocity: TensorId,
    /// `T×C`, i16 (or i8).
    pub output: TensorId,
    /// `i32` per channel: `U_c`.
    pub velocity_multipliers: ConstRange,
    /// `i16` `[T][C]`: `P_tc`.
    pub position: ConstRange,
    /// n, at most 40.
    pub shift: u8,
    /// `z_o`.
    pub zero_point: i16,
    /// Bounds of the output code.
    pub clamp: Clamp,
}

/// LayerNorm over the channels of rows `first_row ..` of a stream; as many rows as the output has positions.
///
/// `S = Σx; V = C·Σx² − S² + E; h = max(0, (52 − bits(V)) >> 1); σ = isqrt(V << 2h); R_σ = floor(2^47/σ);`
/// `t_i = R((C·x_i − S)·R_σ, 33 − h)` (Q14); `y_i = clamp(z_o + R(t_i·G_i + B_i, n))`.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct LayerNorm {
    /// i16 (or i8) stream `T×C`, C ≤ 1024.
    pub input: TensorId,
    /// i8 or i16; any shape with C channels.
    pub output: TensorId,
    /// First row of the input that is read.
    pub first_row: u16,
    /// E, at least 1.
    pub epsilon: i64,
    /// `i32` per channel: `G_i`, |G| < 2^24.
    pub gains: ConstRange,
    /// `i64` per channel: `B_i`, |B| < 2^51.
    pub offsets: ConstRange,
    /// n, at most 40.
    pub shift: u8,
    /// `z_o`.
    pub zero_point: i16,
    /// Bounds of the output code.
    pub clamp: Clamp,
}

/// Multi-head attention over all rows, streamed one query row at a time (no N×N map); numerics in [`crate::ops`].
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct Attention {
    /// Queries, i8 symmetric `T×C`.
    pub query: TensorId,
    /// Keys, i8 symmetric `T×C`.
    pub key: TensorId,
    /// Values, i8 symmetric `T×C`.
    pub value: TensorId,
    /// `T×C`, i8 or i16. May overwrite the queries (same type): a row is written after its last use.
    pub output: TensorId,
    /// Number of heads; divides C. Head h uses channels `h·C/heads ..`.
    pub heads: u16,
    /// `M_u`, `n_u`: distance from the maximum to base-2 exponent, Q16.
    pub exponent: Requant,
    /// 257 × `i16`: `T[k] = min(32767, round(2^15·2^(−k/256)))`.
    pub exp_table: ConstRange,
    /// M, n of `s_v/s_o·2^-12`.
    pub requant: Requant,
    /// `z_o`.
    pub zero_point: i16,
    /// Bounds of the output code.
    pub clamp: Clamp,
    /// Working memory: one row of probabilities per head.
    pub scratch: Option<TensorId>,
}

/// GRU that emits waypoints: `steps` iterations from the hidden state `h0` (gate order r, z, n).
///
/// H = hidden size, U = 2 (waypoint + goal added) or 4 (concatenated), rows stacked r, z, n.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct WaypointDecoder {
    /// `h0`, i16 vector of H values, scale `2^-hidden_fraction_bits`.
    pub hidden: TensorId,
    /// Goal, i32 Q16 m, `[right, forward-negative]`.
    pub goal: TensorId,
    /// Waypoints, i32 Q16 m, `steps×1×2`.
    pub output: TensorId,
    /// `f`, at most 15.
    pub hidden_fraction_bits: u8,
    /// Concatenate waypoint and goal (U = 4) instead of adding them (U = 2).
    pub concat: bool,
    /// `i16` `[3H][U]`.
    pub input_weights: ConstRange,
    /// `i16` `[3H][H]`.
    pub hidden_weights: ConstRange,
    /// `p_x`.
    pub input_pre_shift: u8,
    /// `p_h`.
    pub hidden_pre_shift: u8,
    /// `i32` `[3H]`: `Mx`.
    pub input_multipliers: ConstRange,
    /// `i32` `[3H]`: `Mh`.
    pub hidden_multipliers: ConstRange,
    /// `u8` `[3H]`: n, at most 30.
    pub shifts: ConstRange,
    /// `i64` `[4H]`: B of the r rows, B of the z rows, B_i of the n rows, B_h of the n rows.
    pub biases: ConstRange,
    /// `i16` `[2][H]`.
    pub output_weights: ConstRange,
    /// `i64` `[2]`: b'.
    pub output_bias: ConstRange,
    /// p of the output layer.
    pub output_pre_shift: u8,
    /// M, n of the two output rows (to Q16 m).
    pub output_requant: [Requant; 2],
    /// 513 × `i16`: `T[k] = min(32767, round(2^15·tanh(k/64)))`.
    pub tanh_table: ConstRange,
    /// Working memory: two hidden states.
    pub scratch: Option<TensorId>,
}

/// A strided box of the input inside a border of one code, along height, width and channels:
/// `y[before + i] = q[begin + i·stride]` for i in `0..size`, every other element of the output is the border.
///
/// A slice has no border, a pad takes the whole input. Input and output have the same type, scale and zero point.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct CopyBox {
    /// i8 or i16 map.
    pub input: TensorId,
    /// Map of the same type.
    pub output: TensorId,
    /// First index of the input per axis.
    pub begin: [u16; 3],
    /// Distance of neighbors in the input per axis, at least 1.
    pub stride: [u16; 3],
    /// Elements taken per axis, at least 1.
    pub size: [u16; 3],
    /// Elements of border in front of them per axis; what the output is longer lies behind.
    pub before: [u16; 3],
    /// Code of the border.
    pub border: i16,
}

/// An axis of a map.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash, Serialize, Deserialize)]
pub enum Axis {
    /// Rows.
    Height,
    /// Columns.
    Width,
    /// Channels.
    Channels,
}

impl Axis {
    /// Elements of a map that lie together in the map and in every concatenation along this axis.
    pub const fn run(self, shape: Shape) -> u64 {
        match self {
            Self::Height => shape.elements(),
            Self::Width => (shape.width as u64).saturating_mul(shape.channels as u64),
            Self::Channels => shape.channels as u64,
        }
    }
}

/// One operand of a [`Concat`], brought to the output's scale.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct ConcatSource {
    /// i8 or i16 map.
    pub tensor: TensorId,
    /// `z` of the operand.
    pub zero_point: i16,
    /// `M = s_x / s_o` and n; `2^23` and 23 where the scales are equal.
    pub requant: Requant,
}

/// Two maps one behind the other along an axis, equal in the other two.
///
/// `y = clamp(z_o + R((q − z)·M, n))`, each operand with its own z, M and n.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct Concat {
    /// The operand in front.
    pub first: ConcatSource,
    /// The operand behind it.
    pub second: ConcatSource,
    /// i8 or i16 map.
    pub output: TensorId,
    /// Where the maps meet.
    pub axis: Axis,
    /// `z_o`.
    pub zero_point: i16,
    /// Bounds of the output code.
    pub clamp: Clamp,
}

/// Softmax over the channels of each position; steps 2 and 3 of [`crate::ops`] with `δ_j = max(q) − q_j`, then
/// `p_j = min(32767, R(e_j·R_s, c+7))` (Q15).
///
/// At most 32768 channels: then `S < 2^30`, so that `2^(c+22) ≤ 2^52`.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct Softmax {
    /// i8 or i16; the zero point does not matter.
    pub input: TensorId,
    /// i16, same shape, scale `2^-15`. May overwrite an i16 input: an element is written after its last use.
    pub output: TensorId,
    /// `M_u`, `n_u`, of `s_x·log2(e)·2^16`.
    pub exponent: Requant,
    /// 257 × `i16`: `T[k] = min(32767, round(2^15·2^(−k/256)))`.
    pub exp_table: ConstRange,
}

/// Sums of gathered cells: `y_ijc = clamp(z_o + R(Σ_k (q[p_ijk]_c − z)·M, n))`.
///
/// `p_ijk` is the cell (row `indices[i,j,2k]`, column `indices[i,j,2k+1]`) of the map, k = 0 .. K; an index outside the
/// map means the nearest row or column. A cell may occur several times.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct GatherSum {
    /// i8 or i16 map `H×W×C`.
    pub input: TensorId,
    /// i8 map `OH×OW×2K`: a row and a column per cell, plain numbers.
    pub indices: TensorId,
    /// i8 or i16 map `OH×OW×C`.
    pub output: TensorId,
    /// `z`.
    pub input_zero_point: i16,
    /// `M = s_x / s_o` and n.
    pub requant: Requant,
    /// `z_o`.
    pub zero_point: i16,
    /// Bounds of the output code.
    pub clamp: Clamp,
}

/// A [`Linear`] layer with B blocks of weights, of which a code selects one:
/// `acc = bias + Σ w·q` with the rows of block `clamp(command − 1, 0, B − 1)`; see [`Rescale`] for what follows.
///
/// Arrays of `rescale` are per output channel of all blocks, `B·O`; it has no second term.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct BranchLinear {
    /// i8 or i16, `positions × I`.
    pub input: TensorId,
    /// i8, one code: 1 is the first block.
    pub command: TensorId,
    /// i8 or i16, `positions × O`.
    pub output: TensorId,
    /// B, 1..=127: as many as an i8 command can name.
    pub branches: u16,
    /// Packing of each block.
    pub kernel: KernelId,
    /// `i8` weights `[B][O][I]`, each block in the order of `kernel`.
    pub weights: ConstRange,
    /// Accumulate in 64 bits (the compiler's bound exceeds 31 bits).
    pub wide: bool,
    /// From accumulator to output code.
    pub rescale: Rescale,
    /// Working memory of the kernel.
    pub scratch: Option<TensorId>,
}

/// Logistic function of each element: `x = R((q − z)·M, n)` (Q12, not clamped),
/// `y = min(32767, R(2^15 + tanh(x/2), 1))` (Q15) with tanh from the table: `a = min(|x|, 2^16 − 1)`, `k = a>>7`,
/// `r = a&127`, `tanh(x/2) = ±R(T[k]·128 + (T[k+1] − T[k])·r, 7)` with the sign of x.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct Sigmoid {
    /// i8 or i16.
    pub input: TensorId,
    /// i16, same shape, scale `2^-15`. May overwrite an i16 input.
    pub output: TensorId,
    /// `z`.
    pub input_zero_point: i16,
    /// M and n of `s_x·2^12`.
    pub requant: Requant,
    /// 513 × `i16`: `T[k] = min(32767, round(2^15·tanh(k/64)))`.
    pub tanh_table: ConstRange,
}

/// Expected pixel of each channel's map under a softmax over all pixels: for channel k, with `δ_j = max(q_k) − q_jk`,
/// `u_j = min(R(δ_j·M_u, n_u), 31·2^16)`, `I = u>>16`, `i = (u>>8)&255`, `r = u&255`:
///
/// `e_j = R((T[i]<<8) − (T[i]−T[i+1])·r, I)` (Q23); `column = floor(2^6·Σ e_j·column_j / Σ e_j)`, `row` alike.
///
/// No probability is formed: Q15 is too coarse where thousands of faint pixels outweigh the peak. At most 256 rows and
/// columns: then `Σ e_j < 2^39` and `2^6·Σ e_j·column_j < 2^53`.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct SpatialSoftmax {
    /// i16 map of logits `H×W×K`, H and W at most 256.
    pub input: TensorId,
    /// i32 points `K×1×2`, `[column, row]` in 1/64 pixel from the center of the first pixel.
    pub output: TensorId,
    /// `M_u`, `n_u`, of `s_x·log2(e)/temperature·2^16`.
    pub exponent: Requant,
    /// 257 × `i16`: `T[k] = min(32767, round(2^15·2^(−k/256)))`.
    pub exp_table: ConstRange,
}

/// One operator of the program, in the order of execution.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[allow(clippy::large_enum_variant, reason = "decoded one at a time on the stack, never stored in bulk on the target")]
#[allow(missing_docs, reason = "each variant is documented at its struct")]
pub enum Step {
    Conv2d(Conv2d),
    Linear(Linear),
    MaxPool(MaxPool),
    AveragePool(AveragePool),
    GlobalPool(GlobalPool),
    Add(Add),
    Requantize(Requantize),
    ResizeBilinear(ResizeBilinear),
    Tokens(Tokens),
    LayerNorm(LayerNorm),
    Attention(Attention),
    WaypointDecoder(WaypointDecoder),
    CopyBox(CopyBox),
    Concat(Concat),
    Softmax(Softmax),
    GatherSum(GatherSum),
    BranchLinear(BranchLinear),
    Sigmoid(Sigmoid),
    SpatialSoftmax(SpatialSoftmax),
}

impl Rescale {
    /// The stored operand of the second term.
    pub const fn residual_tensor(&self) -> Option<TensorId> {
        match self.residual {
            Residual::None => None,
            Residual::Scaled { tensor, .. } | Residual::Stream { tensor } => Some(tensor),
        }
    }
}

impl Step {
    /// Union of the feature bits of all step kinds and kernels of this format.
    pub const KNOWN_FEATURES: u64 = ((1 << 19) - 1) | KernelId::Direct.feature() | KernelId::K4N16.feature();

    /// Operator name as reports print it.
    pub const fn name(&self) -> &'static str {
        match self {
            Self::Conv2d(_) => "conv2d",
            Self::Linear(_) => "linear",
            Self::MaxPool(_) => "max_pool",
            Self::AveragePool(_) => "average_pool",
            Self::GlobalPool(_) => "global_pool",
            Self::Add(_) => "add",
            Self::Requantize(_) => "requantize",
            Self::ResizeBilinear(_) => "resize_bilinear",
            Self::Tokens(_) => "tokens",
            Self::LayerNorm(_) => "layer_norm",
            Self::Attention(_) => "attention",
            Self::WaypointDecoder(_) => "waypoint_decoder",
            Self::CopyBox(_) => "copy_box",
            Self::Concat(_) => "concat",
            Self::Softmax(_) => "softmax",
            Self::GatherSum(_) => "gather_sum",
            Self::BranchLinear(_) => "branch_linear",
            Self::Sigmoid(_) => "sigmoid",
            Self::SpatialSoftmax(_) => "spatial_softmax",
        }
    }

    /// Bit of the header's `features` word that an image with this step must set.
    pub const fn feature(&self) -> u64 {
        1 << match self {
            Self::Conv2d(_) => 0,
            Self::Linear(_) => 1,
            Self::MaxPool(_) => 2,
            Self::AveragePool(_) => 3,
            Self::GlobalPool(_) => 4,
            Self::Add(_) => 5,
            Self::Requantize(_) => 6,
            Self::ResizeBilinear(_) => 7,
            Self::Tokens(_) => 8,
            Self::LayerNorm(_) => 9,
            Self::Attention(_) => 10,
            Self::WaypointDecoder(_) => 11,
            Self::CopyBox(_) => 12,
            Self::Concat(_) => 13,
            Self::Softmax(_) => 14,
            Self::GatherSum(_) => 15,
            Self::BranchLinear(_) => 16,
            Self::Sigmoid(_) => 17,
            Self::SpatialSoftmax(_) => 18,
        }
    }

    /// The tensor that the step writes.
    pub const fn output(&self) -> TensorId {
        match self {
            Self::Conv2d(s) => s.output,
            Self::Linear(s) => s.output,
            Self::MaxPool(s) => s.output,
            Self::AveragePool(s) => s.output,
            Self::GlobalPool(s) => s.output,
            Self::Add(s) => s.output,
            Self::Requantize(s) => s.output,
            Self::ResizeBilinear(s) => s.output,
            Self::Tokens(s) => s.output,
            Self::LayerNorm(s) => s.output,
            Self::Attention(s) => s.output,
            Self::WaypointDecoder(s) => s.output,
            Self::CopyBox(s) => s.output,
            Self::Concat(s) => s.output,
            Self::Softmax(s) => s.output,
            Self::GatherSum(s) => s.output,
            Self::BranchLinear(s) => s.output,
            Self::Sigmoid(s) => s.output,
            Self::SpatialSoftmax(s) => s.output,
        }
    }

    /// The step's working memory, if any.
    pub const fn scratch(&self) -> Option<TensorId> {
        match self {
            Self::Conv2d(s) => s.scratch,
            Self::Linear(s) => s.scratch,
            Self::Attention(s) => s.scratch,
            Self::WaypointDecoder(s) => s.scratch,
            Self::BranchLinear(s) => s.scratch,
            _ => None,
        }
    }

    /// The packing of a weighted step.
    pub const fn kernel(&self) -> Option<KernelId> {
        match self {
            Self::Conv2d(s) => Some(s.kernel),
            Self::Linear(s) => Some(s.kernel),
            Self::BranchLinear(s) => Some(s.kernel),
            _ => None,
        }
    }

    /// The tensors that the step reads, in operand order (residual last); one may occur twice.
    pub fn reads(&self) -> [Option<TensorId>; 3] {
        match self {
            Self::Conv2d(s) => [Some(s.input), s.rescale.residual_tensor(), None],
            Self::Linear(s) => [Some(s.input), s.rescale.residual_tensor(), None],
            Self::MaxPool(s) => [Some(s.input), None, None],
            Self::AveragePool(s) => [Some(s.input), None, None],
            Self::GlobalPool(s) => [Some(s.first.tensor), s.second.map(|term| term.tensor), None],
            Self::Add(s) => [Some(s.first.tensor), Some(s.second.tensor), None],
            Self::Requantize(s) => [Some(s.input), None, None],
            Self::ResizeBilinear(s) => [Some(s.input.tensor), s.residual.map(|term| term.tensor), None],
            Self::Tokens(s) => [Some(s.first.map), Some(s.second.map), Some(s.velocity)],
            Self::LayerNorm(s) => [Some(s.input), None, None],
            Self::Attention(s) => [Some(s.query), Some(s.key), Some(s.value)],
            Self::WaypointDecoder(s) => [Some(s.hidden), Some(s.goal), None],
            Self::CopyBox(s) => [Some(s.input), None, None],
            Self::Concat(s) => [Some(s.first.tensor), Some(s.second.tensor), None],
            Self::Softmax(s) => [Some(s.input), None, None],
            Self::GatherSum(s) => [Some(s.input), Some(s.indices), None],
            Self::BranchLinear(s) => [Some(s.input), Some(s.command), None],
            Self::Sigmoid(s) => [Some(s.input), None, None],
            Self::SpatialSoftmax(s) => [Some(s.input), None, None],
        }
    }

    /// The operands that the output may overwrite where element types agree (a max pool also needs
    /// [`crate::kernels::plan::max_pool_in_place`]).
    pub fn overwritable(&self) -> [Option<TensorId>; 2] {
        match self {
            Self::Conv2d(s) => [s.rescale.residual_tensor(), None],
            Self::Linear(s) => [s.rescale.residual_tensor(), None],
            Self::MaxPool(s) => [Some(s.input), None],
            Self::Add(s) => [Some(s.first.tensor), Some(s.second.tensor)],
            Self::ResizeBilinear(s) => [s.residual.map(|term| term.tensor), None],
            Self::Attention(s) => [Some(s.query), None],
            Self::Softmax(s) => [Some(s.input), None],
            Self::Sigmoid(s) => [Some(s.input), None],
            _ => [None, None],
        }
    }
}
