//! Statistics of every graph value over the calibration frames, from the f32 reference.
//!
//! Two passes over the frames, in their given order: the first finds the extremes, the second fills a histogram between
//! them. All sums are taken in f64 in a fixed order.

use crate::error::{Error, ErrorCode, Result};
use crate::ir::{Graph, ValueId};
use crate::reference;

const BINS: usize = 4096;

/// Statistics of one value.
#[derive(Clone, Debug, Default)]
pub struct ValueStatistics {
    /// Smallest element.
    pub min: f64,
    /// Largest element.
    pub max: f64,
    /// Elements seen.
    pub count: u64,
    /// Mean per channel.
    pub channel_mean: Vec<f64>,
    /// Equal bins over `[min, max]`; exact zeros are left out, since they quantize without error at any scale.
    pub histogram: Vec<u64>,
}

impl ValueStatistics {
    /// Largest magnitude.
    pub fn max_abs(&self) -> f64 {
        self.max.max(-self.min)
    }

    /// Center of a histogram bin.
    pub fn bin_center(&self, bin: usize) -> f64 {
        self.min + (self.max - self.min) * (bin as f64 + 0.5) / self.histogram.len() as f64
    }

    fn bin_of(&self, x: f64) -> usize {
        let span = self.max - self.min;
        if span <= 0.0 {
            return 0;
        }
        (((x - self.min) / span * BINS as f64) as usize).min(BINS - 1)
    }

    fn see_extremes(&mut self, data: &[f32], channels: usize) {
        if self.count == 0 {
            (self.min, self.max) = (f64::INFINITY, f64::NEG_INFINITY);
            self.channel_mean = vec![0.0; channels];
        }
        self.count += data.len() as u64;
        for position in data.chunks_exact(channels) {
            for (&x, sum) in position.iter().zip(&mut self.channel_mean) {
                let x = f64::from(x);
                self.min = self.min.min(x);
                self.max = self.max.max(x);
                *sum += x;
            }
        }
    }

    fn finish_extremes(&mut self, channels: usize) {
        let per_channel = (self.count as f64 / channels as f64).max(1.0);
        for mean in &mut self.channel_mean {
            *mean /= per_channel;
        }
        self.histogram = vec![0; BINS];
    }

    fn see_distribution(&mut self, data: &[f32]) {
        for &x in data.iter().filter(|x| **x != 0.0) {
            let bin = self.bin_of(f64::from(x));
            self.histogram[bin] += 1;
        }
    }
}

/// Statistics of all values of a graph.
#[derive(Clone, Debug)]
pub struct Statistics {
    values: Vec<ValueStatistics>,
}

impl Statistics {
    /// Statistics of one value.
    pub fn of(&self, id: ValueId) -> &ValueStatistics {
        &self.values[id.0 as usize]
    }
}

/// Runs the reference over the frames: per frame, raw inputs in the order of [`Graph::inputs`].
/// `progress` is called after each frame of each pass with the number done and the total.
///
/// # Errors
/// No frames; a frame that the graph refuses; a value that is not finite (the node is named).
pub fn calibrate(
    graph: &Graph,
    frames: &[Vec<Vec<f32>>],
    mut progress: impl FnMut(usize, usize),
) -> Result<Statistics> {
    if frames.is_empty() {
        return Err(Error::new(ErrorCode::Frames, "calibration", "found no frames, expected at least one")
            .with_help("give --calib a folder of frames or a .safetensors file of raw inputs"));
    }
    let total = 2 * frames.len();
    let mut values = vec![ValueStatistics::default(); graph.values.len()];
    let channels = |id: ValueId| usize::from(graph.value(id).shape.channels);
    for (i, frame) in frames.iter().enumerate() {
        let mut broken = None;
        reference::run(graph, frame, |node, data| {
            if broken.is_none() && data.iter().any(|x| !x.is_finite()) {
                broken = Some(node.name.clone());
            }
            values[node.output.0 as usize].see_extremes(data, channels(node.output));
        })?;
        if let Some(name) = broken {
            return Err(Error::new(
                ErrorCode::Numeric,
                format!("calibration frame {i}, node {name}"),
                "the f32 reference gives a value that is not finite",
            )
            .with_help("look for extreme weights or inputs before this node"));
        }
        progress(i + 1, total);
    }
    for (index, value) in values.iter_mut().enumerate() {
        value.finish_extremes(channels(ValueId(index as u32)));
    }
    for (i, frame) in frames.iter().enumerate() {
        reference::run(graph, frame, |node, data| values[node.output.0 as usize].see_distribution(data))?;
        progress(frames.len() + i + 1, total);
    }
    Ok(Statistics { values })
}

/// Mean per channel of the values that quantized activations stand for: what clipping and rounding leave of each mean.
/// `rounded` gives the nearest representable value; `None` leaves a value's float mean. `progress` is called after each
/// frame with the number done and the total.
///
/// # Errors
/// As [`calibrate`].
pub fn quantized_means(
    graph: &Graph,
    frames: &[Vec<Vec<f32>>],
    statistics: &Statistics,
    rounded: impl Fn(ValueId, f64) -> Option<f64>,
    mut progress: impl FnMut(usize, usize),
) -> Result<Vec<Vec<f64>>> {
    let mut means: Vec<Vec<f64>> = statistics.values.iter().map(|v| v.channel_mean.clone()).collect();
    let is_rounded: Vec<bool> = (0..means.len()).map(|i| rounded(ValueId(i as u32), 0.0).is_some()).collect();
    for (mean, _) in means.iter_mut().zip(&is_rounded).filter(|(_, rounded)| **rounded) {
        mean.fill(0.0);
    }
    for (i, frame) in frames.iter().enumerate() {
        reference::run(graph, frame, |node, data| {
            let index = node.output.0 as usize;
            if !is_rounded[index] {
                return;
            }
            let sums = &mut means[index];
            for position in data.chunks_exact(sums.len()) {
                for (&x, sum) in position.iter().zip(sums.iter_mut()) {
                    *sum += rounded(node.output, f64::from(x)).unwrap_or(0.0);
                }
            }
        })?;
        progress(i + 1, frames.len());
    }
    for (index, mean) in means.iter_mut().enumerate().filter(|(index, _)| is_rounded[*index]) {
        let per_channel = (statistics.values[index].count as f64 / mean.len() as f64).max(1.0);
        mean.iter_mut().for_each(|m| *m /= per_channel);
    }
    Ok(means)
}
