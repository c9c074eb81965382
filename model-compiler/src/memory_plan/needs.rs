//! What schedule and placement need to know of a model: sizes, readers, scratch, and what may be overwritten.

use super::in_place::overwritable;
use super::traffic::traffic;
use super::{LiveRange, Pairs, PlanOptions, SCRATCH_ALIGNMENT};
use crate::error::{Error, ErrorCode, Result};
use crate::qmodel::{QModel, QOp, QTensorId};
use crate::target::Target;
use firmware::kernels::plan;
use firmware::program::KernelId;

/// A model reduced to memory. Tensors and steps are indices into the model's.
#[derive(Clone, Debug)]
pub(crate) struct Needs {
    /// Size per tensor.
    pub exact_bytes: Vec<u64>,
    /// Size per tensor, rounded up to the alignment.
    pub tensor_bytes: Vec<u64>,
    /// Model outputs stay to the end.
    pub is_output: Vec<bool>,
    /// Model inputs are there from the start.
    pub is_input: Vec<bool>,
    /// Tensors read per step, each once.
    pub reads: Vec<Vec<usize>>,
    /// Tensor written per step.
    pub writes: Vec<usize>,
    /// Per step the operands that its output may overwrite if they die there.
    pub overwritable: Vec<Vec<usize>>,
    /// Kernel per step, where it is weighted.
    pub kernels: Vec<Option<KernelId>>,
    /// Exact scratch bytes per step.
    pub scratch: Vec<u64>,
    /// Bytes read from and written to each tensor in an inference.
    pub tensor_traffic: Vec<u64>,
    /// The same of the scratch of each step.
    pub scratch_traffic: Vec<u64>,
    /// Of tensors, bytes.
    pub alignment: u64,
}

impl Needs {
    /// Collects the needs and checks that the steps run in the model's order.
    pub fn of(model: &QModel, target: &Target, options: &PlanOptions) -> Result<Self> {
        if target.kernels.is_empty() {
            return Err(Error::new(ErrorCode::Usage, format!("target {}", target.name), "no kernels are listed"));
        }
        check_dataflow(model)?;
        let alignment = u64::from(options.alignment);
        let exact_bytes: Vec<u64> =
            (0..model.tensors.len()).map(|t| tensor_bytes(model, QTensorId(t as u32))).collect();
        let marked = |ports: &[crate::qmodel::Port]| {
            let mut marks = vec![false; model.tensors.len()];
            ports.iter().for_each(|p| marks[p.tensor.0 as usize] = true);
            marks
        };
        let indices = |ids: Vec<QTensorId>| {
            let mut ids: Vec<usize> = ids.into_iter().map(|t| t.0 as usize).collect();
            ids.sort_unstable();
            ids.dedup();
            ids
        };
        let operands = |op: &QOp| {
            let found = overwritable(model, op, options.in_place_pooling, options.in_place);
            found.into_iter().map(|t| t.0 as usize).collect()
        };
        let kernels: Vec<_> = model.steps.iter().map(|s| kernel(model, target, &s.op)).collect();
        let scratch =
            model.steps.iter().zip(&kernels).map(|(s, kernel)| scratch_bytes(model, &s.op, *kernel)).collect();
        let (tensor_traffic, scratch_traffic) = traffic(model, &kernels);
        Ok(Self {
            tensor_bytes: exact_bytes.iter().map(|b| b.next_multiple_of(alignment)).collect(),
            exact_bytes,
            is_output: marked(&model.outputs),
            is_input: marked(&model.inputs),
            reads: model.steps.iter().map(|s| indices(s.op.reads())).collect(),
            writes: model.steps.iter().map(|s| s.op.output().0 as usize).collect(),
            overwritable: model.steps.iter().map(|s| operands(&s.op)).collect(),
            kernels,
            scratch,
            tensor_traffic,
            scratch_traffic,
            alignment,
        })
    }

    /// Room that the scratch of a step takes in the plan: its size, rounded, and what aligning it may cost.
    pub fn scratch_room(&self, step: usize) -> u64 {
        scratch_room(self.scratch[step], self.alignment)
    }

    /// Steps that read each tensor.
    pub fn reader_counts(&self) -> Vec<u32> {
        let mut counts = vec![0; self.tensor_bytes.len()];
        self.reads.iter().flatten().for_each(|&t| counts[t] += 1);
        counts
    }

