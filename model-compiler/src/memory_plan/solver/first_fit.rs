//! First fit: blocks in some order, each at the lowest free offset; what sticks out is moved to the front and the
//! placement repeated.

use super::{Block, peak_of};

/// Rounds of moving blocks to the front, per starting order.
const ROUNDS: usize = 40;

/// Best offsets found; stops at `bound` or `node_limit`, but always completes one placement.
pub(super) fn search(blocks: &[Block], bound: u64, node_limit: u64, nodes: &mut u64) -> Vec<u64> {
    let mut best: Option<(u64, Vec<u64>)> = None;
    for key in KEYS {
        let mut order: Vec<usize> = (0..blocks.len()).collect();
        order.sort_by_key(|&i| std::cmp::Reverse(key(&blocks[i])));
        for _ in 0..ROUNDS {
            let offsets = place(blocks, &order);
            *nodes += blocks.len() as u64;
            let peak = peak_of(blocks, &offsets);
            let misfits: Vec<usize> =
                order.iter().copied().filter(|&i| offsets[i] + blocks[i].heights[0] > bound).collect();
            if best.as_ref().is_none_or(|(b, _)| peak < *b) {
                best = Some((peak, offsets));
            }
            if misfits.is_empty() || *nodes >= node_limit {
                break;
            }
            order.retain(|i| !misfits.contains(i));
            order.splice(0..0, misfits);
        }
        if best.as_ref().is_some_and(|(b, _)| *b == bound) || *nodes >= node_limit {
            break;
        }
    }
    best.map(|(_, offsets)| offsets).unwrap_or_default()
}

/// Places `rest`, largest first, around `placed`; returns those that end above `capacity`.
pub(super) fn place_around(
    blocks: &[Block],
    mut placed: Vec<usize>,
    mut rest: Vec<usize>,
    capacity: u64,
    offsets: &mut [u64],
) -> Vec<usize> {
    rest.sort_by_key(|&i| std::cmp::Reverse(KEYS[0](&blocks[i])));
    let mut misfits = Vec::new();
    for i in rest {
        offsets[i] = lowest_fit(blocks, offsets, &placed, i);
        placed.push(i);
        if offsets[i] + blocks[i].heights[0] > capacity {
            misfits.push(i);
        }
    }
    misfits
}

/// What blocks are sorted by.
type Key = fn(&Block) -> (u64, u64);

/// Orders to start from, largest key first.
const KEYS: [Key; 4] = [
    |b| (b.heights[0], b.heights.len() as u64),
    |b| (b.area(), b.heights[0]),
    |b| (b.heights.len() as u64, b.heights[0]),
    |b| (u64::MAX - b.first as u64, b.heights[0]),
];

fn place(blocks: &[Block], order: &[usize]) -> Vec<u64> {
    let mut offsets = vec![0; blocks.len()];
    for (done, &i) in order.iter().enumerate() {
        offsets[i] = lowest_fit(blocks, &offsets, &order[..done], i);
    }
    offsets
}

/// Lowest offset at which block `i` clashes with none of the placed ones.
fn lowest_fit(blocks: &[Block], offsets: &[u64], placed: &[usize], i: usize) -> u64 {
    // Per neighbor the forbidden open interval of offsets: (its offset − our height there, its top there).
    let mut forbidden: Vec<(u64, u64)> = placed
        .iter()
        .filter_map(|&j| {
            let below = blocks[i].separation(&blocks[j])?;
            let above = blocks[j].separation(&blocks[i])?;
            Some(((offsets[j] + 1).saturating_sub(below), offsets[j] + above))
        })
        .collect();
    forbidden.sort_unstable();
    let mut offset = 0;
    for (from, to) in forbidden {
        if offset < from {
            break;
        }
        offset = offset.max(to);
    }
    offset
}
