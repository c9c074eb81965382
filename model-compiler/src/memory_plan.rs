//! Static memory plan: a place in memory for every tensor and scratch buffer, with a proof of how good it is.
//!
//! Items are chains of tensors that take over each other's memory, and one scratch buffer per step. A chain keeps one
//! offset; at each step it is as large as its largest member live there, so a map that is pooled in place gives its
//! tail back. A tensor is live from the step that writes it (inputs: from the start) to the last that reads it
//! (outputs: to the end). No plan can be smaller than the largest sum of live bytes; the solver stops when it gets
//! there, when its search is exhausted, or at a limit of search nodes. It never looks at a clock: same input, same
//! plan.
//!
//! Where a target has several memories, each item goes to one of them first (`spread`: the hottest traffic into the
//! fastest), and each is packed and judged by itself.

use crate::error::{Error, ErrorCode, Result};
use crate::qmodel::QModel;
use crate::qmodel::QTensorId;
use crate::schedule;
use crate::target::{Region, Target};
use firmware::program::KernelId;
use needs::Needs;
use serde::{Deserialize, Serialize};
use solver::{Item, Packing, Span};

mod check;
mod in_place;
mod needs;
mod solver;
mod spread;
mod traffic;

pub use check::check;
pub(crate) use needs::Needs as MemoryNeeds;

/// Alignment of scratch buffers inside the arena, bytes (kernels put wide words there).
pub const SCRATCH_ALIGNMENT: u64 = 16;

/// Where a buffer lies and when it is live, in positions of the execution order (inclusive).
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct Placement {
    /// Region of the arena, a position in [`MemoryPlan::regions`].
    pub region: u8,
    /// First byte in the region.
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

/// What the arena is in one memory region.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct ArenaPart {
    /// Name of the region.
    pub name: String,
    /// Size of the region, bytes; `None`: unlimited.
    pub capacity: Option<u64>,
    /// Bytes of it that the plan uses.
    pub bytes: u64,
    /// Lower bound for the items that lie there: the largest sum of live bytes over the steps.
    pub bound_bytes: u64,
    /// Position of the step with that sum.
    pub peak_step: u32,
    /// Proof status.
    pub status: PlanStatus,
    /// Bytes that an inference reads and writes there, by the measure of the planner.
    pub traffic_bytes: u64,
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
    /// The arena by memory region, in the target's order: fastest first, at least one.
    pub regions: Vec<ArenaPart>,
    /// Search nodes used.
    pub nodes: u64,
    /// Every offset and size is rounded to this, bytes.
    pub alignment: u32,
}

impl MemoryPlan {
    /// Size of the arena in all regions together, bytes.
    pub fn arena_bytes(&self) -> u64 {
        self.regions.iter().map(|part| part.bytes).sum()
    }

    /// Lower bound of the same.
    pub fn bound_bytes(&self) -> u64 {
        self.regions.iter().map(|part| part.bound_bytes).sum()
    }

    /// What is known about all regions together: that of the one of which least is known.
    pub fn status(&self) -> PlanStatus {
        let least = |status: &PlanStatus| match status {
            PlanStatus::Optimal => 0,
            PlanStatus::OptimalBoundNotReachable => 1,
            PlanStatus::NodeLimit => 2,
        };
        self.regions.iter().map(|part| part.status).max_by_key(least).unwrap_or(PlanStatus::Optimal)
    }

    /// Share of all traffic that a region has, 0..=1.
    pub fn traffic_share(&self, part: &ArenaPart) -> f64 {
        let all: u64 = self.regions.iter().map(|part| part.traffic_bytes).sum();
        part.traffic_bytes as f64 / all.max(1) as f64
    }

