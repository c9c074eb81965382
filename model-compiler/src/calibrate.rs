//! Statistics of every graph value over the calibration frames, from the f32 reference.
//!
//! Two passes over the frames: the first finds the extremes, the second fills a histogram between them. A few frames
//! run side by side; sums are taken in f64 over each frame, then over the frames in their order, so the number of cores
//! changes nothing.

use crate::error::{Error, ErrorCode, Result};
use crate::ir::{Graph, ValueId};
use crate::reference::{self, Branches};
use rayon::prelude::*;

const BINS: usize = 4096;

/// Frames in memory at once. A single large one keeps all cores busy; small ones need company.
const SIDE_BY_SIDE: usize = 8;

/// Statistics of one value.
#[derive(Clone, Debug, Default)]
pub struct ValueStatistics {
    /// Smallest element.
    pub min: f64,
    /// Largest element.
    pub max: f64,
    /// Elements seen.
    pub count: u64,
    /// Mean per channel; of a value behind a command for one branch after the other.
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

    /// Adds one frame's values; `form` is the branch, 0 where nothing is selected.
    fn see_extremes(&mut self, data: &[f32], channels: usize, form: usize, forms: usize) {
        if self.count == 0 {
            (self.min, self.max) = (f64::INFINITY, f64::NEG_INFINITY);
            self.channel_mean = vec![0.0; forms * channels];
        }
        self.count += data.len() as u64;
        for position in data.chunks_exact(channels) {
            for (&x, sum) in position.iter().zip(&mut self.channel_mean[form * channels..]) {
                let x = f64::from(x);
                self.min = self.min.min(x);
                self.max = self.max.max(x);
                *sum += x;
            }
        }
    }

    fn add_extremes(&mut self, other: &Self) {
        if self.count == 0 {
            self.clone_from(other);
        } else if other.count > 0 {
            self.count += other.count;
            self.min = self.min.min(other.min);
            self.max = self.max.max(other.max);
            add(&mut self.channel_mean, &other.channel_mean);
        }
    }

    fn finish_extremes(&mut self) {
        let per_channel = (self.count as f64 / self.channel_mean.len() as f64).max(1.0);
        for mean in &mut self.channel_mean {
            *mean /= per_channel;
        }
        self.histogram = vec![0; BINS];
    }

