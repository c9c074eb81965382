//! Exact search for a packing below a capacity: blocks are put down on a skyline, lowest level first.
//!
//! Each section has a *floor*: nothing unplaced may lie below it. A move either puts a block on a stretch of equal
//! floor, or *closes* a section at the lowest level: nothing will start there, so its floor rises to the next level and
//! the space between is lost. `slack = capacity − floor − (heights still to come)` is what a section may lose; where it
//! is zero, a stretch between two walls must be filled exactly, so some block starts at its left end and some block
//! ends at its right end. The corner with the fewest such blocks is branched on first.
//!
//! Only canonical packings are enumerated, those with the least sum of offsets: every block rests on another or on the
//! ground, no unplaced block fits into a closed gap, stacked blocks of the same sections lie in order of size, and of
//! equal blocks the first is taken first.

use super::Block;

/// How a search ended.
pub(super) enum Outcome {
    /// Offsets of a packing within the capacity.
    Found(Vec<u64>),
    /// There is none.
    Exhausted,
    /// The limit of nodes was reached.
    Limit,
}

/// Searches for a packing with `peak <= capacity`; `nodes` counts on, up to `node_limit`.
pub(super) fn search(blocks: &[Block], sections: usize, capacity: u64, node_limit: u64, nodes: &mut u64) -> Outcome {
    let mut state = State::new(blocks, sections, capacity);
    if state.sections.iter().any(|s| s.rest > capacity) {
        return Outcome::Exhausted;
    }
    let mut frames: Vec<Frame> = Vec::new();
    loop {
        match state.choose() {
            Choice::Done => return Outcome::Found(state.offsets.iter().map(|o| o.unwrap_or(0)).collect()),
            Choice::Dead => {}
            Choice::Moves(moves) => frames.push(Frame { moves: moves.into_iter(), undo: state.mark() }),
        }
        loop {
            let Some(frame) = frames.last_mut() else { return Outcome::Exhausted };
            state.undo(&frame.undo);
            let Some(next) = frame.moves.next() else {
                frames.pop();
                continue;
            };
            if *nodes >= node_limit {
                return Outcome::Limit;
            }
            *nodes += 1;
            if state.apply(next) {
                break;
            }
        }
    }
}

struct Frame {
    moves: std::vec::IntoIter<Move>,
    undo: Mark,
}

#[derive(Clone, Copy)]
enum Move {
    Place { block: usize, offset: u64 },
    Close { section: usize },
}

enum Choice {
    Done,
    Dead,
    Moves(Vec<Move>),
}

#[derive(Clone, Copy)]
struct Mark {
    trail: usize,
    placed: usize,
}

/// One section of time.
#[derive(Clone, Copy)]
struct Section {
    /// Nothing unplaced lies below.
    floor: u64,
    /// Top of what is placed; below `floor` where space was lost.
    top: u64,
    /// The topmost block.
    under: Option<usize>,
    /// Nothing will start at the present floor.
    closed: bool,
    /// Sum of unplaced heights.
    rest: u64,
    /// Number of unplaced blocks.
    count: u32,
}

struct State<'a> {
    blocks: &'a [Block],
    capacity: u64,
    sections: Vec<Section>,
    offsets: Vec<Option<u64>>,
    by_first: Vec<Vec<usize>>,
    by_last: Vec<Vec<usize>>,
    trail: Vec<(usize, Section)>,
    placed: Vec<usize>,
}

impl<'a> State<'a> {
    fn new(blocks: &'a [Block], sections: usize, capacity: u64) -> Self {
        let empty = Section { floor: 0, top: 0, under: None, closed: false, rest: 0, count: 0 };
        let mut state = Self {
            blocks,
            capacity,
            sections: vec![empty; sections],
            offsets: vec![None; blocks.len()],
            by_first: vec![Vec::new(); sections],
            by_last: vec![Vec::new(); sections],
            trail: Vec::new(),
            placed: Vec::new(),
        };
        for (id, block) in blocks.iter().enumerate() {
            state.by_first[block.first].push(id);
            state.by_last[block.last].push(id);
            for section in block.first..=block.last {
                state.sections[section].rest += block.height(section);
                state.sections[section].count += 1;
            }
        }
        let order = |&id: &usize| (std::cmp::Reverse(blocks[id].area()), id);
        state.by_first.iter_mut().chain(&mut state.by_last).for_each(|list| list.sort_by_key(order));
        state
    }

    fn mark(&self) -> Mark {
        Mark { trail: self.trail.len(), placed: self.placed.len() }
    }

    fn undo(&mut self, mark: &Mark) {
        for (section, old) in self.trail.drain(mark.trail..).rev() {
            self.sections[section] = old;
        }
        for block in self.placed.drain(mark.placed..) {
            self.offsets[block] = None;
        }
    }

    fn change(&mut self, section: usize) -> &mut Section {
        self.trail.push((section, self.sections[section]));
        &mut self.sections[section]
    }

