//! The checker: judges a finished plan from the model alone, without the solver's data.

use super::in_place::overwritable;
use super::needs::{scratch_bytes, tensor_bytes};
use super::{MemoryPlan, Placement, PlanStatus, SCRATCH_ALIGNMENT};
use crate::qmodel::{QModel, QTensorId};

/// Verifies that a plan computes what the model computes: the order runs; live ranges, sizes and scratch are right;
/// every in-place pair is legal; no two buffers that are live together overlap; everything is aligned and inside its
/// region; the bound and the status of every region are true.
///
/// It does not prove that a plan of status [`PlanStatus::OptimalBoundNotReachable`] is optimal.
///
/// # Errors
/// Every violation found, one line each.
pub fn check(model: &QModel, plan: &MemoryPlan) -> Result<(), Vec<String>> {
    let mut checker = Checker { model, plan, problems: Vec::new() };
    checker.lengths_and_order();
    if checker.problems.is_empty() {
        checker.live_ranges();
    }
    if checker.problems.is_empty() {
        checker.sizes();
        checker.pairs();
        checker.overlaps();
        checker.bound();
    }
    if checker.problems.is_empty() { Ok(()) } else { Err(checker.problems) }
}

struct Checker<'a> {
    model: &'a QModel,
    plan: &'a MemoryPlan,
    problems: Vec<String>,
}

/// A buffer that is live at some position.
#[derive(Clone, Copy)]
struct Live<'a> {
    tensor: Option<usize>,
    placement: &'a Placement,
}

impl<'a> Checker<'a> {
    fn lengths_and_order(&mut self) {
        let (model, plan) = (self.model, self.plan);
        let (tensors, steps) = (model.tensors.len(), model.steps.len());
        let found = (plan.tensors.len(), plan.scratch.len(), plan.kernels.len());
        if found != (tensors, steps, steps) {
            let (found_tensors, scratch, kernels) = found;
            self.problems.push(format!(
                "{found_tensors} tensors, {scratch} scratch entries and {kernels} kernels, expected {tensors} and {steps}"
            ));
        }
        let mut sorted = plan.order.clone();
        sorted.sort_unstable();
        if !sorted.iter().copied().eq(0..model.steps.len() as u32) {
            self.problems.push("the order does not name every step once".into());
            return;
        }
        let mut known = vec![false; model.tensors.len()];
        model.inputs.iter().for_each(|p| known[p.tensor.0 as usize] = true);
        for &step in &plan.order {
            let step = &model.steps[step as usize];
            if let Some(early) = step.op.reads().into_iter().find(|t| !known[t.0 as usize]) {
                self.problems.push(format!("{} runs before {} is written", step.name, model.tensor(early).name));
            }
            known[step.op.output().0 as usize] = true;
        }
    }

    fn live_ranges(&mut self) {
        for (index, (tensor, placement)) in self.model.tensors.iter().zip(&self.plan.tensors).enumerate() {
            let id = QTensorId(index as u32);
            let positions = |uses: &dyn Fn(&crate::qmodel::QOp) -> bool| -> Vec<u32> {
                (0..self.plan.order.len() as u32).filter(|&p| uses(&self.step(p).op)).collect()
            };
            let written = positions(&|op| op.output() == id);
            let read = positions(&|op| op.reads().contains(&id));
            let first = written.first().copied().unwrap_or(0);
            let is_output = self.model.outputs.iter().any(|p| p.tensor == id);
            let end = self.plan.order.len().saturating_sub(1) as u32;
            let last = if is_output { end } else { read.last().copied().unwrap_or(first) };
            let found = (placement.first_step, placement.last_step);
            if found != (first, last) {
                self.problems.push(format!("{}: live {found:?}, expected {:?}", tensor.name, (first, last)));
            }
        }
    }

    fn sizes(&mut self) {
        let alignment = u64::from(self.plan.alignment).max(1);
        for (index, placement) in self.plan.tensors.iter().enumerate() {
            let expected = tensor_bytes(self.model, QTensorId(index as u32));
            self.size(self.model.tensors[index].name.clone(), placement, expected, alignment);
        }
        for position in 0..self.plan.order.len() as u32 {
            let step = self.step(position);
            let expected = scratch_bytes(self.model, &step.op, self.plan.kernels[position as usize]);
            let name = format!("scratch of {}", step.name);
            match &self.plan.scratch[position as usize] {
                None if expected == 0 => {}
                None => self.problems.push(format!("{name}: missing, {expected} bytes needed")),
                Some(placement) => {
                    self.size(name.clone(), placement, expected, alignment.max(SCRATCH_ALIGNMENT));
                    if (placement.first_step, placement.last_step) != (position, position) {
                        self.problems.push(format!("{name}: not live at position {position} only"));
                    }
                    if placement.in_place_of.is_some() {
                        self.problems.push(format!("{name}: takes over a tensor"));
                    }
                }
            }
        }
    }

