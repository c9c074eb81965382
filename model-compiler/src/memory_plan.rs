//! Static memory plan: an offset in the arena for every tensor and scratch buffer, with a proof of how good it is.
//!
//! Items are chains of tensors that take over each other's memory, and one scratch buffer per step. A chain keeps one
//! offset; at each step it is as large as its largest member live there, so a map that is pooled in place gives its
//! tail back. A tensor is live from the step that writes it (inputs: from the start) to the last that reads it
//! (outputs: to the end). No plan can be smaller than the largest sum of live bytes; the solver stops when it gets
//! there, when its search is exhausted, or at a limit of search nodes. It never looks at a clock: same input, same
//! plan.

use crate::error::{Error, ErrorCode, Result};
use crate::qmodel::QModel;
use crate::qmodel::QTensorId;
use crate::schedule;
use crate::target::Target;
use firmware::program::KernelId;
use needs::Needs;
use serde::{Deserialize, Serialize};
use solver::{Item, Packing, Span};

mod check;
mod in_place;
mod needs;
mod solver;

pub use check::check;
pub(crate) use needs::Needs as MemoryNeeds;

/// Alignment of scratch buffers inside the arena, bytes (kernels put wide words there).
pub const SCRATCH_ALIGNMENT: u64 = 16;

/// Where a buffer lies and when it is live, in positions of the execution order (inclusive).
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct Placement {
    /// First byte in the arena.
    pub offset: u64,
    /// Size in bytes, without rounding.
    pub bytes: u64,
    /// Position of the step that writes it; 0 for inputs.
    pub first_step: u32,
    /// Position of the last step that reads it; the last step for outputs.
    pub last_step: u32,
    /// The tensor whose memory it takes over in the step that writes it.
    pub in_place_of: Option<QTensorId>,
}

/// What is known about the distance of a plan from the best one (for its order and in-place choices).
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum PlanStatus {
    /// The arena equals the lower bound.
    Optimal,
    /// The search is exhausted: no plan reaches the lower bound.
    OptimalBoundNotReachable,
    /// The search stopped at its node limit; the gap to the bound is what could be left.
    NodeLimit,
}

impl PlanStatus {
    /// What people read.
    pub const fn words(self) -> &'static str {
        match self {
            Self::Optimal => "optimal",
            Self::OptimalBoundNotReachable => "optimal, the bound is not reachable",
            Self::NodeLimit => "search stopped at its node limit",
        }
    }
}

/// The plan of one model for one target.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct MemoryPlan {
    /// Execution order: indices into [`crate::qmodel::QModel::steps`].
    pub order: Vec<u32>,
    /// Per tensor of the model.
    pub tensors: Vec<Placement>,
    /// Scratch per position of the execution order.
    pub scratch: Vec<Option<Placement>>,
    /// Kernel per position of the execution order, where the step is weighted.
    pub kernels: Vec<Option<KernelId>>,
    /// Size of the arena, bytes.
    pub arena_bytes: u64,
    /// Lower bound: the largest sum of live bytes over the steps.
    pub bound_bytes: u64,
    /// Position of the step with that sum.
    pub peak_step: u32,
    /// Proof status.
    pub status: PlanStatus,
    /// Search nodes used.
    pub nodes: u64,
    /// Every offset and size is rounded to this, bytes.
    pub alignment: u32,
}

/// What a plan may do.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct PlanOptions {
    /// Let a max pool write over the front of its input where its row order allows.
    pub in_place_pooling: bool,
    /// Let sums and attention write over an operand.
    pub in_place: bool,
    /// Limit of search nodes of the placement; the order search stops there too, at the latest after 250 000.
    pub node_limit: u64,
    /// Look for the order with the least bound; otherwise the model's own order is kept.
    pub search_order: bool,
    /// Every offset and size is a multiple of this: a power of two, 4..=4096.
    pub alignment: u32,
}

impl Default for PlanOptions {
    fn default() -> Self {
        Self { in_place_pooling: true, in_place: true, node_limit: 2_000_000, search_order: true, alignment: 4 }
    }
}

impl PlanOptions {
    /// Everything allowed, with the target's alignment.
    pub fn for_target(target: &Target) -> Self {
        Self { alignment: target.alignment, ..Self::default() }
    }
}

/// Limit of nodes of the order search, which keeps a set of finished steps per node.
const MAX_ORDER_NODES: u64 = 250_000;

/// Largest number of in-place pairs that are tried without, where a plan with all of them misses the bound.
const MAX_DROPPED_PAIRS: usize = 16;

