//! Several memories: which region each item goes to.
//!
//! The aim, in this order: everything fits; the first region carries as much traffic ([`super::traffic`]) as it can,
//! then the second, and so on. Items are taken hottest first, and each goes to the first region that has room for it at
//! all its steps. What fits nowhere is moved to the front, where it goes to the last region that has room, and the rest
//! is taken again around it. "Hottest" is tried by several keys (traffic per byte and step, per byte, in all), each with
//! three choices of in-place pairs: a chain of them is one item and stays together, so fewer pairs leave more freedom
//! and need more memory. At the end, pairs that came to lie in one region are joined again, and what then has room in a
//! faster region moves there.
//!
//! Room is counted in live bytes. Each region is then packed like a single arena; where the packing is larger than the
//! region, that region is filled less by the difference and all is taken again.

#[cfg(test)]
mod tests;

use super::{Items, Job, Layout, Pairs, items, solver};
use std::cmp::Ordering;

/// Rounds of moving items to the front, per key.
const ROUNDS: usize = 40;
/// Rounds of filling less what cannot be packed.
const PACKINGS: usize = 8;

/// Spreads a model over regions of these sizes (`None`: unlimited). Where the regions are too small, the last one is
/// overfull.
pub(super) fn spread(job: &Job<'_>, all: &Pairs, capacities: &[Option<u64>]) -> Layout {
    let capacities: Vec<u64> = capacities.iter().map(|bytes| bytes.unwrap_or(u64::MAX)).collect();
    let mut budgets: Vec<u64> =
        capacities.iter().map(|bytes| bytes / job.needs.alignment * job.needs.alignment).collect();
    let mut nodes = vec![0; budgets.len()];
    let mut best: Option<(u64, Layout)> = None;
    for _ in 0..PACKINGS {
        let layout = packed(job, choose(job, all, &budgets));
        nodes.iter_mut().zip(&layout.packings).for_each(|(sum, packing)| *sum += packing.nodes);
        let (mut over, mut is_mended) = (0, false);
        for ((budget, packing), &capacity) in budgets.iter_mut().zip(&layout.packings).zip(&capacities) {
            let excess = packing.peak.saturating_sub(capacity);
            over += excess;
            // What does not even fit by its live bytes no packing can mend.
            if excess > 0 && packing.bound <= capacity {
                *budget = budget.saturating_sub(excess);
                is_mended = true;
            }
        }
        if best.as_ref().is_none_or(|(least, _)| over < *least) {
            best = Some((over, layout));
        }
        if !is_mended {
            break;
        }
    }
    let (_, mut layout) = best.expect("the loop runs at least once");
    layout.packings.iter_mut().zip(nodes).for_each(|(packing, nodes)| packing.nodes = nodes);
    layout
}

/// Items with their regions.
struct Choice {
    pairs: Pairs,
    items: Items,
    region_of: Vec<usize>,
    /// Bytes beyond the budgets, at the fullest step of each region.
    overflow: u64,
    /// Traffic per region.
    traffic: Vec<u64>,
}

impl Choice {
    /// Whether this one is to be preferred.
    fn is_better_than(&self, other: &Self) -> bool {
        (other.overflow, &self.traffic) > (self.overflow, &other.traffic)
    }

    /// Moves items to faster regions that have room for them, hottest first.
    fn raise(&mut self, job: &Job<'_>, budgets: &[u64]) {
        let mut memory = self.memory(job, budgets);
        for candidate in candidates(job, &self.items, KEYS[0]) {
            let shape = &self.items.shapes[candidate.item];
            let region = &mut self.region_of[candidate.item];
            memory.release(*region, shape);
            let faster = (0..*region).find(|&faster| memory.has_room(faster, shape)).unwrap_or(*region);
            self.traffic[*region] -= candidate.traffic;
            self.traffic[faster] += candidate.traffic;
            *region = faster;
            memory.take(faster, shape);
        }
        self.overflow = memory.overflow();
    }

