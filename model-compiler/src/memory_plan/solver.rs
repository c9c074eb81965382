//! Placement: an offset for every item so that items that are live together do not overlap, with the least peak.
//!
//! The problem is two-dimensional packing with time fixed: a block keeps its place on the time axis and is moved only up
//! and down. It is solved in three stages, each counted in search nodes (blocks put down), never in seconds:
//! 1. first fit in several orders, improved by moving what did not fit to the front ([`first_fit`]);
//! 2. an exact search for a packing of exactly the lower bound ([`skyline`]);
//! 3. where the bound is proved out of reach, the exact search again, ever below the best found, until exhausted.

mod first_fit;
mod joins;
mod skyline;
#[cfg(test)]
mod tests;

use super::PlanStatus;
use skyline::Outcome;

/// Tries of [`joins`], each with other guesses.
const JOIN_ATTEMPTS: u64 = 24;

/// Memory that belongs together: one offset, and a size per span of steps that never grows.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(crate) struct Item {
    /// Consecutive spans; sizes do not grow from one to the next.
    pub spans: Vec<Span>,
}

/// Steps `first ..= last` with the bytes that an item needs there.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) struct Span {
    pub first: u32,
    pub last: u32,
    pub bytes: u64,
}

/// A packing with its proof.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(crate) struct Packing {
    /// Offset per item.
    pub offsets: Vec<u64>,
    pub peak: u64,
    pub bound: u64,
    /// First step with the sum `bound`.
    pub peak_step: u32,
    pub status: PlanStatus,
    pub nodes: u64,
}

/// An item in sections of time: heights in sections `first ..= last`, never growing.
#[derive(Clone, Debug, PartialEq, Eq)]
struct Block {
    first: usize,
    last: usize,
    heights: Vec<u64>,
}

impl Block {
    fn height(&self, section: usize) -> u64 {
        self.heights[section - self.first]
    }

    /// Distance that `above` must keep from this block's offset when it lies higher; `None` if they never meet.
    fn separation(&self, above: &Block) -> Option<u64> {
        let meet = self.first.max(above.first);
        (meet <= self.last.min(above.last)).then(|| self.height(meet))
    }

    fn is_flat(&self) -> bool {
        self.heights[0] == self.heights[self.heights.len() - 1]
    }

    fn area(&self) -> u64 {
        self.heights.iter().sum()
    }
}

/// Packs the items; where all sizes are multiples of the alignment, all offsets are.
pub(crate) fn pack(items: &[Item], node_limit: u64) -> Packing {
    let (bound, peak_step) = lower_bound(items);
    let (blocks, sections) = to_sections(items);
    let mut nodes = 0;
    let mut best = first_fit::search(&blocks, bound, node_limit / 8, &mut nodes);
    let mut status = PlanStatus::Optimal;
    if peak_of(&blocks, &best) > bound {
        status = improve(&blocks, sections, bound, node_limit, &mut best, &mut nodes);
    }
    let peak = peak_of(&blocks, &best);
    Packing { offsets: best, peak, bound, peak_step, status, nodes }
}

/// Stages 2 to 4.
fn improve(
    blocks: &[Block],
    sections: usize,
    bound: u64,
    node_limit: u64,
    best: &mut Vec<u64>,
    nodes: &mut u64,
) -> PlanStatus {
    let found = by_core(blocks, sections, bound, node_limit / 4, nodes)
        .or_else(|| by_joins(blocks, sections, bound, node_limit / 2, nodes));
    if let Some(offsets) = found {
        *best = offsets;
        return PlanStatus::Optimal;
    }
    let half = *nodes + node_limit.saturating_sub(*nodes) / 2;
    if let Outcome::Found(offsets) = skyline::search(blocks, sections, bound, half, nodes) {
        *best = offsets;
    }
    while peak_of(blocks, best) > bound {
        match skyline::search(blocks, sections, peak_of(blocks, best) - 1, node_limit, nodes) {
            Outcome::Found(offsets) => *best = offsets,
            Outcome::Exhausted => return PlanStatus::OptimalBoundNotReachable,
            Outcome::Limit => return PlanStatus::NodeLimit,
        }
    }
    PlanStatus::Optimal
}

