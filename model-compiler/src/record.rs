//! The build record (`OUT.record`): what an image was made of. Never flashed; the evidence that `verify` runs on.

use crate::memory_plan::MemoryPlan;
use crate::qmodel::QModel;
use serde::{Deserialize, Serialize};

/// Everything the host needs to check an image: the integers before packing, the plan, and the image's digest.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Record {
    /// SHA-256 of the image file.
    pub image_sha256: [u8; 32],
    /// Target name.
    pub target: String,
    /// The quantized model. Position i of the image executes `model.steps[plan.order[i]]`; tensor i of the image's
    /// table is `model.tensors[i]`, scratch records follow.
    pub model: QModel,
    /// The memory plan.
    pub plan: MemoryPlan,
}