    /// What the items take.
    fn memory<'b>(&self, job: &Job<'_>, budgets: &'b [u64]) -> Memory<'b> {
        let mut memory = Memory::new(budgets, job.order.len());
        self.items.shapes.iter().zip(&self.region_of).for_each(|(shape, &region)| memory.take(region, shape));
        memory
    }
}

/// The best assignment over all choices of pairs and keys.
fn choose(job: &Job<'_>, all: &Pairs, budgets: &[u64]) -> Choice {
    let sizes = &job.needs.tensor_bytes;
    let shrinks = |tensor: usize, operand: usize| sizes[tensor] < sizes[operand];
    let equal = all.iter().enumerate().map(|(t, pair)| pair.filter(|&operand| !shrinks(t, operand))).collect();
    let choices = [all.clone(), equal, vec![None; all.len()]];
    let mut best: Option<Choice> = None;
    for pairs in choices {
        for key in KEYS {
            let mut choice = joined(job, all, assign(job, pairs.clone(), key, budgets), budgets);
            choice.raise(job, budgets);
            if best.as_ref().is_none_or(|best| choice.is_better_than(best)) {
                best = Some(choice);
            }
        }
    }
    best.expect("there are choices")
}

/// What items are sorted by: the larger of two quotients first.
type Key = fn(&Candidate) -> [u64; 2];

const KEYS: [Key; 3] = [|c| [c.traffic, c.area], |c| [c.traffic, c.bytes], |c| [c.traffic, 1]];

/// An item to be assigned.
struct Candidate {
    item: usize,
    traffic: u64,
    /// Bytes times steps.
    area: u64,
    /// Bytes at its largest.
    bytes: u64,
}

fn hotter(a: [u64; 2], b: [u64; 2]) -> Ordering {
    let cross = |x: u64, y: u64| u128::from(x) * u128::from(y.max(1));
    cross(b[0], a[1]).cmp(&cross(a[0], b[1]))
}

/// All items, hottest first.
fn candidates(job: &Job<'_>, items: &Items, key: Key) -> Vec<Candidate> {
    let traffic = items.traffic(job.needs, job.order);
    let candidate = |(item, shape): (usize, &solver::Item)| Candidate {
        item,
        traffic: traffic[item],
        area: shape.spans.iter().map(|s| s.bytes * u64::from(s.last - s.first + 1)).sum(),
        bytes: shape.spans[0].bytes,
    };
    let mut candidates: Vec<Candidate> = items.shapes.iter().enumerate().map(candidate).collect();
    candidates.sort_by(|a, b| hotter(key(a), key(b)).then(a.item.cmp(&b.item)));
    candidates
}

/// Assigns every item, hottest first.
fn assign(job: &Job<'_>, pairs: Pairs, key: Key, budgets: &[u64]) -> Choice {
    let items = items(job, &pairs);
    let mut order: Vec<usize> = candidates(job, &items, key).iter().map(|c| c.item).collect();
    let mut moved = vec![false; order.len()];
    let mut best: Option<(u64, Vec<usize>)> = None;
    for _ in 0..ROUNDS {
        let mut memory = Memory::new(budgets, job.order.len());
        let mut region_of = vec![0; order.len()];
        let mut misfits = Vec::new();
        for &item in &order {
            let shape = &items.shapes[item];
            let found = if moved[item] { memory.last_room(shape) } else { memory.first_room(shape) };
            region_of[item] = found.unwrap_or_else(|| {
                misfits.push(item);
                budgets.len() - 1
            });
            memory.take(region_of[item], shape);
        }
        let overflow = memory.overflow();
        if best.as_ref().is_none_or(|(least, _)| overflow < *least) {
            best = Some((overflow, region_of));
        }
        if misfits.is_empty() {
            break;
        }
        misfits.iter().for_each(|&item| moved[item] = true);
        order.retain(|item| !misfits.contains(item));
        order.splice(0..0, misfits);
    }
    let (overflow, region_of) = best.expect("there are rounds");
    let mut by_region = vec![0; budgets.len()];
    let traffic = items.traffic(job.needs, job.order);
    region_of.iter().zip(traffic).for_each(|(&region, bytes)| by_region[region] += bytes);
    Choice { pairs, items, region_of, overflow, traffic: by_region }
}

