//! Where the error at the network's output comes from: the share of every tensor's own quantization.
//!
//! Method, on one frame: a step's own error (its integers against its operator in f32 on the same integer operands) is
//! added to the step's value in the f32 network, and everything behind it runs again in f32. The power of the error
//! that this makes at the measured value is the step's; shares are powers over their sum. Errors of different steps are
//! nearly uncorrelated, so their powers add up to about the whole error, as long as they are small.

use crate::statistics::ErrorSums;
use crate::trace::{LocalError, Tracer};
use indicatif::ProgressBar;
use model_compiler::error::Result;
use model_compiler::frames::Frame;
use model_compiler::ir::{Graph, Op, ValueId};
use model_compiler::reference::{Activations, rerun};
use rayon::prelude::*;
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

/// Up to this many multiply-accumulates, shares are measured without being asked for: about a second.
pub const UNASKED_MACS: u64 = 20_000_000_000;

/// Tensors that are measured in a larger network, those with the lowest local SQNR, unless told otherwise.
pub const DEFAULT_TENSORS: usize = 64;

/// Shares of the error power at one value of the network, on one frame.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
pub struct NoiseShares {
    /// Frame.
    pub frame: String,
    /// The measured value: the last pooled vector of a driving network, else the first output.
    pub measured: String,
    /// SQNR of the measured value on this frame, dB: the whole error.
    pub measured_sqnr_db: Option<f64>,
    /// Steps with an error of their own that the measured value depends on. Fewer are measured in a large network.
    pub candidates: usize,
    /// The measured steps, the greatest share first.
    pub shares: Vec<NoiseShare>,
}

/// What one step contributes.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
pub struct NoiseShare {
    /// Position in the program.
    pub position: usize,
    /// Step.
    pub step: String,
    /// Part of the summed error power of all measured steps, 0..=1.
    pub share: f64,
    /// SQNR of the measured value where this step alone is in integers, dB.
    pub alone_sqnr_db: Option<f64>,
}

/// Which steps to measure.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum Selection {
    /// All of them in a small network, none in a large one.
    #[default]
    WhereCheap,
    /// All of them in a small network, this many in a large one.
    Lowest(usize),
}

/// The value to measure at.
pub fn measured_value(graph: &Graph) -> Option<ValueId> {
    let first = *graph.outputs.first()?;
    let decodes = graph.nodes.iter().any(|node| matches!(node.op, Op::WaypointDecoder(_)));
    let pooled = graph.nodes.iter().rfind(|node| matches!(node.op, Op::GlobalPool)).map(|node| node.output);
    Some(pooled.filter(|_| decodes).unwrap_or(first))
}