    /// Carries out a move; false if it leads nowhere.
    fn apply(&mut self, next: Move) -> bool {
        match next {
            Move::Place { block, offset } => {
                let shape = &self.blocks[block];
                for section in shape.first..=shape.last {
                    let height = shape.height(section);
                    let s = self.change(section);
                    s.top = offset + height;
                    s.floor = s.top;
                    s.under = Some(block);
                    s.rest -= height;
                    s.count -= 1;
                }
                self.offsets[block] = Some(offset);
                self.placed.push(block);
            }
            Move::Close { section } => self.change(section).closed = true,
        }
        self.settle()
    }

    /// Raises closed sections once nothing is open at the lowest level; false if more is lost than the slack.
    fn settle(&mut self) -> bool {
        loop {
            let active = || self.sections.iter().filter(|s| s.count > 0);
            let Some(lowest) = active().map(|s| s.floor).min() else { return true };
            if active().any(|s| s.floor == lowest && !s.closed) {
                return true;
            }
            let Some(next) = active().filter(|s| s.floor > lowest).map(|s| s.floor).min() else { return false };
            for section in 0..self.sections.len() {
                let s = self.sections[section];
                if s.count > 0 && s.closed {
                    if next + s.rest > self.capacity {
                        return false;
                    }
                    let s = self.change(section);
                    s.floor = next;
                    s.closed = false;
                }
            }
            if self.gap_could_be_filled(next) {
                return false;
            }
        }
    }

    /// Whether an unplaced block fits between the tops and floors of sections raised to `level`.
    fn gap_could_be_filled(&self, level: u64) -> bool {
        let raised = |s: &Section| s.count > 0 && s.floor == level && s.top < level;
        (0..self.sections.len()).filter(|&t| raised(&self.sections[t])).any(|start| {
            self.by_first[start].iter().any(|&id| {
                let block = &self.blocks[id];
                if self.offsets[id].is_some() || block.heights[0] > level - self.sections[start].top {
                    return false;
                }
                let range = &self.sections[block.first..=block.last];
                let base = range.iter().map(|s| s.top).max().unwrap_or(0);
                range.iter().zip(&block.heights).all(|(s, h)| base + h <= s.floor)
            })
        })
    }

    /// The corner with the fewest possibilities; all of them are moves.
    fn choose(&self) -> Choice {
        let n = self.sections.len();
        let mut best: Option<Vec<Move>> = None;
        let mut lowest: Option<(u64, usize, usize)> = None;
        let mut start = 0;
        while start < n {
            let s = self.sections[start];
            if s.count == 0 || s.closed {
                start += 1;
                continue;
            }
            let same = |t: &Section| t.count > 0 && !t.closed && t.floor == s.floor;
            let mut end = start;
            while end + 1 < n && same(&self.sections[end + 1]) {
                end += 1;
            }
            if lowest.is_none_or(|(floor, ..)| s.floor < floor) {
                lowest = Some((s.floor, start, end));
            }
            let walled =
                (start == 0 || self.is_wall(start - 1, s.floor)) && (end + 1 == n || self.is_wall(end + 1, s.floor));
            if walled {
                for (corner, list) in [(start, &self.by_first[start]), (end, &self.by_last[end])] {
                    if self.slack(corner) > 0 {
                        continue;
                    }
                    let moves = self.fitting(list, start, end);
                    if moves.is_empty() {
                        return Choice::Dead;
                    }
                    if best.as_ref().is_none_or(|b| moves.len() < b.len()) {
                        best = Some(moves);
                    }
                }
            }
            start = end + 1;
        }
        let Some((_, start, end)) = lowest else { return Choice::Done };
        Choice::Moves(best.unwrap_or_else(|| {
            let mut moves = self.fitting(&self.by_first[start], start, end);
            if self.slack(start) > 0 {
                moves.push(Move::Close { section: start });
            }
            moves
        }))
    }

    fn is_wall(&self, section: usize, floor: u64) -> bool {
        let s = &self.sections[section];
        s.count == 0 || s.floor > floor || (s.floor == floor && s.closed)
    }

    fn slack(&self, section: usize) -> u64 {
        let s = &self.sections[section];
        self.capacity - s.floor - s.rest
    }

    /// Blocks of `list` that may be put down within the level stretch `start ..= end`.
    fn fitting(&self, list: &[usize], start: usize, end: usize) -> Vec<Move> {
        let mut found: Vec<usize> = Vec::new();
        for &id in list {
            let block = &self.blocks[id];
            let fits = self.offsets[id].is_none() && block.first >= start && block.last <= end;
            if fits && self.is_canonical(id) && !found.iter().any(|&other| self.blocks[other] == *block) {
                found.push(id);
            }
        }
        let offset = self.sections[start].floor;
        found.into_iter().map(|block| Move::Place { block, offset }).collect()
    }

    /// Rests on something, and is not smaller than a block of the same sections directly below.
    fn is_canonical(&self, id: usize) -> bool {
        let block = &self.blocks[id];
        let range = &self.sections[block.first..=block.last];
        if range.iter().all(|s| s.top < s.floor) {
            return false;
        }
        let Some(under) = range[0].under else { return true };
        let below = &self.blocks[under];
        let stacked = below.first == block.first
            && below.last == block.last
            && range.iter().all(|s| s.top == s.floor)
            && below.is_flat()
            && block.is_flat()
            && range.iter().all(|s| s.under == Some(under));
        !stacked || (below.heights[0], under) <= (block.heights[0], id)
    }
}
