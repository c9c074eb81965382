//! The memory plan as reports show it: one buffer per tensor and per scratch area.

use model_compiler::memory_plan::Placement;
use model_compiler::record::Record;
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

/// All buffers of the arena. Steps are positions in the program.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize, JsonSchema)]
pub struct MemoryReport {
    /// Position of the step with the largest sum of live bytes.
    pub peak_step: u32,
    /// Tensors in the order of the model, then scratch in the order of execution.
    pub buffers: Vec<Buffer>,
}

/// A tensor or the scratch of a step.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
pub struct Buffer {
    /// Tensor, or the step whose scratch it is.
    pub name: String,
    /// Scratch, live in one step only.
    pub scratch: bool,
    /// First byte in the arena.
    pub offset: u64,
    /// Size, bytes.
    pub bytes: u64,
    /// Step that writes it; 0 for inputs.
    pub first_step: u32,
    /// Last step that reads it; the last step for outputs.
    pub last_step: u32,
    /// The tensor whose memory it takes over in its first step.
    pub in_place_of: Option<String>,
}

impl MemoryReport {
    /// The plan of a record.
    pub fn of(record: &Record) -> Self {
        let (model, plan) = (&record.model, &record.plan);
        let buffer = |name: &str, scratch: bool, place: &Placement| Buffer {
            name: name.to_owned(),
            scratch,
            offset: place.offset,
            bytes: place.bytes,
            first_step: place.first_step,
            last_step: place.last_step,
            in_place_of: place.in_place_of.map(|id| model.tensor(id).name.clone()),
        };
        let tensors = model.tensors.iter().zip(&plan.tensors).map(|(tensor, place)| buffer(&tensor.name, false, place));
        let steps = plan.order.iter().map(|&step| &model.steps[step as usize].name);
        let scratch = steps.zip(&plan.scratch).filter_map(|(step, place)| Some(buffer(step, true, place.as_ref()?)));
        Self { peak_step: plan.peak_step, buffers: tensors.chain(scratch).collect() }
    }
}

#[cfg(test)]
pub(crate) mod tests {
    use super::*;
    use crate::testing::sample;
    use model_compiler::memory_plan::Placement;

    pub(crate) fn memory() -> MemoryReport {
        MemoryReport::of(&sample().record)
    }

    #[test]
    fn tensors_and_scratch_have_their_names() {
        let mut record = sample().record;
        record.plan.scratch[1] =
            Some(Placement { offset: 16, bytes: 8, first_step: 1, last_step: 1, in_place_of: None });
        record.plan.tensors[1].in_place_of = Some(model_compiler::qmodel::QTensorId(0));
        let buffers = MemoryReport::of(&record).buffers;
        let names: Vec<&str> = buffers.iter().map(|b| b.name.as_str()).collect();
        assert_eq!(names, ["rgb", "pool", "mean", "mean"]);
        assert!(buffers[3].scratch && !buffers[2].scratch);
        assert_eq!(buffers[1].in_place_of.as_deref(), Some("rgb"));
    }
}
