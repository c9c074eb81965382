//! The memory plan as reports show it: one buffer per tensor and per scratch area.

use model_compiler::memory_plan::{ArenaPart, MemoryPlan, Placement, PlanStatus};
use model_compiler::record::Record;
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

/// All buffers of the arena. Steps are positions in the program.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize, JsonSchema)]
pub struct MemoryReport {
    /// Position of the step with the largest sum of live bytes, in all regions together.
    pub peak_step: u32,
    /// The memory regions, fastest first, where there are several; the arena of one is in the summary.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub regions: Vec<RegionReport>,
    /// Tensors in the order of the model, then scratch in the order of execution.
    pub buffers: Vec<Buffer>,
}

/// The arena in one of several memory regions.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
pub struct RegionReport {
    /// Name.
    pub name: String,
    /// Size of the region, bytes; `null`: unlimited.
    pub capacity_bytes: Option<u64>,
    /// Bytes of it that the arena uses.
    pub bytes: u64,
    /// Lower bound of the same, bytes.
    pub bound_bytes: u64,
    /// What is known about the difference.
    #[schemars(with = "String", extend("enum" = ["optimal", "optimal_bound_not_reachable", "node_limit"]))]
    pub status: PlanStatus,
    /// Position of the step with the largest sum of live bytes.
    pub peak_step: u32,
    /// Share of all bytes read and written, 0..1, by the measure of the planner.
    pub traffic_share: f64,
}

/// A tensor or the scratch of a step.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
pub struct Buffer {
    /// Tensor, or the step whose scratch it is.
    pub name: String,
    /// Scratch, live in one step only.
    pub scratch: bool,
    /// The memory region, where there are several.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub region: Option<String>,
    /// First byte in the arena, or in its part in the region.
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
        let several = plan.regions.len() > 1;
        let buffer = |name: &str, scratch: bool, place: &Placement| Buffer {
            name: name.to_owned(),
            scratch,
            region: several.then(|| plan.regions[usize::from(place.region)].name.clone()),
            offset: place.offset,
            bytes: place.bytes,
            first_step: place.first_step,
            last_step: place.last_step,
            in_place_of: place.in_place_of.map(|id| model.tensor(id).name.clone()),
        };
        let tensors = model.tensors.iter().zip(&plan.tensors).map(|(tensor, place)| buffer(&tensor.name, false, place));
        let steps = plan.order.iter().map(|&step| &model.steps[step as usize].name);
        let scratch = steps.zip(&plan.scratch).filter_map(|(step, place)| Some(buffer(step, true, place.as_ref()?)));
        let regions = plan.regions.iter().filter(|_| several).map(|part| RegionReport::of(plan, part));
        Self { peak_step: peak_step(plan), regions: regions.collect(), buffers: tensors.chain(scratch).collect() }
    }
}

impl RegionReport {
    fn of(plan: &MemoryPlan, part: &ArenaPart) -> Self {
        Self {
            name: part.name.clone(),
            capacity_bytes: part.capacity,
            bytes: part.bytes,
            bound_bytes: part.bound_bytes,
            status: part.status,
            peak_step: part.peak_step,
            traffic_share: plan.traffic_share(part),
        }
    }
}

fn peak_step(plan: &MemoryPlan) -> u32 {
    match plan.regions.as_slice() {
        [only] => only.peak_step,
        parts => {
            let live = |step: u32| (0..).zip(parts).map(|(region, _)| plan.live_bytes(region, step)).sum::<u64>();
            (0..plan.order.len() as u32).max_by_key(|&step| (live(step), std::cmp::Reverse(step))).unwrap_or(0)
        }
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
            Some(Placement { region: 0, offset: 16, bytes: 8, first_step: 1, last_step: 1, in_place_of: None });
        record.plan.tensors[1].in_place_of = Some(model_compiler::qmodel::QTensorId(0));
        let buffers = MemoryReport::of(&record).buffers;
        let names: Vec<&str> = buffers.iter().map(|b| b.name.as_str()).collect();
        assert_eq!(names, ["rgb", "pool", "mean", "mean"]);
        assert!(buffers[3].scratch && !buffers[2].scratch);
        assert_eq!(buffers[1].in_place_of.as_deref(), Some("rgb"));
    }

    /// The sample's plan with its first buffer in a region of its own.
    pub(crate) fn of_two_regions() -> MemoryReport {
        let mut record = sample().record;
        let main = record.plan.regions[0].clone();
        let fast = ArenaPart { name: "fast".into(), capacity: Some(64), bytes: 48, traffic_bytes: 48, ..main };
        record.plan.regions.insert(0, fast);
        (record.plan.tensors[1].region, record.plan.tensors[2].region) = (1, 1);
        MemoryReport::of(&record)
    }

    #[test]
    fn several_regions_are_named_and_one_goes_without_saying() {
        let one = serde_json::to_string(&memory()).unwrap();
        assert!(!one.contains("region"), "{one}");
        let report = of_two_regions();
        let regions: Vec<_> = report.buffers.iter().map(|buffer| buffer.region.as_deref().unwrap()).collect();
        assert_eq!(regions, ["fast", "main", "main"]);
        assert_eq!((report.regions[0].bytes, report.regions[0].traffic_share), (48, 0.25));
        let stored = serde_json::to_string(&report).unwrap();
        assert_eq!(serde_json::from_str::<MemoryReport>(&stored).unwrap(), report);
    }
}
