//! The third level of proof: what needs the constants, or is a second opinion on `parse`.
//!
//! * No two buffers share a byte of a memory region while both are live, judged from the tensor table alone.
//! * No accumulator can leave its type, whatever the input codes and in whatever order a backend sums: per output
//!   channel `|b'| + 383·Σ|w|` (8-bit input; some backends shift codes by 128) or `|b'| + 32768·Σ|w|` (16-bit), plus the
//!   half of the first rounding.
//! * Multipliers, shifts and table entries have the values that the arithmetic was proved for.
//! * Packed weights say the same to every kernel: compensations fit them, and what fills them up is zero.

use super::{Image, TensorRecord};
use crate::kernels::k4n16::{COMPENSATION_FACTOR, Packed};
use crate::program::{ConstRange, Conv2d, KernelId, Rescale, Residual, Step};
use crate::tensor::{ElementType, TensorId, index};
use core::fmt;
use core::ops::RangeInclusive;

/// What an audit saw.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub struct Audit {
    /// Output channels whose accumulator was bounded.
    pub channels: u32,
    /// Bits of the largest bound among 32-bit accumulators, sign excluded; at most 31.
    pub accumulator_bits: u32,
}

/// What an audit refuses.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub enum AuditError {
    /// Two buffers share memory while both are live.
    Overlap {
        /// One tensor.
        first: u16,
        /// The other.
        second: u16,
    },
    /// An accumulator can leave 32 bits.
    Accumulator {
        /// Position of the step.
        step: u16,
        /// Output channel.
        channel: u32,
        /// Largest magnitude.
        bound: u64,
    },
    /// A constant is out of the range that its formula allows.
    Constant {
        /// Position of the step.
        step: u16,
        /// Which array.
        array: Array,
        /// Element of the array.
        element: u32,
        /// Its value.
        found: i64,
    },
    /// A constant range cannot be read: the image changed after `parse`.
    Unreadable {
        /// Position of the step.
        step: u16,
    },
}

/// An array of constants, for messages.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
#[allow(missing_docs, reason = "named like the fields of the steps")]
pub enum Array {
    Weights,
    Multipliers,
    ResidualMultipliers,
    Shifts,
    Rows,
    Columns,
    Gains,
    Offsets,
    ExpTable,
    TanhTable,
    WeightPadding,
    Compensations,
}

impl fmt::Display for AuditError {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Overlap { first, second } => {
                write!(f, "tensors {first} and {second} share memory while both are live")
            }
            Self::Accumulator { step, channel, bound } => {
                write!(f, "step {step}, channel {channel}: the accumulator can reach {bound}, more than 32 bits hold")
            }
            Self::Constant { step, array, element, found } => {
                write!(f, "step {step}: {array:?}[{element}] = {found} is out of range")
            }
            Self::Unreadable { step } => write!(f, "step {step}: the constants cannot be read"),
        }
    }
}

impl core::error::Error for AuditError {}

/// Audits a parsed image. Reads all constants once; time grows with their size and the square of the tensor count.
///
/// # Errors
/// The first thing that is wrong.
pub fn audit(image: &Image<'_>) -> Result<Audit, AuditError> {
    audit_memory(image)?;
    let mut result = Audit::default();
    for position in 0..image.step_count() {
        let auditor = Auditor { image, position };
        let step = image.step(position).ok_or(AuditError::Unreadable { step: position })?;
        auditor.step(&step, &mut result)?;
    }
    Ok(result)
}

fn audit_memory(image: &Image<'_>) -> Result<(), AuditError> {
    for first in 0..image.tensor_count() {
        for second in 0..first {
            let pair = image.tensor(TensorId(first)).zip(image.tensor(TensorId(second)));
            let (a, b) = pair.ok_or(AuditError::Unreadable { step: 0 })?;
            let live = a.first_step <= b.last_step && b.first_step <= a.last_step;
            let taken_over = takes_over(&a, second, &b) || takes_over(&b, first, &a);
            if live && a.overlaps(&b) && !taken_over {
                return Err(AuditError::Overlap { first: second, second: first });
            }
        }
    }
    Ok(())
}

/// `a` takes over the memory of `b` in the step that reads `b` for the last time.
fn takes_over(a: &TensorRecord, b_id: u16, b: &TensorRecord) -> bool {
    a.in_place_of == Some(TensorId(b_id)) && a.first_step == b.last_step
}

