//! From samples to figures: medians per step, sums per operator, and the multiply-accumulates that they stand for.

use super::Samples;
use super::figures::{Distribution, OperatorTotal, StepTime, Whole, shares};
use crate::backends::BackendKind;
use firmware::image::Image;
use firmware::program::Step;
use model_compiler::record::Record;
use std::time::Duration;

/// Samples and what they are samples of, on the way to a report.
pub(super) struct Tabulation<'a> {
    image: &'a Image<'a>,
    record: Option<&'a Record>,
    samples: &'a [Samples],
    names: Vec<&'static str>,
    portable: Option<usize>,
    program: Vec<Step>,
    /// Medians by backend and position, ms.
    medians: Vec<Vec<f64>>,
    /// Sums of these by backend, ms.
    totals: Vec<f64>,
}

impl<'a> Tabulation<'a> {
    pub(super) fn new(image: &'a Image<'a>, record: Option<&'a Record>, samples: &'a [Samples]) -> Self {
        let median = |times: &Vec<Duration>| Distribution::of(times.iter().copied()).median;
        let medians: Vec<Vec<f64>> = samples.iter().map(|s| s.steps.iter().map(median).collect()).collect();
        Self {
            image,
            record,
            samples,
            names: samples.iter().map(|s| s.kind.name()).collect(),
            portable: samples.iter().position(|s| s.kind == BackendKind::Portable),
            program: (0..image.step_count()).filter_map(|position| image.step(position)).collect(),
            totals: medians.iter().map(|steps| steps.iter().sum()).collect(),
            medians,
        }
    }

    /// Multiply-accumulates of a step; `None` where its work is of another kind.
    fn step_macs(&self, position: usize) -> Option<u64> {
        use Step::{Attention, BranchLinear, Conv2d, Linear, WaypointDecoder};
        let step = &self.program[position];
        let multiplies = matches!(step, Conv2d(_) | Linear(_) | BranchLinear(_) | Attention(_) | WaypointDecoder(_));
        multiplies.then(|| self.image.step_work(position as u16)).flatten()
    }

    pub(super) fn macs(&self) -> u64 {
        (0..self.program.len()).filter_map(|position| self.step_macs(position)).sum()
    }

    pub(super) fn backends(&self) -> Vec<Whole> {
        let whole =
            |index: usize, portable| Whole::new(self.names[index], &self.samples[index].whole, self.macs(), portable);
        let portable = self.portable.map(|index| whole(index, None));
        (0..self.samples.len()).map(|index| whole(index, portable.as_ref())).collect()
    }

    pub(super) fn steps(&self) -> Vec<StepTime> {
        let name = |position: usize| {
            let step = self.record.map(|record| &record.model.steps[record.plan.order[position] as usize]);
            step.map_or_else(|| self.program[position].name().to_owned(), |step| step.name.clone())
        };
        let step = |(position, step): (usize, &Step)| {
            let shape = self
                .image
                .tensor(step.output())
                .map_or([0; 3], |record| [record.shape.height, record.shape.width, record.shape.channels]);
            let macs = self.step_macs(position);
            let ms: Vec<f64> = self.medians.iter().map(|steps| steps[position]).collect();
            let times = shares(&self.names, &ms, &self.totals, macs, self.portable);
            StepTime { position, step: name(position), op: step.name(), shape, macs, times }
        };
        self.program.iter().enumerate().map(step).collect()
    }

    pub(super) fn operators(&self) -> Vec<OperatorTotal> {
        let mut ops: Vec<&'static str> = Vec::new();
        for step in &self.program {
            if !ops.contains(&step.name()) {
                ops.push(step.name());
            }
        }
        let total = |op: &'static str| {
            let positions: Vec<usize> = (0..self.program.len()).filter(|&p| self.program[p].name() == op).collect();
            let macs: Option<u64> = positions.iter().map(|&position| self.step_macs(position)).sum();
            let sum = |steps: &Vec<f64>| positions.iter().map(|&position| steps[position]).sum();
            let ms: Vec<f64> = self.medians.iter().map(sum).collect();
            let times = shares(&self.names, &ms, &self.totals, macs, self.portable);
            OperatorTotal { op, steps: positions.len(), macs, times }
        };
        ops.into_iter().map(total).collect()
    }
}
