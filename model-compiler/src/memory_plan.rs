//! Static memory plan: an offset in the arena for every tensor and scratch buffer, with a proof of how good it is.

use crate::qmodel::QTensorId;
use serde::{Deserialize, Serialize};

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
pub enum PlanStatus {
    /// The arena equals the lower bound.
    Optimal,
    /// The search is exhausted: no plan reaches the lower bound.
    OptimalBoundNotReachable,
    /// The search stopped at its node limit; the gap to the bound is what could be left.
    NodeLimit,
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
