//! What each output channel of a weighted step uses of the tensor's one scale.

use model_compiler::qmodel::{QModel, QOp, QRescale, QTensorId};
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

/// Ranges per output channel, over all traced frames. Figures have four significant digits.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize, JsonSchema)]
pub struct Channels {
    /// Scale of the weights.
    pub weight_scale: Vec<f32>,
    /// Lowest value that the engine wrote.
    pub min: Vec<f32>,
    /// Highest value that the engine wrote.
    pub max: Vec<f32>,
}

impl Channels {
    /// The channels of a step without values yet; `None` where it has no weights per channel, or several sets of them.
    ///
    /// The weight scale follows from the multiplier: `M·2^−(n+p) = s_x·s_w/s_o` (numerics, "Requantize").
    pub fn of(model: &QModel, op: &QOp) -> Option<Self> {
        let (QOp::Conv2d { input, output, rescale, .. } | QOp::Linear { input, output, rescale, .. }) = op else {
            return None;
        };
        let weight_scale = weight_scales(rescale, ratio(model, *output, *input));
        let channels = weight_scale.len();
        Some(Self { weight_scale, min: vec![f32::INFINITY; channels], max: vec![f32::NEG_INFINITY; channels] })
    }

    /// Widens the ranges to a frame's values, channel fastest.
    pub fn add(&mut self, values: &[f32]) {
        for position in values.chunks_exact(self.min.len().max(1)) {
            for ((min, max), value) in self.min.iter_mut().zip(&mut self.max).zip(position) {
                *min = min.min(*value);
                *max = max.max(*value);
            }
        }
    }

    /// The same with four significant digits.
    #[must_use]
    pub fn rounded(&self) -> Self {
        let round = |values: &[f32]| values.iter().map(|v| format!("{v:.3e}").parse().unwrap_or(*v)).collect();
        Self { weight_scale: round(&self.weight_scale), min: round(&self.min), max: round(&self.max) }
    }

    /// Difference of highest and lowest value per channel.
    pub fn widths(&self) -> Vec<f32> {
        self.min.iter().zip(&self.max).map(|(min, max)| max - min).collect()
    }

    /// Bits of the type that the median channel leaves unused: `log2(widest / median)` of the output ranges. `None`
    /// where the median channel is constant.
    pub fn unused_bits(&self) -> Option<f64> {
        spread(self.widths())
    }

    /// `log2(largest / median)` of the weight scales.
    pub fn weight_spread_bits(&self) -> Option<f64> {
        spread(self.weight_scale.clone())
    }
}

fn spread(mut values: Vec<f32>) -> Option<f64> {
    values.sort_by(f32::total_cmp);
    let (median, largest) = (*values.get(values.len() / 2)?, *values.last()?);
    (median > 0.0 && largest.is_finite()).then(|| f64::from(largest / median).log2())
}

fn ratio(model: &QModel, output: QTensorId, input: QTensorId) -> f64 {
    model.tensor(output).scale / model.tensor(input).scale
}

fn weight_scales(rescale: &QRescale, ratio: f64) -> Vec<f32> {
    let factor = |(&multiplier, &shift): (&i32, &u8)| {
        let shift = i32::from(shift) + i32::from(rescale.pre_shift);
        (f64::from(multiplier) * (-f64::from(shift)).exp2() * ratio) as f32
    };
    rescale.multipliers.iter().zip(&rescale.shifts).map(factor).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    fn channels(ranges: &[(f32, f32)]) -> Channels {
        let (min, max) = ranges.iter().copied().unzip();
        Channels { weight_scale: vec![1.0; ranges.len()], min, max }
    }

    #[test]
    fn ranges_widen_channel_by_channel() {
        let mut all = channels(&[(f32::INFINITY, f32::NEG_INFINITY); 2]);
        all.add(&[1.0, -1.0, 3.0, 0.5]);
        all.add(&[2.0, 7.0]);
        assert_eq!((all.min, all.max), (vec![1.0, -1.0], vec![3.0, 7.0]));
    }

    #[test]
    fn the_spread_is_told_in_bits() {
        assert_eq!(channels(&[(0.0, 1.0), (0.0, 1.0), (-4.0, 4.0)]).unused_bits(), Some(3.0));
        assert_eq!(channels(&[(0.0, 0.0), (0.0, 0.0), (0.0, 8.0)]).unused_bits(), None);
        assert_eq!(channels(&[]).unused_bits(), None);
        assert_eq!(channels(&[(0.0, 1.0)]).weight_spread_bits(), Some(0.0));
    }

    #[test]
    fn the_weight_scale_is_recovered_from_the_multiplier() {
        use firmware::program::Clamp;
        use model_compiler::qmodel::QResidual;
        let rescale = QRescale {
            pre_shift: 2,
            bias: vec![0],
            multipliers: vec![1 << 23],
            shifts: vec![30],
            zero_point: 0,
            clamp: Clamp { min: -128, max: 127 },
            residual: QResidual::None,
        };
        // s_x·s_w/s_o = 2^23·2^−32; s_o/s_x = 4.
        assert_eq!(weight_scales(&rescale, 4.0), [1.0 / 128.0]);
    }
}