    fn distribution(&self, data: &[f32]) -> Vec<u32> {
        let mut histogram = vec![0; BINS];
        for &x in data.iter().filter(|x| **x != 0.0) {
            histogram[self.bin_of(f64::from(x))] += 1;
        }
        histogram
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

/// Runs the reference over the frames: per frame, raw inputs in the order of [`Graph::inputs`]. What a command selects
/// is run for every command, whichever the frame holds: a branch that no frame selects is calibrated like any other.
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
    let branches = Branches::of(graph);
    let extremes = |i: usize, frame: &Vec<Vec<f32>>| {
        let mut of_frame = vec![ValueStatistics::default(); graph.values.len()];
        let mut broken = None;
        reference::run_branches(graph, &branches, frame, |id, branch, data| {
            if broken.is_none() && data.iter().any(|x| !x.is_finite()) {
                broken = Some(graph.value(id).name.clone());
            }
            of_frame[id.0 as usize].see_extremes(data, channels(id), branch, branches.forms(id));
        })?;
        match broken {
            None => Ok(of_frame),
            Some(name) => Err(Error::new(
                ErrorCode::Numeric,
                format!("calibration frame {i}, node {name}"),
                "the f32 reference gives a value that is not finite",
            )
            .with_help("look for extreme weights or inputs before this node")),
        }
    };
    in_order(frames, extremes, |done, of_frame| {
        values.iter_mut().zip(&of_frame).for_each(|(value, of_frame)| value.add_extremes(of_frame));
        progress(done, total);
    })?;
    values.iter_mut().for_each(ValueStatistics::finish_extremes);
    let mut histograms = vec![vec![0; BINS]; values.len()];
    let distributions = |_: usize, frame: &Vec<Vec<f32>>| {
        let mut of_frame = Vec::with_capacity(values.len());
        reference::run_branches(graph, &branches, frame, |id, _, data| {
            let index = id.0 as usize;
            of_frame.push((index, values[index].distribution(data)));
        })?;
        Ok(of_frame)
    };
    in_order(frames, distributions, |done, of_frame| {
        for (index, histogram) in of_frame {
            histograms[index].iter_mut().zip(histogram).for_each(|(sum, n)| *sum += u64::from(n));
        }
        progress(frames.len() + done, total);
    })?;
    values.iter_mut().zip(histograms).for_each(|(value, histogram)| value.histogram = histogram);
    Ok(Statistics { values })
}

/// Runs frames side by side and hands over their results in order, each with the number of those done. The first
/// frame that fails ends it.
fn in_order<T: Send>(
    frames: &[Vec<Vec<f32>>],
    run: impl Fn(usize, &Vec<Vec<f32>>) -> Result<T> + Sync,
    mut take: impl FnMut(usize, T),
) -> Result<()> {
    for (chunk, together) in frames.chunks(SIDE_BY_SIDE).enumerate() {
        let first = chunk * SIDE_BY_SIDE;
        let results: Vec<Result<T>> = together.par_iter().enumerate().map(|(i, frame)| run(first + i, frame)).collect();
        for (i, result) in results.into_iter().enumerate() {
            take(first + i + 1, result?);
        }
    }
    Ok(())
}

fn add(sums: &mut [f64], others: &[f64]) {
    sums.iter_mut().zip(others).for_each(|(sum, other)| *sum += other);
}

/// Mean per channel, and per branch behind a command, of the values that quantized activations stand for: what clipping
/// and rounding leave of each mean.
/// `rounded` gives the nearest representable value; `None` leaves a value's float mean. `progress` is called after each
/// frame with the number done and the total.
///
/// # Errors
/// As [`calibrate`].
pub fn quantized_means(
    graph: &Graph,
    frames: &[Vec<Vec<f32>>],
    statistics: &Statistics,
    rounded: impl Fn(ValueId, f64) -> Option<f64> + Sync,
    mut progress: impl FnMut(usize, usize),
) -> Result<Vec<Vec<f64>>> {
    let mut means: Vec<Vec<f64>> = statistics.values.iter().map(|v| v.channel_mean.clone()).collect();
    let is_rounded: Vec<bool> = (0..means.len()).map(|i| rounded(ValueId(i as u32), 0.0).is_some()).collect();
    for (mean, _) in means.iter_mut().zip(&is_rounded).filter(|(_, rounded)| **rounded) {
        mean.fill(0.0);
    }
    let branches = Branches::of(graph);
    let sums = |_: usize, frame: &Vec<Vec<f32>>| {
        let mut of_frame = Vec::new();
        reference::run_branches(graph, &branches, frame, |id, branch, data| {
            let index = id.0 as usize;
            if !is_rounded[index] {
                return;
            }
            let mut sums = vec![0.0; usize::from(graph.value(id).shape.channels)];
            for position in data.chunks_exact(sums.len()) {
                for (&x, sum) in position.iter().zip(sums.iter_mut()) {
                    *sum += rounded(id, f64::from(x)).unwrap_or(0.0);
                }
            }
            of_frame.push((index, branch * sums.len(), sums));
        })?;
        Ok(of_frame)
    };
    in_order(frames, sums, |done, of_frame| {
        of_frame.iter().for_each(|(index, first, sums)| add(&mut means[*index][*first..], sums));
        progress(done, frames.len());
    })?;
    for (index, mean) in means.iter_mut().enumerate().filter(|(index, _)| is_rounded[*index]) {
        let per_channel = (statistics.values[index].count as f64 / mean.len() as f64).max(1.0);
        mean.iter_mut().for_each(|m| *m /= per_channel);
    }
    Ok(means)
}

/// The means of one branch, or, where none is selected, over all of them; `means` are per channel or per branch and
/// channel.
pub fn branch_means(means: &[f64], channels: usize, branch: Option<usize>) -> Vec<f64> {
    let forms = means.len() / channels;
    match branch {
        Some(branch) => means[branch.min(forms - 1) * channels..][..channels].to_vec(),
        None => (0..channels).map(|c| means[c..].iter().step_by(channels).sum::<f64>() / forms as f64).collect(),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::ir::{Clip, InputKind, Op, Shape};

    /// `relu(x)`, `relu(x) + relu(x)` over two pixels of one channel.
    fn graph() -> Graph {
        let mut graph = Graph::default();
        let x = graph.push_input("x", InputKind::Image, Shape::map(1, 2, 1));
        let relu = graph.push("relu", Op::Clip(Clip::RELU), &[x]).unwrap();
        let sum = graph.push("sum", Op::Add { clip: Clip::NONE }, &[relu, relu]).unwrap();
        graph.outputs = vec![sum];
        graph
    }

    /// Values whose sums are not exact.
    fn frames(count: usize) -> Vec<Vec<Vec<f32>>> {
        (0..count).map(|i| vec![vec![0.1 + i as f32 / 3.0, -1.0 / (i + 1) as f32]]).collect()
    }

    #[test]
    fn statistics_do_not_depend_on_the_number_of_threads() {
        let calibrated = |threads| {
            let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
            let mut done = Vec::new();
            let statistics = pool.install(|| calibrate(&graph(), &frames(21), |d, t| done.push((d, t)))).unwrap();
            assert_eq!(done, (1..=42).map(|d| (d, 42)).collect::<Vec<_>>());
            statistics.values
        };
        let (one, four) = (calibrated(1), calibrated(4));
        for (a, b) in one.iter().zip(&four) {
            assert_eq!((a.min, a.max, a.count, &a.channel_mean), (b.min, b.max, b.count, &b.channel_mean));
            assert_eq!(a.histogram, b.histogram);
        }
        let relu = &one[1];
        assert_eq!((relu.min, relu.max, relu.count), (0.0, f64::from(0.1 + 20.0 / 3.0_f32), 42));
        assert_eq!(relu.histogram.iter().sum::<u64>(), 21, "zeros are left out");
    }

    #[test]
    fn the_first_broken_frame_is_named() {
        let mut frames = frames(20);
        frames[18][0][0] = f32::NAN;
        frames[11][0][1] = f32::INFINITY;
        let error = calibrate(&graph(), &frames, |_, _| {}).unwrap_err();
        assert_eq!(error.location, "calibration frame 11, node x");
    }
}