/// Stage 2: packs the blocks at the peak exactly, the others around them.
fn by_core(blocks: &[Block], sections: usize, bound: u64, node_limit: u64, nodes: &mut u64) -> Option<Vec<u64>> {
    let sums = section_sums(blocks, sections);
    let mut in_core: Vec<bool> = blocks.iter().map(|b| sums[b.first..=b.last].contains(&bound)).collect();
    while in_core.contains(&false) {
        let (core, rest): (Vec<usize>, Vec<usize>) = (0..blocks.len()).partition(|&id| in_core[id]);
        let shapes: Vec<Block> = core.iter().map(|&id| blocks[id].clone()).collect();
        let Outcome::Found(bases) = skyline::search(&shapes, sections, bound, node_limit, nodes) else { return None };
        let mut offsets = vec![0; blocks.len()];
        core.iter().zip(bases).for_each(|(&id, base)| offsets[id] = base);
        *nodes += rest.len() as u64;
        let misfits = first_fit::place_around(blocks, core, rest, bound, &mut offsets);
        if misfits.is_empty() {
            return Some(offsets);
        }
        misfits.into_iter().for_each(|id| in_core[id] = true);
    }
    None
}

/// Stage 3: the exact search over blocks that were joined where there is no slack.
fn by_joins(blocks: &[Block], sections: usize, bound: u64, node_limit: u64, nodes: &mut u64) -> Option<Vec<u64>> {
    for attempt in 0..JOIN_ATTEMPTS {
        let joined = joins::join(blocks, sections, bound, attempt);
        if joined.len() == blocks.len() {
            return None;
        }
        let reduced: Vec<Block> = joined.iter().map(|j| j.block.clone()).collect();
        let limit = *nodes + node_limit.saturating_sub(*nodes) / (JOIN_ATTEMPTS - attempt);
        if let Outcome::Found(bases) = skyline::search(&reduced, sections, bound, limit, nodes) {
            let mut offsets = vec![0; blocks.len()];
            for (group, base) in joined.iter().zip(bases) {
                group.members.iter().for_each(|&(id, offset)| offsets[id] = base + offset);
            }
            return Some(offsets);
        }
    }
    None
}

fn section_sums(blocks: &[Block], sections: usize) -> Vec<u64> {
    let mut sums = vec![0; sections];
    blocks.iter().for_each(|b| (b.first..=b.last).for_each(|t| sums[t] += b.height(t)));
    sums
}

fn peak_of(blocks: &[Block], offsets: &[u64]) -> u64 {
    blocks.iter().zip(offsets).map(|(b, o)| o + b.heights[0]).max().unwrap_or(0)
}

/// Largest sum of live bytes, and the first step that has it.
fn lower_bound(items: &[Item]) -> (u64, u32) {
    let steps = items.iter().map(|i| i.spans[i.spans.len() - 1].last + 1).max().unwrap_or(0) as usize;
    let mut sums = vec![0_u64; steps];
    for span in items.iter().flat_map(|i| &i.spans) {
        (span.first..=span.last).for_each(|t| sums[t as usize] += span.bytes);
    }
    let bound = sums.iter().copied().max().unwrap_or(0);
    (bound, sums.iter().position(|&s| s == bound).unwrap_or(0) as u32)
}

/// Keeps only the steps whose live set is not covered by another's: what fits there fits everywhere.
fn to_sections(items: &[Item]) -> (Vec<Block>, usize) {
    let steps = items.iter().map(|i| i.spans[i.spans.len() - 1].last + 1).max().unwrap_or(0) as usize;
    let mut live: Vec<Vec<(usize, u64)>> = vec![Vec::new(); steps];
    for (id, item) in items.iter().enumerate() {
        for span in &item.spans {
            (span.first..=span.last).for_each(|t| live[t as usize].push((id, span.bytes)));
        }
    }
    let covered = |small: &[(usize, u64)], large: &[(usize, u64)]| {
        let mut rest = large.iter();
        small.iter().all(|s| rest.any(|l| l.0 == s.0 && l.1 >= s.1))
    };
    // An item that is live at two steps is live, and no smaller than at the later one, at all steps between: a set that
    // is covered at all is covered by a neighbor among the kept ones.
    let mut kept: Vec<Vec<(usize, u64)>> = Vec::new();
    for set in live {
        while kept.last().is_some_and(|last| covered(last, &set)) {
            kept.pop();
        }
        if kept.last().is_none_or(|last| !covered(&set, last)) {
            kept.push(set);
        }
    }
    let mut blocks: Vec<Option<Block>> = vec![None; items.len()];
    for (section, set) in kept.iter().enumerate() {
        for &(id, bytes) in set {
            let block = blocks[id].get_or_insert(Block { first: section, last: section, heights: Vec::new() });
            block.last = section;
            block.heights.push(bytes);
        }
    }
    (blocks.into_iter().map(|b| b.expect("every live item is in a kept section")).collect(), kept.len())
}