    /// Rounded bytes that are live in a region at a position; what is written in place there is counted once.
    pub fn live_bytes(&self, region: u8, position: u32) -> u64 {
        let alignment = u64::from(self.alignment).max(1);
        let live = |p: &&Placement| p.region == region && (p.first_step..=p.last_step).contains(&position);
        let taken = |p: &&Placement| p.in_place_of.is_some() && p.first_step == position;
        let tensors = self.tensors.iter().filter(live).filter(|p| !taken(p));
        let scratch = self.scratch.get(position as usize).and_then(Option::as_ref).filter(live);
        tensors.map(|p| p.bytes.next_multiple_of(alignment)).sum::<u64>()
            + scratch.map_or(0, |p| needs::scratch_room(p.bytes, alignment))
    }
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
    let job = Job { needs: &needs, order: &schedule.order, ranges: &ranges, node_limit: options.node_limit };
    let layout = match target.regions.as_slice() {
        [] => return Err(Error::new(ErrorCode::Usage, format!("target {}", target.name), "no memory is listed")),
        [_] => best_pairs(&job, pairs),
        regions => spread::spread(&job, &pairs, &regions.iter().map(|region| region.bytes).collect::<Vec<_>>()),
    };
    let traffic = layout.items.traffic(&needs, &schedule.order);
    let part = |(number, region): (usize, &Region)| {
        let packing = &layout.packings[number];
        let here = |(item, bytes): (usize, u64)| (layout.region_of[item] == number).then_some(bytes);
        ArenaPart {
            name: region.name.clone(),
            capacity: region.bytes,
            bytes: packing.peak,
            bound_bytes: packing.bound,
            peak_step: packing.peak_step,
            status: packing.status,
            traffic_bytes: traffic.iter().copied().enumerate().filter_map(here).sum(),
        }
    };
    Ok(MemoryPlan {
        order: schedule.order.iter().map(|&s| s as u32).collect(),
        tensors: tensor_placements(&job, &layout),
        scratch: scratch_placements(&job, &layout),
        kernels: schedule.order.iter().map(|&step| needs.kernels[step]).collect(),
        regions: target.regions.iter().enumerate().map(part).collect(),
        nodes: schedule.nodes + layout.packings.iter().map(|packing| packing.nodes).sum::<u64>(),
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

/// What is to be placed.
struct Job<'a> {
    needs: &'a Needs,
    order: &'a [usize],
    ranges: &'a [LiveRange],
    node_limit: u64,
}

/// Where everything lies.
struct Layout {
    pairs: Pairs,
    items: Items,
    /// Region per item.
    region_of: Vec<usize>,
    /// Offset per item, in its region.
    offsets: Vec<u64>,
    /// Per region.
    packings: Vec<Packing>,
}

/// Items with their meaning: the tensors of a chain, or the scratch of a position.
struct Items {
    shapes: Vec<Item>,
    /// Item per tensor.
    of_tensor: Vec<usize>,
    /// Item per position.
    of_scratch: Vec<Option<usize>>,
}

impl Items {
    /// Traffic per item.
    fn traffic(&self, needs: &Needs, order: &[usize]) -> Vec<u64> {
        let mut traffic = vec![0; self.shapes.len()];
        self.of_tensor.iter().zip(&needs.tensor_traffic).for_each(|(&item, bytes)| traffic[item] += bytes);
        for (item, &step) in self.of_scratch.iter().zip(order) {
            item.iter().for_each(|&item| traffic[item] += needs.scratch_traffic[step]);
        }
        traffic
    }
}

/// All pairs, or one fewer where that makes a smaller arena: the bound is least with all of them, but a chain is harder
/// to place than its parts. Chains live at the peak are tried first.
fn best_pairs(job: &Job<'_>, all: Pairs) -> Layout {
    let items = items(job, &all);
    let packing = solver::pack(&items.shapes, job.node_limit);
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
        let items = self::items(job, &fewer);
        let packing = solver::pack(&items.shapes, job.node_limit / MAX_DROPPED_PAIRS as u64);
        nodes += packing.nodes;
        if packing.peak < best.2.peak {
            best = (fewer, items, packing);
        }
    }
    let (pairs, items, mut packing) = best;
    packing.nodes = nodes;
    let region_of = vec![0; items.shapes.len()];
    Layout { pairs, items, region_of, offsets: packing.offsets.clone(), packings: vec![packing] }
}

fn items(job: &Job<'_>, pairs: &Pairs) -> Items {
    let Job { needs, order, ranges, .. } = *job;
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

fn tensor_placements(job: &Job<'_>, layout: &Layout) -> Vec<Placement> {
    (0..job.ranges.len())
        .map(|t| {
            let item = layout.items.of_tensor[t];
            Placement {
                region: layout.region_of[item] as u8,
                offset: layout.offsets[item],
                bytes: job.needs.exact_bytes[t],
                first_step: job.ranges[t].first,
                last_step: job.ranges[t].last,
                in_place_of: layout.pairs[t].map(|operand| QTensorId(operand as u32)),
            }
        })
        .collect()
}

fn scratch_placements(job: &Job<'_>, layout: &Layout) -> Vec<Option<Placement>> {
    (0..job.order.len())
        .map(|position| {
            let item = layout.items.of_scratch[position]?;
            Some(Placement {
                region: layout.region_of[item] as u8,
                offset: layout.offsets[item].next_multiple_of(SCRATCH_ALIGNMENT),
                bytes: job.needs.scratch[job.order[position]],
                first_step: position as u32,
                last_step: position as u32,
                in_place_of: None,
            })
        })
        .collect()
}
