//! From sums of a weighted step to output codes: bias, pre-shift, multiplier, second term, saturation.

use super::arithmetic::{Exactness, RoundingShift, Saturation, to_f64};
use super::operands::{Operands, expect};
use crate::error::Result;
use crate::qmodel::{QRescale, QResidual, QTensorId};

/// A [`QRescale`] with its operands resolved; arrays are per output channel.
pub(super) struct Epilogue<'a> {
    bias: Vec<f64>,
    pre_shift: RoundingShift,
    multipliers: Vec<f64>,
    shifts: Vec<RoundingShift>,
    output: Saturation,
    second: Second<'a>,
}

/// The second term: codes of the whole residual tensor.
enum Second<'a> {
    None,
    Scaled { codes: &'a [f64], zero_point: f64, multipliers: Vec<f64> },
    Stream { codes: &'a [f64] },
}

impl<'a> Epilogue<'a> {
    pub(super) fn new(rescale: &QRescale, output: QTensorId, operands: &Operands<'_, 'a>) -> Result<Self> {
        let shape = operands.shape(output)?;
        let channels = usize::from(shape.channels);
        expect("biases", rescale.bias.len(), channels)?;
        expect("multipliers", rescale.multipliers.len(), channels)?;
        expect("shifts", rescale.shifts.len(), channels)?;
        let second = match &rescale.residual {
            QResidual::None => Second::None,
            QResidual::Scaled { tensor, zero_point, multipliers } => {
                expect("multipliers of the residual", multipliers.len(), channels)?;
                let codes = operands.codes_shaped(*tensor, shape)?;
                Second::Scaled { codes, zero_point: f64::from(*zero_point), multipliers: to_f64(multipliers) }
            }
            QResidual::Stream { tensor } => Second::Stream { codes: operands.codes_shaped(*tensor, shape)? },
        };
        Ok(Self {
            bias: to_f64(&rescale.bias),
            pre_shift: RoundingShift::new(u32::from(rescale.pre_shift)),
            multipliers: to_f64(&rescale.multipliers),
            shifts: rescale.shifts.iter().map(|&n| RoundingShift::new(u32::from(n))).collect(),
            output: Saturation::new(rescale.zero_point, rescale.clamp),
            second,
        })
    }

    /// Replaces sums `Σ w·q` (whole positions, from `first_position` on) by output codes.
    pub(super) fn apply(&self, first_position: usize, sums: &mut [f64]) -> Result<()> {
        let channels = self.bias.len();
        let mut exact = Exactness::default();
        for (row, position) in sums.chunks_exact_mut(channels).zip(first_position..) {
            for (channel, value) in row.iter_mut().enumerate() {
                *value = self.code(channel, position * channels + channel, *value, &mut exact);
            }
        }
        exact.finish()
    }

    fn code(&self, channel: usize, element: usize, sum: f64, exact: &mut Exactness) -> f64 {
        let t = self.pre_shift.round(sum + self.bias[channel], exact);
        let product = exact.watch(t * self.multipliers[channel]);
        let shift = self.shifts[channel];
        match &self.second {
            Second::None => self.output.code(shift.round(product, exact)),
            Second::Scaled { codes, zero_point, multipliers } => {
                let second = exact.watch((codes[element] - zero_point) * multipliers[channel]);
                self.output.code(shift.round(product + second, exact))
            }
            Second::Stream { codes } => self.output.limit(codes[element] + shift.round(product, exact)),
        }
    }
}