    /// Live range per tensor for an order of the steps.
    pub fn live_ranges(&self, order: &[usize]) -> Vec<LiveRange> {
        let mut ranges = vec![LiveRange { first: 0, last: 0 }; self.tensor_bytes.len()];
        for (position, &step) in order.iter().enumerate() {
            let position = position as u32;
            ranges[self.writes[step]] = LiveRange { first: position, last: position };
            self.reads[step].iter().for_each(|&t| ranges[t].last = position);
        }
        let end = order.len().saturating_sub(1) as u32;
        ranges.iter_mut().zip(&self.is_output).filter(|(_, output)| **output).for_each(|(r, _)| r.last = end);
        ranges
    }

    /// Every legal in-place pair of an order; of two dying operands the first.
    pub fn pairs(&self, order: &[usize], ranges: &[LiveRange]) -> Pairs {
        let mut pairs = vec![None; ranges.len()];
        for (position, &step) in order.iter().enumerate() {
            let dies = |t: &usize| ranges[*t].last == position as u32 && !self.is_output[*t];
            pairs[self.writes[step]] = self.overwritable[step].iter().copied().find(dies);
        }
        pairs
    }
}

/// Exact size of a tensor.
pub(super) fn tensor_bytes(model: &QModel, id: QTensorId) -> u64 {
    let tensor = model.tensor(id);
    tensor.shape.elements() * u64::from(tensor.element.bytes())
}

/// See [`Needs::scratch_room`].
pub(super) fn scratch_room(bytes: u64, alignment: u64) -> u64 {
    if bytes == 0 { 0 } else { (bytes + SCRATCH_ALIGNMENT.saturating_sub(alignment)).next_multiple_of(alignment) }
}

/// The target's kernel for a step, where it is weighted.
fn kernel(model: &QModel, target: &Target, op: &QOp) -> Option<KernelId> {
    match op {
        QOp::Conv2d { output, groups, .. } => target.kernel_for(*groups, model.tensor(*output).shape.channels),
        QOp::Linear { output, .. } | QOp::BranchLinear { output, .. } => {
            target.kernel_for(1, model.tensor(*output).shape.channels)
        }
        _ => None,
    }
}

/// Exact scratch of a step with its kernel.
pub(super) fn scratch_bytes(model: &QModel, op: &QOp, kernel: Option<KernelId>) -> u64 {
    let kernel = kernel.unwrap_or(KernelId::Direct);
    let shape = |id: &QTensorId| model.tensor(*id).shape;
    u64::from(match op {
        QOp::Conv2d { input, output, window, groups, .. } => {
            plan::conv2d_scratch_bytes(kernel, shape(input), shape(output), *window, *groups)
        }
        QOp::Linear { input, .. } | QOp::BranchLinear { input, .. } => {
            let element = model.tensor(*input).element;
            plan::linear_scratch_bytes(kernel, shape(input).positions(), shape(input).channels, element)
        }
        QOp::Attention { query, heads, .. } => {
            plan::attention_scratch_bytes(shape(query).positions(), shape(query).channels, *heads)
        }
        QOp::WaypointDecoder(decoder) => plan::waypoint_decoder_scratch_bytes(shape(&decoder.hidden).channels),
        _ => 0,
    })
}

/// Every tensor is an input or written once, before it is read, and has at least one element.
fn check_dataflow(model: &QModel) -> Result<()> {
    let fail = |place: &str, message: String| Err(Error::new(ErrorCode::Malformed, place, message));
    let mut written = vec![false; model.tensors.len()];
    if let Some(empty) = model.tensors.iter().find(|t| t.shape.elements() == 0) {
        return fail(&empty.name, format!("shape {:?} has no elements", empty.shape));
    }
    let ids = model.steps.iter().flat_map(|s| s.op.reads().into_iter().chain([s.op.output()]));
    let ports = model.inputs.iter().chain(&model.outputs).map(|p| p.tensor);
    if let Some(id) = ids.chain(ports).find(|id| id.0 as usize >= model.tensors.len()) {
        return fail("", format!("tensor {} is named, but the model has only {}", id.0, model.tensors.len()));
    }
    model.inputs.iter().for_each(|p| written[p.tensor.0 as usize] = true);
    for step in &model.steps {
        if let Some(early) = step.op.reads().into_iter().find(|t| !written[t.0 as usize]) {
            return fail(&step.name, format!("reads {} before it is written", model.tensor(early).name));
        }
        let output = step.op.output();
        if std::mem::replace(&mut written[output.0 as usize], true) {
            return fail(&step.name, format!("writes {}, which has a value already", model.tensor(output).name));
        }
    }
    match written.iter().position(|w| !w) {
        Some(never) => fail(&model.tensors[never].name, "is never written".into()),
        None => Ok(()),
    }
}
