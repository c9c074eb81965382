//! Operator order: the interleaving of independent branches with the least bound on memory.
//!
//! The live bytes between two steps depend only on the set of steps done. So the orders are paths through the sets, and
//! a set from which the end cannot be reached below a cap need not be visited again. The search lowers the cap until no
//! order passes below it. A step that fits below the cap and does not raise the live bytes is taken without asking:
//! done early it can only help the others. Among several steps the model's own order is tried first.

use crate::memory_plan::MemoryNeeds;
use std::collections::HashSet;

/// An execution order.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(crate) struct Schedule {
    /// Indices into the model's steps.
    pub order: Vec<usize>,
    /// Largest sum of live bytes, with every in-place pair taken.
    pub peak: u64,
    /// Steps tried.
    pub nodes: u64,
}

/// The order with the least peak, or the best found within `node_limit` (0: the model's own order).
pub(crate) fn search(needs: &MemoryNeeds, node_limit: u64) -> Schedule {
    let order: Vec<usize> = (0..needs.writes.len()).collect();
    let mut best = Schedule { peak: peak_of(needs, &order), order, nodes: 0 };
    while let Some(order) = below(needs, best.peak, node_limit, &mut best.nodes) {
        best.peak = peak_of(needs, &order);
        best.order = order;
    }
    best
}

fn peak_of(needs: &MemoryNeeds, order: &[usize]) -> u64 {
    let mut state = State::new(needs);
    let peaks = order.iter().map(|&step| {
        let peak = state.cost(step).peak;
        state.run(step);
        peak
    });
    peaks.max().unwrap_or(0)
}

/// An order with a peak below `cap`, by depth-first search over sets of finished steps.
fn below(needs: &MemoryNeeds, cap: u64, node_limit: u64, nodes: &mut u64) -> Option<Vec<usize>> {
    let mut state = State::new(needs);
    let mut visited: HashSet<Vec<u64>> = HashSet::new();
    let mut order: Vec<usize> = Vec::new();
    let mut frames = vec![state.choices(cap).into_iter()];
    while order.len() < needs.writes.len() {
        let Some(step) = frames.last_mut()?.next() else {
            frames.pop();
            state.take_back(order.pop()?);
            continue;
        };
        if *nodes >= node_limit {
            return None;
        }
        *nodes += 1;
        state.run(step);
        if visited.insert(state.done.clone()) {
            order.push(step);
            frames.push(state.choices(cap).into_iter());
        } else {
            state.take_back(step);
        }
    }
    Some(order)
}

/// Live bytes during a step, and after it.
struct Cost {
    peak: u64,
    after: u64,
}

/// Bytes that stay and go with a step.
struct Change {
    kept: u64,
    freed: u64,
}

/// A set of finished steps.
struct State<'a> {
    needs: &'a MemoryNeeds,
    /// Bit per step.
    done: Vec<u64>,
    /// Readers still to come, per tensor.
    readers: Vec<u32>,
    /// Whether a tensor has its value.
    written: Vec<bool>,
    live: u64,
}

impl<'a> State<'a> {
    fn new(needs: &'a MemoryNeeds) -> Self {
        let inputs = needs.is_input.iter().zip(&needs.tensor_bytes).filter(|(input, _)| **input);
        Self {
            needs,
            done: vec![0; needs.writes.len().div_ceil(64)],
            readers: needs.reader_counts(),
            written: needs.is_input.clone(),
            live: inputs.map(|(_, bytes)| bytes).sum(),
        }
    }

    /// The step is the last reader of a tensor that may go.
    fn dies(&self, tensor: usize) -> bool {
        self.readers[tensor] == 1 && !self.needs.is_output[tensor]
    }

    fn cost(&self, step: usize) -> Cost {
        let needs = self.needs;
        let output = needs.writes[step];
        let in_place = needs.overwritable[step].iter().any(|&t| self.dies(t));
        let new = if in_place { 0 } else { needs.tensor_bytes[output] };
        let Change { kept, freed } = self.change(step);
        Cost { peak: self.live + needs.scratch_room(step) + new, after: self.live + kept - freed }
    }

    /// What running the step adds and removes.
    fn change(&self, step: usize) -> Change {
        let needs = self.needs;
        let output = needs.writes[step];
        let dead = self.readers[output] == 0 && !needs.is_output[output];
        Change {
            kept: if dead { 0 } else { needs.tensor_bytes[output] },
            freed: needs.reads[step].iter().filter(|&&t| self.dies(t)).map(|&t| needs.tensor_bytes[t]).sum(),
        }
    }

    fn run(&mut self, step: usize) {
        self.live = self.cost(step).after;
        self.needs.reads[step].iter().for_each(|&t| self.readers[t] -= 1);
        self.written[self.needs.writes[step]] = true;
        self.done[step / 64] |= 1 << (step % 64);
    }