/// Measures the shares on a frame; `None` where there is no f32 network, nothing to measure, or too much to do unasked.
///
/// # Errors
/// See [`Tracer::local_errors`].
pub fn shares(
    tracer: &mut Tracer<'_>,
    frame: &Frame,
    selection: Selection,
    progress: &ProgressBar,
) -> Result<Option<NoiseShares>> {
    let Some(graph) = tracer.graph() else { return Ok(None) };
    let Some(target) = measured_value(graph) else { return Ok(None) };
    let costs = tracer.noisy_steps().map(|(position, change)| {
        let dependents = change.dependents(graph, target);
        let macs: u64 = dependents.iter().map(|&node| graph.node_macs(&graph.nodes[node])).sum();
        (position, macs, change.value == target || !dependents.is_empty())
    });
    let mut positions: Vec<(usize, u64)> =
        costs.filter(|&(_, _, reaches)| reaches).map(|(position, macs, _)| (position, macs)).collect();
    let candidates = positions.len();
    let work: u64 = positions.iter().map(|(_, macs)| macs).sum();
    match selection {
        _ if work <= UNASKED_MACS => {}
        Selection::WhereCheap => return Ok(None),
        Selection::Lowest(count) => {
            let local = |position: usize| tracer.figures()[position].local.map_or(f64::INFINITY, |s| s.sqnr_db());
            positions.sort_by(|a, b| local(a.0).total_cmp(&local(b.0)));
            positions.truncate(count);
        }
    }
    if positions.is_empty() {
        return Ok(None);
    }
    let positions: Vec<usize> = positions.into_iter().map(|(position, _)| position).collect();
    progress.reset();
    progress.set_length(positions.len() as u64);
    progress.set_message("noise shares");
    let (activations, errors, whole) = tracer.local_errors(frame, &positions, target)?;
    let measure = |error: &LocalError<'_>| {
        let sums = contribution(graph, &activations, error, target)?;
        progress.inc(1);
        Ok((error.position, sums))
    };
    let sums: Vec<(usize, ErrorSums)> = errors.par_iter().map(measure).collect::<Result<_>>()?;
    progress.finish_and_clear();
    let total: f64 = sums.iter().map(|(_, sums)| sums.error_power()).sum();
    let share = |(position, sums): (usize, ErrorSums)| NoiseShare {
        position,
        step: tracer.step_name(position).to_owned(),
        share: if total > 0.0 { sums.error_power() / total } else { 0.0 },
        alone_sqnr_db: Some(sums.sqnr_db()),
    };
    let mut shares: Vec<NoiseShare> = sums.into_iter().map(share).collect();
    shares.sort_by(|a, b| b.share.total_cmp(&a.share));
    Ok(Some(NoiseShares {
        frame: frame.name.clone(),
        measured: graph.value(target).name.clone(),
        measured_sqnr_db: whole.map(|sums| sums.sqnr_db()),
        candidates,
        shares,
    }))
}

/// The error at `target` where one step alone is wrong by its own error.
fn contribution(graph: &Graph, kept: &Activations, error: &LocalError<'_>, target: ValueId) -> Result<ErrorSums> {
    let mut sums = ErrorSums::default();
    let (Some(value), Some(expected)) = (kept.get(error.change.value), kept.get(target)) else { return Ok(sums) };
    let disturbed: Vec<f32> = value.iter().zip(&error.error).map(|(value, error)| value + error).collect();
    sums.add(expected, &rerun(graph, kept, &error.change, &disturbed, target)?);
    Ok(sums)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::backends::Backend;
    use crate::testing::{frame, graph, sample};
    use firmware::image::Image;
    use model_compiler::ir::Graph;

    fn shares_of(graph: &Graph) -> Option<NoiseShares> {
        let sample = sample();
        let image = Image::parse(&sample.image).unwrap();
        let mut tracer = Tracer::new(image, &sample.record, Some(graph), Backend::choose(None).unwrap()).unwrap();
        tracer.trace(&frame(3), &ProgressBar::hidden()).unwrap();
        shares(&mut tracer, &frame(3), Selection::WhereCheap, &ProgressBar::hidden()).unwrap()
    }

    #[test]
    fn exact_steps_have_no_share() {
        let shares = shares_of(&graph()).unwrap();
        assert_eq!((shares.candidates, shares.measured.as_str()), (2, "mean"));
        assert!(shares.shares.iter().all(|s| s.share == 0.0 && s.alone_sqnr_db == Some(f64::INFINITY)), "{shares:?}");
    }

    #[test]
    fn the_only_wrong_step_has_the_whole_share() {
        // A network whose first pool is something else: the first step errs, the second is exact by itself.
        let mut other = graph();
        if let Op::MaxPool(window) = &other.nodes[1].op {
            other.nodes[1].op = Op::AveragePool(*window);
        }
        let shares = shares_of(&other).unwrap();
        assert_eq!((shares.shares[0].step.as_str(), shares.shares[0].share), ("pool", 1.0));
        assert_eq!((shares.shares[1].step.as_str(), shares.shares[1].share), ("mean", 0.0));
        // The whole error is this one error, up to rounding in f32.
        let (alone, whole) = (shares.shares[0].alone_sqnr_db.unwrap(), shares.measured_sqnr_db.unwrap());
        assert!((alone - whole).abs() < 0.01, "{alone} {whole}");
    }
}