    fn size(&mut self, name: String, placement: &Placement, expected: u64, alignment: u64) {
        let Placement { region, offset, bytes, .. } = *placement;
        if bytes != expected {
            self.problems.push(format!("{name}: {bytes} bytes, expected {expected}"));
        }
        if !offset.is_multiple_of(alignment) {
            self.problems.push(format!("{name}: offset {offset} is not a multiple of {alignment}"));
        }
        let Some(part) = self.plan.regions.get(usize::from(region)) else {
            self.problems.push(format!("{name}: there is no region {region}"));
            return;
        };
        if offset.checked_add(bytes).is_none_or(|end| end > part.bytes) {
            self.problems.push(format!("{name}: {offset} + {bytes} is outside the arena of {}", part.bytes));
        }
    }

    fn pairs(&mut self) {
        for (index, placement) in self.plan.tensors.iter().enumerate() {
            let Some(operand) = placement.in_place_of else { continue };
            let name = &self.model.tensors[index].name;
            let position = placement.first_step;
            let op = &self.step(position).op;
            if op.output().0 as usize != index || !overwritable(self.model, op, true, true).contains(&operand) {
                self.problems.push(format!("{name}: may not take over tensor {}", operand.0));
                continue;
            }
            let taken = &self.plan.tensors[operand.0 as usize];
            let operand_name = &self.model.tensor(operand).name;
            if taken.last_step != position || self.model.outputs.iter().any(|p| p.tensor == operand) {
                self.problems.push(format!("{name}: takes over {operand_name}, which is needed later"));
            }
            if (taken.region, taken.offset) != (placement.region, placement.offset) {
                self.problems.push(format!("{name}: not at the offset of {operand_name}, which it takes over"));
            }
        }
    }

    fn overlaps(&mut self) {
        for position in 0..self.plan.order.len() as u32 {
            let mut live = self.live_at(position);
            let start = |l: &Live<'_>| (l.placement.region, l.placement.offset);
            live.sort_by_key(start);
            for (i, low) in live.iter().enumerate() {
                let end = (low.placement.region, low.placement.offset.saturating_add(low.placement.bytes));
                let above = live[i + 1..].iter().take_while(|high| start(high) < end);
                for high in above.filter(|high| !is_pair(low, high, position) && !is_pair(high, low, position)) {
                    let (a, b) = (self.name(low, position), self.name(high, position));
                    self.problems.push(format!("{a} and {b} overlap at position {position}"));
                }
            }
        }
    }

    fn bound(&mut self) {
        let (plan, positions) = (self.plan, 0..self.plan.order.len() as u32);
        for (number, part) in (0_u8..).zip(&plan.regions) {
            let name = &part.name;
            let bound = positions.clone().map(|p| plan.live_bytes(number, p)).max().unwrap_or(0);
            if part.bound_bytes != bound {
                self.problems.push(format!("region {name}: bound {}, expected {bound}", part.bound_bytes));
            }
            let at_peak = positions.contains(&part.peak_step).then(|| plan.live_bytes(number, part.peak_step));
            if !plan.order.is_empty() && at_peak != Some(bound) {
                self.problems.push(format!("region {name}: position {} is not the peak", part.peak_step));
            }
            if (part.status == PlanStatus::Optimal) != (part.bytes == bound) {
                let found = format!("{:?} with arena {} and bound {bound}", part.status, part.bytes);
                self.problems.push(format!("region {name}: {found}"));
            }
        }
    }

    fn live_at(&self, position: u32) -> Vec<Live<'a>> {
        let plan = self.plan;
        let tensors = plan.tensors.iter().enumerate().map(|(t, placement)| Live { tensor: Some(t), placement });
        let scratch = plan.scratch[position as usize].iter().map(|placement| Live { tensor: None, placement });
        let is_live = |l: &Live<'_>| (l.placement.first_step..=l.placement.last_step).contains(&position);
        tensors.filter(is_live).chain(scratch).collect()
    }

    fn step(&self, position: u32) -> &'a crate::qmodel::QStep {
        &self.model.steps[self.plan.order[position as usize] as usize]
    }

    fn name(&self, live: &Live<'_>, position: u32) -> String {
        live.tensor
            .map_or_else(|| format!("scratch of {}", self.step(position).name), |t| self.model.tensors[t].name.clone())
    }
}

/// `taker` takes over `operand` at this position.
fn is_pair(operand: &Live<'_>, taker: &Live<'_>, position: u32) -> bool {
    let taken = taker.placement.in_place_of.map(|t| t.0 as usize);
    taken.is_some() && taken == operand.tensor && taker.placement.first_step == position
}
