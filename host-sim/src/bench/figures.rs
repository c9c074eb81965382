//! What a measurement found: distributions of the whole, medians of the steps, and what follows from them.

use super::clock::Elapsed;
use crate::run::ModelInfo;
use model_compiler::error::Error;
use serde::Serialize;
use std::time::Duration;

/// Result of a measurement. In JSON a figure that the system or the choice of backends does not give is `null`.
#[derive(Clone, Debug, Serialize)]
pub struct BenchReport {
    /// Version of this structure.
    pub schema: u32,
    /// The image.
    pub model: ModelInfo,
    /// Inferences per backend: as many for the whole, and as many again for the steps.
    pub rounds: u32,
    /// Size of the image.
    pub image_bytes: u64,
    /// Size of the arena in all memory regions together.
    pub arena_bytes: u64,
    /// Most physical memory that this process had at once; `None` where the system does not tell.
    pub peak_memory_bytes: Option<u64>,
    /// Multiply-accumulates of one inference.
    pub macs: u64,
    /// Whole inferences, by backend.
    pub backends: Vec<Whole>,
    /// Sums over the steps of one operator, in the order in which operators first occur.
    pub operators: Vec<OperatorTotal>,
    /// Every step, in the order of execution.
    pub steps: Vec<StepTime>,
    /// Why steps bear the names of their operators, where a record is there but does not serve.
    #[serde(skip)]
    pub unnamed: Option<Error>,
}

/// Whole inferences on one backend.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Whole {
    /// Name of the backend.
    pub backend: &'static str,
    /// Time of the thread.
    pub cpu_ms: Option<Distribution>,
    /// Time that passed.
    pub wall_ms: Distribution,
    /// Of the median.
    #[serde(flatten)]
    pub rate: Rate,
}

/// All steps of one operator.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct OperatorTotal {
    /// Operator.
    pub op: &'static str,
    /// Number of steps.
    pub steps: usize,
    /// Multiply-accumulates; `None` for an operator without any.
    pub macs: Option<u64>,
    /// By backend.
    pub times: Vec<Share>,
}

/// One step.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct StepTime {
    /// Position in the program.
    pub position: usize,
    /// Name in the record, else the operator's.
    pub step: String,
    /// Operator.
    pub op: &'static str,
    /// Height, width, channels of the output.
    pub shape: [u16; 3],
    /// Multiply-accumulates; `None` for an operator without any.
    pub macs: Option<u64>,
    /// By backend.
    pub times: Vec<Share>,
}

/// Time of a step or an operator on one backend.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Share {
    /// Name of the backend.
    pub backend: &'static str,
    /// Median time of the thread, or sum of the steps' medians; wall time where the system does not tell the thread's.
    pub ms: f64,
    /// Of the sum over all steps, 0 to 1.
    pub share: f64,
    /// What that amounts to.
    #[serde(flatten)]
    pub rate: Rate,
}

/// A time in relation to the work and to the portable kernels.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize)]
pub struct Rate {
    /// 10⁹ multiply-accumulates per second.
    pub gmacs_per_s: Option<f64>,
    /// Time of the portable kernels divided by this one; `None` where they were not measured.
    pub speedup: Option<f64>,
}

/// Order statistics of a time, ms.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize)]
pub struct Distribution {
    /// Half of the samples are below.
    pub median: f64,
    /// Smallest sample.
    pub min: f64,
    /// A tenth of the samples is below.
    pub p10: f64,
    /// Nine tenths of the samples are below.
    pub p90: f64,
}

impl Rate {
    /// Of a time in ms, given that of the portable kernels.
    pub fn new(ms: f64, macs: Option<u64>, portable_ms: Option<f64>) -> Self {
        let positive = ms > 0.0;
        Self {
            gmacs_per_s: macs.filter(|_| positive).map(|macs| macs as f64 / ms / 1e6),
            speedup: portable_ms.filter(|_| positive).map(|portable| portable / ms),
        }
    }
}

impl Distribution {
    /// Of samples in any order; all zero for none.
    pub fn of(samples: impl IntoIterator<Item = Duration>) -> Self {
        let mut sorted: Vec<f64> = samples.into_iter().map(milliseconds).collect();
        sorted.sort_by(f64::total_cmp);
        let quantile = |q| quantile(&sorted, q);
        Self { median: quantile(0.5), min: quantile(0.0), p10: quantile(0.1), p90: quantile(0.9) }
    }
}