/// The same assignment with every pair whose tensors lie in one region.
fn joined(job: &Job<'_>, all: &Pairs, choice: Choice, budgets: &[u64]) -> Choice {
    let region = |tensor: usize| choice.region_of[choice.items.of_tensor[tensor]];
    let together = |(t, pair): (usize, &Option<usize>)| pair.filter(|&operand| region(t) == region(operand));
    let pairs: Pairs = all.iter().enumerate().map(together).collect();
    let items = items(job, &pairs);
    let mut region_of = vec![0; items.shapes.len()];
    items.of_tensor.iter().enumerate().for_each(|(t, &item)| region_of[item] = region(t));
    for (item, old) in items.of_scratch.iter().zip(&choice.items.of_scratch) {
        item.iter().zip(old).for_each(|(&item, &old)| region_of[item] = choice.region_of[old]);
    }
    let mut joined = Choice { pairs, items, region_of, overflow: 0, traffic: choice.traffic };
    joined.overflow = joined.memory(job, budgets).overflow();
    joined
}

/// Packs every region, each within its part of the nodes.
fn packed(job: &Job<'_>, choice: Choice) -> Layout {
    let Choice { pairs, items, region_of, traffic, .. } = choice;
    let mut offsets = vec![0; items.shapes.len()];
    let pack = |region: usize| {
        let here: Vec<usize> = (0..region_of.len()).filter(|&item| region_of[item] == region).collect();
        let shapes: Vec<solver::Item> = here.iter().map(|&item| items.shapes[item].clone()).collect();
        let packing = solver::pack(&shapes, job.node_limit / PACKINGS as u64);
        here.iter().zip(&packing.offsets).for_each(|(&item, &offset)| offsets[item] = offset);
        packing
    };
    let packings = (0..traffic.len()).map(pack).collect();
    Layout { pairs, items, region_of, offsets, packings }
}

/// Live bytes per region and step.
struct Memory<'a> {
    budgets: &'a [u64],
    live: Vec<Vec<u64>>,
}

impl<'a> Memory<'a> {
    fn new(budgets: &'a [u64], steps: usize) -> Self {
        Self { budgets, live: vec![vec![0; steps.max(1)]; budgets.len()] }
    }

    fn has_room(&self, region: usize, item: &solver::Item) -> bool {
        item.spans.iter().all(|span| {
            let live = &self.live[region][span.first as usize..=span.last as usize];
            live.iter().all(|bytes| bytes + span.bytes <= self.budgets[region])
        })
    }

    fn first_room(&self, item: &solver::Item) -> Option<usize> {
        (0..self.budgets.len()).find(|&region| self.has_room(region, item))
    }

    fn last_room(&self, item: &solver::Item) -> Option<usize> {
        (0..self.budgets.len()).rev().find(|&region| self.has_room(region, item))
    }

    fn take(&mut self, region: usize, item: &solver::Item) {
        for span in &item.spans {
            let live = &mut self.live[region][span.first as usize..=span.last as usize];
            live.iter_mut().for_each(|bytes| *bytes += span.bytes);
        }
    }

    fn release(&mut self, region: usize, item: &solver::Item) {
        for span in &item.spans {
            let live = &mut self.live[region][span.first as usize..=span.last as usize];
            live.iter_mut().for_each(|bytes| *bytes -= span.bytes);
        }
    }

    /// Bytes beyond the budgets, at the fullest step of each region.
    fn overflow(&self) -> u64 {
        let fullest = |live: &Vec<u64>| live.iter().copied().max().unwrap_or(0);
        self.live.iter().zip(self.budgets).map(|(live, budget)| fullest(live).saturating_sub(*budget)).sum()
    }
}
