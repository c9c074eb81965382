//! Named faults for tests: under the feature `fault-injection` one wrong behavior at a time can be switched on, to
//! prove that the byte-for-byte comparison and the validation suite would catch it. Without the feature every query is
//! the constant `false` and disappears. Of the kernels only the portable ones have faults: a query in the inner loop of
//! another backend would keep the compiler from forming vectors.

/// A wrong behavior; the name says what is done wrong.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[repr(u8)]
#[allow(missing_docs, reason = "the name is the documentation")]
pub enum Fault {
    /// Ties round toward minus infinity instead of up.
    TieDown = 1,
    /// Ties round away from zero.
    TieAwayFromZero,
    /// The epilogue rounds twice.
    DoubleRounding,
    /// Convolution padding is code 0 instead of the padding code.
    PaddingZeroPoint,
    /// The clamp is applied before the zero point is added.
    ClampOrder,
    /// The zero point of the residual operand is not subtracted.
    ResidualZeroPoint,
    /// Gates r and z swapped.
    GateOrder,
    /// The reset gate multiplies without the hidden bias.
    ResetBeforeBias,
    /// Interpolation in tanh reads `T[k]` twice instead of `T[k+1]`.
    TanhNextEntry,
    /// Interpolation in exp2 reads `T[k]` twice instead of `T[k+1]`.
    ExpNextEntry,
    /// LayerNorm leaves out ε.
    LayerNormEpsilon,
    /// The last output row of a convolution is not written.
    LastRow,
    /// The last output column of a convolution is not written.
    LastColumn,
    /// The last depth element of a dot product is left out.
    DepthTail,
    /// Scratch is placed 16 bytes too early, over whatever lies there.
    ScratchOverlap,
    /// The multiplier of channel 0 is one too large.
    MultiplierPlusOne,
    /// The weights of output channels 0 and 1 are swapped.
    ChannelsSwapped,
    /// The softmax maximum skips the last key (of attention), channel or pixel.
    SoftmaxMaximum,
    /// Resize uses the weights of its two rows the wrong way round.
    ResizeWeights,
    /// LiDAR tokens are numbered column by column.
    TokenOrder,
    /// Max-pool padding takes part with code 0.
    MaxPoolPadding,
    /// The second map of a global pool is ignored.
    PoolSecondMap,
    /// The goal is not added to (or concatenated with) the waypoint after the first step.
    GoalFirstStepOnly,
    /// A box is copied from one element too far along the innermost axis that has room for it.
    BoxOffset,
    /// The border around a box is code 0 instead of its own.
    BorderZero,
    /// The operands of a concatenation are exchanged.
    ConcatOrder,
    /// Gathered cells are addressed by column and row.
    GatherTransposed,
    /// Commands count from 0: the block behind the chosen one is used.
    BranchFromZero,
    /// Column and row of a spatial softmax's points are exchanged.
    PointAxes,
}

impl Fault {
    /// All faults, for tests and `--fault NAME`.
    pub const ALL: [Fault; 29] = [
        Self::TieDown,
        Self::TieAwayFromZero,
        Self::DoubleRounding,
        Self::PaddingZeroPoint,
        Self::ClampOrder,
        Self::ResidualZeroPoint,
        Self::GateOrder,
        Self::ResetBeforeBias,
        Self::TanhNextEntry,
        Self::ExpNextEntry,
        Self::LayerNormEpsilon,
        Self::LastRow,
        Self::LastColumn,
        Self::DepthTail,
        Self::ScratchOverlap,
        Self::MultiplierPlusOne,
        Self::ChannelsSwapped,
        Self::SoftmaxMaximum,
        Self::ResizeWeights,
        Self::TokenOrder,
        Self::MaxPoolPadding,
        Self::PoolSecondMap,
        Self::GoalFirstStepOnly,
        Self::BoxOffset,
        Self::BorderZero,
        Self::ConcatOrder,
        Self::GatherTransposed,
        Self::BranchFromZero,
        Self::PointAxes,
    ];
}

#[cfg(feature = "fault-injection")]
mod state {
    use core::sync::atomic::{AtomicU8, AtomicU16, Ordering};

    static ACTIVE: AtomicU8 = AtomicU8::new(0);
    static DISABLED_CHECK: AtomicU16 = AtomicU16::new(0);

    /// Switches one fault on, or all off. Process-wide.
    pub fn set(fault: Option<super::Fault>) {
        ACTIVE.store(fault.map_or(0, |f| f as u8), Ordering::SeqCst);
    }

    /// Switches one check of `Image::parse` off by its number (1, 2, …), or none (0). Process-wide.
    pub fn disable_check(number: u16) {
        DISABLED_CHECK.store(number, Ordering::SeqCst);
    }

    pub(crate) fn active(fault: super::Fault) -> bool {
        ACTIVE.load(Ordering::Relaxed) == fault as u8
    }

    pub(crate) fn check_disabled(number: u16) -> bool {
        DISABLED_CHECK.load(Ordering::Relaxed) == number
    }
}

#[cfg(not(feature = "fault-injection"))]
mod state {
    #[inline(always)]
    pub(crate) const fn active(_: super::Fault) -> bool {
        false
    }

    #[inline(always)]
    pub(crate) const fn check_disabled(_: u16) -> bool {
        false
    }
}

#[allow(unused_imports, reason = "each build uses its own subset")]
pub(crate) use state::{active, check_disabled};
#[cfg(feature = "fault-injection")]
pub use state::{disable_check, set};
