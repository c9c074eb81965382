//! Joins for packings without slack: blocks that end where others start, in the same space, become one block.
//!
//! Where neither side of a section boundary has slack, the blocks that end there free exactly the space that the blocks
//! that start there take. A set of enders with a common start and a set of starters with a common end, of equal sums,
//! are therefore likely to lie side by side; joined, they are one block, and the joined block finds partners in turn.
//! Cuts of a rectangle are undone this way, smallest first. A join is a guess (only one ender with one starter is
//! forced), so the exact search still has to place what remains.

use super::{Block, section_sums};
use std::collections::BTreeMap;

/// Largest number of blocks on one side of a boundary whose subsets are tried.
const MAX_SIDE: usize = 12;

/// Breaks ties, the same way on every machine.
struct Ties(u64);

impl Ties {
    /// Whether a match of `new` blocks replaces one of `known` blocks.
    fn prefer(&mut self, new: usize, known: usize) -> bool {
        if new != known || self.0 == 0 {
            return new < known;
        }
        // Knuth's MMIX generator; its high bits are good enough.
        self.0 = self.0.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
        self.0 >> 62 == 0
    }
}

/// A block made of blocks, each with its offset inside.
pub(super) struct Joined {
    pub block: Block,
    pub members: Vec<(usize, u64)>,
}

/// Joins as many blocks as possible at boundaries without slack at `capacity`. Among equally good matches attempt 0
/// takes the first, others a pseudorandom one.
pub(super) fn join(blocks: &[Block], sections: usize, capacity: u64, attempt: u64) -> Vec<Joined> {
    let mut ties = Ties(attempt);
    let sums = section_sums(blocks, sections);
    let mut groups: Vec<Joined> =
        blocks.iter().enumerate().map(|(id, b)| Joined { block: b.clone(), members: vec![(id, 0)] }).collect();
    let tight: Vec<usize> = (1..sections).filter(|&t| sums[t - 1] == capacity && sums[t] == capacity).collect();
    while let Some((enders, starters)) = smallest_match(&groups, &tight, &mut ties) {
        merge(&mut groups, &enders, &starters);
    }
    groups
}

/// The match with the fewest blocks over all boundaries.
fn smallest_match(groups: &[Joined], boundaries: &[usize], ties: &mut Ties) -> Option<(Vec<usize>, Vec<usize>)> {
    let mut best: Option<(Vec<usize>, Vec<usize>)> = None;
    for &start in boundaries {
        let mut enders: BTreeMap<usize, Vec<usize>> = BTreeMap::new();
        let mut starters: BTreeMap<usize, Vec<usize>> = BTreeMap::new();
        for (id, group) in groups.iter().enumerate().filter(|(_, g)| g.block.is_flat()) {
            if group.block.last + 1 == start {
                enders.entry(group.block.first).or_default().push(id);
            }
            if group.block.first == start {
                starters.entry(group.block.last).or_default().push(id);
            }
        }
        if enders.len() == 1 && starters.len() == 1 && all_flat(groups, start) {
            let (_, enders) = enders.pop_first()?;
            let (_, starters) = starters.pop_first()?;
            return Some((enders, starters));
        }
        let enders: Vec<_> = enders.values().map(|side| subsets(groups, side)).collect();
        let starters: Vec<_> = starters.values().map(|side| subsets(groups, side)).collect();
        for left in &enders {
            for right in &starters {
                for (sum, l) in left {
                    let Some(r) = right.get(sum) else { continue };
                    let known = best.as_ref().map_or(usize::MAX, |(a, b)| a.len() + b.len());
                    if ties.prefer(l.len() + r.len(), known) {
                        best = Some((l.clone(), r.clone()));
                    }
                }
            }
        }
    }
    best
}

fn all_flat(groups: &[Joined], start: usize) -> bool {
    groups.iter().filter(|g| g.block.last + 1 == start || g.block.first == start).all(|g| g.block.is_flat())
}

/// The smallest subset for every reachable sum of heights.
fn subsets(groups: &[Joined], side: &[usize]) -> BTreeMap<u64, Vec<usize>> {
    let mut found: BTreeMap<u64, Vec<usize>> = BTreeMap::new();
    for &id in side.iter().take(MAX_SIDE) {
        let height = groups[id].block.heights[0];
        let mut more: Vec<(u64, Vec<usize>)> = vec![(height, vec![id])];
        more.extend(found.iter().map(|(sum, set)| (sum + height, [set.as_slice(), &[id]].concat())));
        for (sum, set) in more {
            let known = found.entry(sum).or_insert_with(|| set.clone());
            if set.len() < known.len() {
                *known = set;
            }
        }
    }
    found
}

/// Replaces the blocks by one: each side stacked from the bottom.
fn merge(groups: &mut Vec<Joined>, enders: &[usize], starters: &[usize]) {
    let mut members = Vec::new();
    let mut height = 0;
    for side in [enders, starters] {
        height = 0;
        for &id in side {
            members.extend(groups[id].members.iter().map(|&(m, offset)| (m, offset + height)));
            height += groups[id].block.heights[0];
        }
    }
    let (first, last) = (groups[enders[0]].block.first, groups[starters[0]].block.last);
    let block = Block { first, last, heights: vec![height; last - first + 1] };
    let mut gone: Vec<usize> = enders.iter().chain(starters).copied().collect();
    gone.sort_unstable();
    gone.into_iter().rev().for_each(|id| drop(groups.swap_remove(id)));
    groups.push(Joined { block, members });
}