/// Linear between the two nearest ranks; zero for no samples.
fn quantile(sorted: &[f64], q: f64) -> f64 {
    let rank = sorted.len().saturating_sub(1) as f64 * q;
    let at = |rank: f64| sorted.get(rank as usize).copied().unwrap_or(0.0);
    at(rank.floor()) + (at(rank.ceil()) - at(rank.floor())) * rank.fract()
}

fn milliseconds(duration: Duration) -> f64 {
    duration.as_secs_f64() * 1e3
}

impl Whole {
    /// Sums up whole inferences; `portable` is the result of the portable kernels, if they were measured.
    pub fn new(backend: &'static str, samples: &[Elapsed], macs: u64, portable: Option<&Self>) -> Self {
        let cpu: Option<Vec<Duration>> = samples.iter().map(|sample| sample.cpu).collect();
        let cpu_ms = cpu.map(Distribution::of);
        let wall_ms = Distribution::of(samples.iter().map(|sample| sample.wall));
        let median = cpu_ms.unwrap_or(wall_ms).median;
        let rate = Rate::new(median, Some(macs), portable.map(Self::median_ms));
        Self { backend, cpu_ms, wall_ms, rate }
    }

    /// Median time of the thread, or of the wall where the system tells no other.
    pub fn median_ms(&self) -> f64 {
        self.cpu_ms.unwrap_or(self.wall_ms).median
    }
}

/// The shares of one step or operator: `ms` and `total_ms` by backend, `portable` the index of the portable one.
pub fn shares(
    backends: &[&'static str],
    ms: &[f64],
    total_ms: &[f64],
    macs: Option<u64>,
    portable: Option<usize>,
) -> Vec<Share> {
    let portable_ms = portable.map(|index| ms[index]);
    let share = |((&backend, &ms), &total): ((&&'static str, &f64), &f64)| Share {
        backend,
        ms,
        share: if total > 0.0 { ms / total } else { 0.0 },
        rate: Rate::new(ms, macs, portable_ms),
    };
    backends.iter().zip(ms).zip(total_ms).map(share).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    fn elapsed(wall: u64, cpu: Option<u64>) -> Elapsed {
        Elapsed { wall: Duration::from_millis(wall), cpu: cpu.map(Duration::from_millis) }
    }

    #[test]
    fn a_distribution_does_not_depend_on_the_order() {
        let samples = [50, 10, 40, 20, 30, 60, 0, 100, 80, 70, 90].map(Duration::from_millis);
        let expected = Distribution { median: 50.0, min: 0.0, p10: 10.0, p90: 90.0 };
        assert_eq!(Distribution::of(samples), expected);
        let even = Distribution::of([4, 1].map(Duration::from_millis));
        assert_eq!((even.median, even.min), (2.5, 1.0));
        let one = Distribution::of([Duration::from_millis(3)]);
        assert_eq!([one.median, one.min, one.p10, one.p90], [3.0; 4]);
    }

    #[test]
    fn the_thread_s_time_counts_where_there_is_one() {
        let portable = Whole::new("portable", &[elapsed(30, Some(20))], 4_000_000, None);
        assert_eq!(portable.median_ms(), 20.0);
        assert_eq!(portable.rate, Rate { gmacs_per_s: Some(0.2), speedup: None });
        let avx2 = Whole::new("avx2", &[elapsed(9, Some(5))], 4_000_000, Some(&portable));
        assert_eq!(avx2.rate, Rate { gmacs_per_s: Some(0.8), speedup: Some(4.0) });
        let wall = Whole::new("portable", &[elapsed(10, None)], 1, None);
        assert_eq!((wall.cpu_ms, wall.median_ms()), (None, 10.0));
    }

    #[test]
    fn shares_are_of_each_backend_s_own_total() {
        let shares = shares(&["portable", "avx2"], &[6.0, 2.0], &[12.0, 8.0], Some(3_000_000), Some(0));
        let figures = |share: &Share| (share.share, share.rate.gmacs_per_s, share.rate.speedup);
        assert_eq!(figures(&shares[0]), (0.5, Some(0.5), Some(1.0)));
        assert_eq!(figures(&shares[1]), (0.25, Some(1.5), Some(3.0)));
    }

    #[test]
    fn a_clock_that_stands_still_gives_no_rate() {
        assert_eq!(Rate::new(0.0, Some(1), Some(0.0)), Rate::default());
        assert_eq!(super::shares(&["portable"], &[0.0], &[0.0], None, Some(0))[0].share, 0.0);
    }
}