    fn take_back(&mut self, step: usize) {
        self.done[step / 64] &= !(1 << (step % 64));
        self.written[self.needs.writes[step]] = false;
        self.needs.reads[step].iter().for_each(|&t| self.readers[t] += 1);
        let Change { kept, freed } = self.change(step);
        self.live = self.live + freed - kept;
    }

    fn is_ready(&self, step: usize) -> bool {
        self.done[step / 64] >> (step % 64) & 1 == 0 && self.needs.reads[step].iter().all(|&t| self.written[t])
    }

    /// Steps to try next, in order; only one where one is free.
    fn choices(&self, cap: u64) -> Vec<usize> {
        let mut fitting = Vec::new();
        for step in (0..self.needs.writes.len()).filter(|&s| self.is_ready(s)) {
            let cost = self.cost(step);
            if cost.peak < cap && cost.after <= self.live {
                return vec![step];
            }
            if cost.peak < cap {
                fitting.push(step);
            }
        }
        fitting
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A seeded network of up to 7 steps over two inputs; what nobody reads is an output.
    fn random_needs(seed: u64) -> MemoryNeeds {
        let mut state = seed;
        let mut below = |n: usize| {
            state = state.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
            (state >> 33) as usize % n
        };
        let steps = 3 + below(5);
        let tensors = steps + 2;
        let bytes: Vec<u64> = (0..tensors).map(|_| 4 * (1 + below(9) as u64)).collect();
        let mut reads = Vec::new();
        for step in 0..steps {
            let mut read = vec![below(step + 2), below(step + 2)];
            read.sort_unstable();
            read.dedup();
            reads.push(read);
        }
        let fits = |step: usize, t: &usize| bytes[*t] >= bytes[step + 2];
        let overwritable = (0..steps).map(|s| reads[s].iter().copied().filter(|t| fits(s, t)).take(1).collect());
        MemoryNeeds {
            exact_bytes: bytes.clone(),
            tensor_bytes: bytes.clone(),
            is_output: (0..tensors).map(|t| !reads.iter().flatten().any(|&r| r == t)).collect(),
            is_input: (0..tensors).map(|t| t < 2).collect(),
            overwritable: overwritable.collect(),
            writes: (2..tensors).collect(),
            kernels: vec![None; steps],
            scratch: (0..steps).map(|_| 16 * below(2) as u64).collect(),
            tensor_traffic: bytes,
            scratch_traffic: vec![0; steps],
            reads,
            alignment: 16,
        }
    }

    /// Peak from live ranges, not from the search's running sums.
    fn peak_by_ranges(needs: &MemoryNeeds, order: &[usize]) -> u64 {
        let ranges = needs.live_ranges(order);
        let pairs = needs.pairs(order, &ranges);
        let live_sum = |position: usize| {
            let at = position as u32;
            let tensors = (0..ranges.len()).filter(|&t| (ranges[t].first..=ranges[t].last).contains(&at));
            let counted = tensors.filter(|&t| pairs[t].is_none() || ranges[t].first != at);
            counted.map(|t| needs.tensor_bytes[t]).sum::<u64>() + needs.scratch_room(order[position])
        };
        (0..order.len()).map(live_sum).max().unwrap_or(0)
    }

    fn least_peak(needs: &MemoryNeeds, order: &mut Vec<usize>) -> u64 {
        if order.len() == needs.writes.len() {
            return peak_by_ranges(needs, order);
        }
        let mut best = u64::MAX;
        for step in 0..needs.writes.len() {
            let ready = |t: &usize| needs.is_input[*t] || order.iter().any(|&s| needs.writes[s] == *t);
            if !order.contains(&step) && needs.reads[step].iter().all(ready) {
                order.push(step);
                best = best.min(least_peak(needs, order));
                order.pop();
            }
        }
        best
    }

    #[test]
    fn finds_the_least_peak_of_all_orders() {
        let mut improved = 0;
        for seed in 0..400 {
            let needs = random_needs(seed);
            let own = search(&needs, 0);
            assert!(own.order.iter().copied().eq(0..needs.writes.len()), "seed {seed}");
            assert_eq!(own.peak, peak_by_ranges(&needs, &own.order), "seed {seed}");
            let found = search(&needs, 1_000_000);
            assert_eq!(found.peak, peak_by_ranges(&needs, &found.order), "seed {seed}");
            assert_eq!(found.peak, least_peak(&needs, &mut Vec::new()), "seed {seed}: {needs:?}");
            improved += u32::from(found.peak < own.peak);
        }
        assert!(improved > 20, "only {improved} networks gain");
    }

    #[test]
    fn a_node_limit_keeps_the_best_order_so_far() {
        for seed in 0..50 {
            let needs = random_needs(seed);
            for limit in 0..30 {
                let found = search(&needs, limit);
                assert!(found.nodes <= limit, "seed {seed}");
                assert_eq!(found.peak, peak_by_ranges(&needs, &found.order), "seed {seed}");
            }
        }
    }
}