/// Chooses kernels, order, in-place pairs and offsets.
///
/// # Errors
/// The alignment is out of range, the target lists no kernel, or the model's steps do not fit together (a tensor
/// written twice or read before it is written).
pub fn plan(model: &QModel, target: &Target, options: &PlanOptions) -> Result<MemoryPlan> {
    if !options.alignment.is_power_of_two() || !(4..=4096).contains(&options.alignment) {
        let message = format!("found {}, expected a power of two from 4 to 4096", options.alignment);
        return Err(Error::new(ErrorCode::Usage, "alignment", message));
    }
    let needs = Needs::of(model, target, options)?;
    let order_nodes = if options.search_order { options.node_limit.min(MAX_ORDER_NODES) } else { 0 };
    let schedule = schedule::search(&needs, order_nodes);
    let ranges = needs.live_ranges(&schedule.order);
    let pairs = needs.pairs(&schedule.order, &ranges);
    let (pairs, items, packing) = best_pairs(&needs, &schedule.order, &ranges, pairs, options.node_limit);
    Ok(MemoryPlan {
        order: schedule.order.iter().map(|&s| s as u32).collect(),
        tensors: tensor_placements(&needs, &ranges, &pairs, &items, &packing),
        scratch: scratch_placements(&needs, &schedule.order, &items, &packing),
        kernels: schedule.order.iter().map(|&step| needs.kernels[step]).collect(),
        arena_bytes: packing.peak,
        bound_bytes: packing.bound,
        peak_step: packing.peak_step,
        status: packing.status,
        nodes: schedule.nodes + packing.nodes,
        alignment: options.alignment,
    })
}

/// First and last position of a tensor.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) struct LiveRange {
    pub first: u32,
    pub last: u32,
}

/// An in-place choice per tensor: the tensor it takes over.
pub(crate) type Pairs = Vec<Option<usize>>;

/// Items with their meaning: the tensors of a chain, or the scratch of a position.
struct Items {
    shapes: Vec<Item>,
    /// Item per tensor.
    of_tensor: Vec<usize>,
    /// Item per position.
    of_scratch: Vec<Option<usize>>,
}

/// All pairs, or one fewer where that makes a smaller arena: the bound is least with all of them, but a chain is harder
/// to place than its parts. Chains live at the peak are tried first.
fn best_pairs(
    needs: &Needs,
    order: &[usize],
    ranges: &[LiveRange],
    all: Pairs,
    node_limit: u64,
) -> (Pairs, Items, Packing) {
    let items = items(needs, order, ranges, &all);
    let packing = solver::pack(&items.shapes, node_limit);
    let mut nodes = packing.nodes;
    let at_peak = |t: &usize| {
        let spans = &items.shapes[items.of_tensor[*t]].spans;
        spans.iter().any(|s| (s.first..=s.last).contains(&packing.peak_step))
    };
    let mut taken: Vec<usize> = (0..all.len()).filter(|&t| all[t].is_some()).collect();
    taken.sort_by_key(|t| !at_peak(t));
    let mut best = (all.clone(), items, packing);
    for &tensor in taken.iter().take(MAX_DROPPED_PAIRS) {
        if best.2.peak == best.2.bound {
            break;
        }
        let mut fewer = all.clone();
        fewer[tensor] = None;
        let items = self::items(needs, order, ranges, &fewer);
        let packing = solver::pack(&items.shapes, node_limit / MAX_DROPPED_PAIRS as u64);
        nodes += packing.nodes;
        if packing.peak < best.2.peak {
            best = (fewer, items, packing);
        }
    }
    best.2.nodes = nodes;
    best
}

fn items(needs: &Needs, order: &[usize], ranges: &[LiveRange], pairs: &Pairs) -> Items {
    let mut items =
        Items { shapes: Vec::new(), of_tensor: vec![usize::MAX; ranges.len()], of_scratch: vec![None; order.len()] };
    let mut by_start: Vec<usize> = (0..ranges.len()).collect();
    by_start.sort_by_key(|&t| (ranges[t].first, pairs[t].is_some()));
    // What is taken over comes before its taker; an input may share position 0 with it.
    for tensor in by_start {
        let LiveRange { first, last } = ranges[tensor];
        let span = Span { first, last, bytes: needs.tensor_bytes[tensor] };
        match pairs[tensor] {
            None => {
                items.of_tensor[tensor] = items.shapes.len();
                items.shapes.push(Item { spans: vec![span] });
            }
            Some(operand) => {
                let item = items.of_tensor[operand];
                items.of_tensor[tensor] = item;
                if last > first {
                    items.shapes[item].spans.push(Span { first: first + 1, ..span });
                }
            }
        }
    }
    for (position, &step) in order.iter().enumerate() {
        let bytes = needs.scratch_room(step);
        if bytes > 0 {
            items.of_scratch[position] = Some(items.shapes.len());
            let position = position as u32;
            items.shapes.push(Item { spans: vec![Span { first: position, last: position, bytes }] });
        }
    }
    items
}

fn tensor_placements(
    needs: &Needs,
    ranges: &[LiveRange],
    pairs: &Pairs,
    items: &Items,
    packing: &Packing,
) -> Vec<Placement> {
    (0..ranges.len())
        .map(|t| Placement {
            offset: packing.offsets[items.of_tensor[t]],
            bytes: needs.exact_bytes[t],
            first_step: ranges[t].first,
            last_step: ranges[t].last,
            in_place_of: pairs[t].map(|operand| QTensorId(operand as u32)),
        })
        .collect()
}

fn scratch_placements(needs: &Needs, order: &[usize], items: &Items, packing: &Packing) -> Vec<Option<Placement>> {
    (0..order.len())
        .map(|position| {
            let item = items.of_scratch[position]?;
            Some(Placement {
                offset: packing.offsets[item].next_multiple_of(SCRATCH_ALIGNMENT),
                bytes: needs.scratch[order[position]],
                first_step: position as u32,
                last_step: position as u32,
                in_place_of: None,
            })
        })
        .collect()
}