/// Packed weights of a step under audit.
struct Weights<'a> {
    kernel: KernelId,
    codes: &'a [i8],
    /// Per group.
    outputs: u16,
    depth: usize,
    /// Largest magnitude of an input code, in any backend's form.
    largest_code: u64,
    wide: bool,
}

/// One step under audit.
struct Auditor<'i, 'a> {
    image: &'i Image<'a>,
    position: u16,
}

impl<'a> Auditor<'_, 'a> {
    fn step(&self, step: &Step, result: &mut Audit) -> Result<(), AuditError> {
        match step {
            Step::Conv2d(step) => self.weighted(&self.conv2d(step)?, &step.rescale, result),
            Step::Linear(step) => {
                let weights = self.linear(step.kernel, step.weights, [step.input, step.output], step.wide)?;
                self.weighted(&weights, &step.rescale, result)
            }
            Step::BranchLinear(step) => {
                let weights = self.linear(step.kernel, step.weights, [step.input, step.output], step.wide)?;
                self.weighted(&weights, &step.rescale, result)
            }
            Step::ResizeBilinear(step) => {
                let input = self.record(step.input.tensor)?.shape;
                let weight = 1_u16.checked_shl(step.weight_bits.into()).unwrap_or_default();
                self.interpolation(Array::Rows, step.rows, input.height, weight)?;
                self.interpolation(Array::Columns, step.columns, input.width, weight)
            }
            Step::LayerNorm(step) => {
                self.within::<i32>(Array::Gains, step.gains, -0xFF_FFFF..=0xFF_FFFF)?;
                self.within::<i64>(Array::Offsets, step.offsets, -(1 << 51)..=1 << 51)
            }
            Step::Attention(step) => self.within::<i16>(Array::ExpTable, step.exp_table, 0..=i16::MAX.into()),
            Step::Softmax(step) => self.within::<i16>(Array::ExpTable, step.exp_table, 0..=i16::MAX.into()),
            Step::Sigmoid(step) => self.within::<i16>(Array::TanhTable, step.tanh_table, 0..=i16::MAX.into()),
            Step::SpatialSoftmax(step) => self.within::<i16>(Array::ExpTable, step.exp_table, 0..=i16::MAX.into()),
            Step::WaypointDecoder(step) => {
                self.within::<u8>(Array::Shifts, step.shifts, 0..=30)?;
                self.within::<i16>(Array::TanhTable, step.tanh_table, 0..=i16::MAX.into())
            }
            _ => Ok(()),
        }
    }

    fn conv2d(&self, step: &Conv2d) -> Result<Weights<'a>, AuditError> {
        let (input, output) = (self.record(step.input)?.shape, self.record(step.output)?.shape);
        let taps = usize::from(step.window.kernel_h).saturating_mul(step.window.kernel_w.into());
        let of_group = |channels: u16| channels.checked_div(step.groups).unwrap_or_default();
        Ok(Weights {
            kernel: step.kernel,
            codes: self.read(step.weights)?,
            outputs: of_group(output.channels),
            depth: taps.saturating_mul(of_group(input.channels).into()),
            largest_code: 383,
            wide: false,
        })
    }

    /// One block of weights, or several that follow each other like groups.
    fn linear(
        &self,
        kernel: KernelId,
        weights: ConstRange,
        [input, output]: [TensorId; 2],
        wide: bool,
    ) -> Result<Weights<'a>, AuditError> {
        let input = self.record(input)?;
        Ok(Weights {
            kernel,
            codes: self.read(weights)?,
            outputs: self.record(output)?.shape.channels,
            depth: input.shape.channels.into(),
            largest_code: if input.element == ElementType::I16 { 32768 } else { 383 },
            wide,
        })
    }

    /// Accumulator bounds, weights and epilogue of a weighted step.
    fn weighted(&self, weights: &Weights<'_>, rescale: &Rescale, result: &mut Audit) -> Result<(), AuditError> {
        self.epilogue(rescale)?;
        let bias: &[i32] = self.read(rescale.bias)?;
        let half = 1_u64.checked_shl(rescale.pre_shift.into()).unwrap_or_default() >> 1;
        for (channel, bias) in (0_u32..).zip(bias) {
            let products = self.magnitude(weights, channel)?.saturating_mul(weights.largest_code);
            let bound = products.saturating_add(bias.unsigned_abs().into()).saturating_add(half);
            result.channels = result.channels.saturating_add(1);
            if weights.wide {
                continue;
            }
            if bound > u64::from(i32::MAX.unsigned_abs()) {
                return Err(AuditError::Accumulator { step: self.position, channel, bound });
            }
            result.accumulator_bits = result.accumulator_bits.max(u64::BITS.saturating_sub(bound.leading_zeros()));
        }
        Ok(())
    }

    /// `Σ|w|` of an output channel.
    fn magnitude(&self, weights: &Weights<'_>, channel: u32) -> Result<u64, AuditError> {
        let start = u64::from(channel).saturating_mul(weights.depth as u64);
        let refuse = |array, k: usize, found: i64| {
            let element = u32::try_from(start.saturating_add(k as u64)).unwrap_or(u32::MAX);
            AuditError::Constant { step: self.position, array, element, found }
        };
        let (mut sum, mut magnitude) = (0_i64, 0_u64);
        let mut add = |(k, weight): (usize, i8)| {
            if weight == i8::MIN {
                return Err(refuse(Array::Weights, k, weight.into()));
            }
            if k >= weights.depth && weight != 0 {
                return Err(refuse(Array::WeightPadding, k, weight.into()));
            }
            sum = sum.saturating_add(weight.into());
            magnitude = magnitude.saturating_add(weight.unsigned_abs().into());
            Ok(())
        };
        let unreadable = AuditError::Unreadable { step: self.position };
        let row = index(channel);
        match weights.kernel {
            KernelId::Direct => {
                let first = row.saturating_mul(weights.depth);
                let codes = weights.codes.get(first..first.saturating_add(weights.depth)).ok_or(unreadable)?;
                codes.iter().copied().enumerate().try_for_each(&mut add)?;
            }
            KernelId::K4N16 => {
                let packed = Packed::new(weights.codes, weights.outputs, weights.depth);
                let (codes, compensation) = packed.padded(row).zip(packed.compensation(row)).ok_or(unreadable)?;
                codes.enumerate().try_for_each(&mut add)?;
                if i64::from(compensation) != sum.saturating_mul(COMPENSATION_FACTOR.into()) {
                    let found = compensation.into();
                    return Err(AuditError::Constant {
                        step: self.position,
                        array: Array::Compensations,
                        element: channel,
                        found,
                    });
                }
            }
        }
        Ok(magnitude)
    }

    fn epilogue(&self, rescale: &Rescale) -> Result<(), AuditError> {
        match rescale.residual {
            Residual::None | Residual::Stream { .. } => {
                self.within::<i32>(Array::Multipliers, rescale.multipliers, 1 << 23..=(1 << 24) - 1)?;
                self.within::<u8>(Array::Shifts, rescale.shifts, 1..=52)
            }
            Residual::Scaled { multipliers, .. } => {
                self.within::<i32>(Array::Multipliers, rescale.multipliers, 0..=i32::MAX.into())?;
                self.within::<i32>(Array::ResidualMultipliers, multipliers, 0..=i32::MAX.into())?;
                self.within::<u8>(Array::Shifts, rescale.shifts, 0..=40)
            }
        }
    }

    /// Pairs `(i0, w1)`: a row of the input, a weight of at most one.
    fn interpolation(&self, array: Array, range: ConstRange, size: u16, one: u16) -> Result<(), AuditError> {
        let pairs: &[[u16; 2]] = self.read(range)?;
        for (element, [source, weight]) in (0_u32..).zip(pairs) {
            if *source >= size || *weight > one {
                let found = if *source >= size { *source } else { *weight }.into();
                return Err(AuditError::Constant { step: self.position, array, element, found });
            }
        }
        Ok(())
    }

    fn within<T: bytemuck::Pod + Into<i64>>(
        &self,
        array: Array,
        range: ConstRange,
        allowed: RangeInclusive<i64>,
    ) -> Result<(), AuditError> {
        let elements: &[T] = self.read(range)?;
        let stray = (0_u32..).zip(elements).find(|(_, value)| !allowed.contains(&(**value).into()));
        stray.map_or(Ok(()), |(element, value)| {
            Err(AuditError::Constant { step: self.position, array, element, found: (*value).into() })
        })
    }

    fn read<T: bytemuck::Pod>(&self, range: ConstRange) -> Result<&'a [T], AuditError> {
        self.image.constants(range).ok_or(AuditError::Unreadable { step: self.position })
    }

    fn record(&self, id: TensorId) -> Result<TensorRecord, AuditError> {
        self.image.tensor(id).ok_or(AuditError::Unreadable { step: self.position })
    }
}
