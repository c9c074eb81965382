//! Distribution of a tensor's values in f32 and in integers, in bins that are whole numbers of codes wide.

use model_compiler::qmodel::QTensor;
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

/// Bins of every histogram.
pub const BINS: usize = 64;

/// Counts of one tensor over all traced frames. Values beyond the first or last bin are counted there.
///
/// Edges lie between two codes, so that a bin never holds more codes than its neighbor and the integers show no comb.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
pub struct Histogram {
    /// Lower edge of the first bin, in units of the values.
    pub first: f64,
    /// Width of a bin, in units of the values.
    pub width: f64,
    /// Values of the f32 network per bin; empty where it did not run.
    #[serde(rename = "f32")]
    pub float: Vec<u64>,
    /// Values of the engine's codes per bin.
    pub codes: Vec<u64>,
}

impl Histogram {
    /// An empty histogram over the values of a first frame, with a margin of an eighth for those of later frames.
    pub fn spanning(tensor: &QTensor, float: Option<&[f32]>, engine: &[f32]) -> Self {
        let values = float.into_iter().flatten().chain(engine).filter(|v| v.is_finite());
        let (low, high) = values.fold((0.0_f32, 0.0_f32), |(low, high), &v| (low.min(v), high.max(v)));
        let margin = f64::from(high - low) / 16.0;
        let code = |value: f64| value / tensor.scale;
        let (low, high) = ((code(f64::from(low) - margin)).floor(), (code(f64::from(high) + margin)).ceil());
        let codes_per_bin = ((high - low + 1.0) / BINS as f64).ceil().max(1.0);
        let counts = vec![0; BINS];
        Self {
            first: tensor.scale * (low - 0.5),
            width: tensor.scale * codes_per_bin,
            float: float.map(|_| counts.clone()).unwrap_or_default(),
            codes: counts,
        }
    }

    /// Counts the values of a frame. Not-a-number has no bin.
    pub fn add(&mut self, float: Option<&[f32]>, engine: &[f32]) {
        let (first, width) = (self.first, self.width);
        let count = |bins: &mut [u64], values: &[f32]| {
            for value in values.iter().filter(|v| !v.is_nan()) {
                let bin = ((f64::from(*value) - first) / width).max(0.0) as usize;
                bins[bin.min(BINS - 1)] += 1;
            }
        };
        if let Some(float) = float {
            count(&mut self.float, float);
        }
        count(&mut self.codes, engine);
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use firmware::tensor::{ElementType, Shape};

    fn tensor() -> QTensor {
        QTensor {
            name: "t".into(),
            value: "t".into(),
            shape: Shape::vector(256),
            element: ElementType::I8,
            scale: 0.5,
            zero_point: 0,
            saturation_ppm: None,
        }
    }

    #[test]
    fn every_bin_holds_equally_many_codes() {
        let all: Vec<f32> = (-128..=127).map(|code| 0.5 * code as f32).collect();
        let mut histogram = Histogram::spanning(&tensor(), None, &all);
        histogram.add(None, &all);
        assert_eq!(histogram.codes.iter().sum::<u64>(), 256);
        assert_eq!(histogram.width, 0.5 * 5.0, "256 codes and a margin of 32 in 64 bins");
        let inner: Vec<u64> = histogram.codes.iter().copied().filter(|&n| n > 0).collect();
        assert!(inner[1..inner.len() - 1].iter().all(|&n| n == 5), "{inner:?}");
    }

    #[test]
    fn values_beyond_the_first_frame_are_counted_at_the_ends() {
        let mut histogram = Histogram::spanning(&tensor(), Some(&[-1.0, 1.0]), &[-1.0, 1.0]);
        histogram.add(Some(&[-1e30, 1e30, f32::INFINITY, f32::NAN]), &[0.0]);
        assert_eq!((histogram.float[0], histogram.float[BINS - 1]), (1, 2));
        assert_eq!((histogram.float.iter().sum::<u64>(), histogram.codes.iter().sum::<u64>()), (3, 1));
    }

    #[test]
    fn a_constant_tensor_has_a_histogram() {
        let mut histogram = Histogram::spanning(&tensor(), None, &[0.0; 4]);
        histogram.add(None, &[0.0; 4]);
        assert_eq!(histogram.codes[0], 4);
    }
}
