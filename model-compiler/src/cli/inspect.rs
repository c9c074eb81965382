//! `inspect`: what is in a file.

use crate::artifact::{self, hex};
use crate::emit::AlignedBytes;
use crate::error::{Error, ErrorCode, Result};
use crate::flash;
use crate::import::{NamedTensors, System, checkpoint, onnx};
use crate::memory_plan::MemoryPlan;
use crate::pipeline;
use crate::qmodel::QModel;
use crate::record::Record;
use comfy_table::{CellAlignment, Table, presets};
use firmware::image::{Image, SectionKind, TensorRecord, layout};
use firmware::tensor::ElementType;
use std::fmt::Write as _;
use std::path::Path;

/// What a file holds, for people; the kind is told from its content.
///
/// # Errors
/// Unreadable or damaged file.
pub fn inspect(path: &Path) -> Result<String> {
    let bytes = std::fs::read(path).map_err(|e| Error::io(path, &e))?;
    let result = if bytes.starts_with(&layout::MAGIC) {
        image(&bytes, plan_beside(path, &bytes).as_ref())
    } else if artifact::is::<QModel>(&bytes) {
        artifact::from_bytes(&bytes).map(|model| qmodel(&model))
    } else if artifact::is::<Record>(&bytes) {
        artifact::from_bytes(&bytes).map(|record| build_record(&record))
    } else if onnx::is_onnx(&bytes) {
        let digest = hex(&artifact::sha256(&bytes));
        onnx::Model::parse(bytes).map(|model| network(&model, &digest))
    } else if let Some(form) = flash::form(&bytes) {
        let error = Error::new(ErrorCode::Unsupported, "", format!("this is {form}, a form of an image"));
        Err(error.with_help("inspect the .img that it was made of"))
    } else {
        checkpoint::parse(&bytes).map(|checkpoint| tensors(&checkpoint))
    };
    result.map_err(|e| e.within(path.display()))
}

/// A plain table: headers, then rows; every column after the first `left` ones is aligned right.
pub(super) fn table(headers: &[&str], left: usize) -> Table {
    let mut table = Table::new();
    table.load_style(presets::NOTHING).set_header(headers);
    for (index, column) in table.column_iter_mut().enumerate() {
        column.set_cell_alignment(if index < left { CellAlignment::Left } else { CellAlignment::Right });
    }
    table
}

fn element_name(element: ElementType) -> &'static str {
    match element {
        ElementType::I8 => "i8",
        ElementType::I16 => "i16",
        ElementType::I32 => "i32",
        ElementType::Scratch => "scratch",
    }
}

/// The plan of an image whose record lies beside it: an image alone does not know what its regions could hold.
fn plan_beside(path: &Path, image: &[u8]) -> Option<MemoryPlan> {
    let record: Record = artifact::read(&pipeline::record_path(path)).ok()?;
    (record.image_sha256 == artifact::sha256(image)).then_some(record.plan)
}

fn image(bytes: &[u8], plan: Option<&MemoryPlan>) -> Result<String> {
    let mut text = String::new();
    let aligned = AlignedBytes::from(bytes);
    let image = Image::parse(&aligned)?;
    image.check()?;
    let _ = writeln!(text, "model image  {}", image.name());
    let _ = writeln!(text, "sha256       {}", hex(&artifact::sha256(bytes)));
    let _ = writeln!(text, "qmodel       {}", hex(&image.qmodel_digest()));
    let _ = writeln!(text, "target       {}", if image.target().is_empty() { "unknown" } else { image.target() });
    let _ = writeln!(text, "revision     {}", image.revision());
    let _ = writeln!(text, "bytes        {}", bytes.len());
    let _ = writeln!(text, "arena        {} B, aligned to {}", image.arena_bytes(), image.arena_alignment());
    let _ = writeln!(text, "steps        {}", image.step_count());
    let _ = writeln!(text, "check        all section CRCs match\n");

    let mut sections = table(&["section", "bytes", "crc32"], 1);
    for kind in SectionKind::ALL {
        let length = image.section(kind).len().to_string();
        sections.add_row([kind.name().to_owned(), length, format!("{:08x}", image.section_crc(kind))]);
    }
    let _ = writeln!(text, "{}\n", sections.trim_fmt());

    let mut ports = table(&["port", "name", "type", "shape", "scale", "zero point"], 4);
    let inputs = (0..image.input_count()).filter_map(|i| Some(("input", image.input(i)?)));
    let outputs = (0..image.output_count()).filter_map(|i| Some(("output", image.output(i)?)));
    for (direction, port) in inputs.chain(outputs) {
        let Some(record) = image.tensor(port.tensor) else { continue };
        let shape = format!("{}×{}×{}", record.shape.height, record.shape.width, record.shape.channels);
        let (scale, zero_point) = (port.scale.to_string(), port.zero_point.to_string());
        ports.add_row([direction, port.name, element_name(record.element), &shape, &scale, &zero_point]);
    }
    let _ = writeln!(text, "{}\n", ports.trim_fmt());

    let records: Vec<_> =
        (0..image.tensor_count()).filter_map(|i| image.tensor(firmware::tensor::TensorId(i))).collect();
    if let [_, _, ..] = image.regions().collect::<Vec<_>>().as_slice() {
        let _ = writeln!(text, "{}\n", regions(&image, &records, plan).trim_fmt());
    }
    let columns = ["op", "output", "shape", "region", "step", "offset", "bytes", "live to", "live bytes"];
    let mut steps = table(&columns, 4);
    for position in 0..image.step_count() {
        let Some(step) = image.step(position) else { continue };
        let Some(output) = image.tensor(step.output()) else { continue };
        let live: u64 = (0..image.region_count()).map(|region| live_bytes(&records, region, position)).sum();
        let shape = output.shape;
        let region = image.region(output.region).unwrap_or_default();
        steps.add_row([
            step.name().to_owned(),
            element_name(output.element).to_owned(),
            format!("{}×{}×{}", shape.height, shape.width, shape.channels),
            region.name.to_string(),
            position.to_string(),
            output.offset.to_string(),
            output.bytes.to_string(),
            output.last_step.to_string(),
            live.to_string(),
        ]);
    }
    let _ = writeln!(text, "{}", steps.trim_fmt());
    for (number, region) in (0..).zip(image.regions()) {
        let bound = largest_live_sum(&image, &records, number);
        let _ = writeln!(text, "\narena {} {} B, largest live sum {bound} B", region.name, region.bytes);
    }
    Ok(text)
}

/// A row per region; what a region could hold, and how much of the traffic it has, only a record knows.
fn regions(image: &Image<'_>, records: &[TensorRecord], plan: Option<&MemoryPlan>) -> Table {
    let mut rows = table(&["region", "bytes", "aligned to", "largest live sum", "capacity", "traffic"], 1);
    for (number, region) in (0..).zip(image.regions()) {
        let part = plan.and_then(|plan| Some((plan, plan.regions.get(usize::from(number))?)));
        let capacity = part.and_then(|(_, part)| part.capacity).map(|bytes| bytes.to_string());
        let share = part.map(|(plan, part)| format!("{:.1} %", 100.0 * plan.traffic_share(part)));
        rows.add_row([
            region.name.to_string(),
            region.bytes.to_string(),
            region.alignment.to_string(),
            largest_live_sum(image, records, number).to_string(),
            capacity.unwrap_or_default(),
            share.unwrap_or_default(),
        ]);
    }
    rows
}

fn largest_live_sum(image: &Image<'_>, records: &[TensorRecord], region: u8) -> u64 {
    (0..image.step_count()).map(|position| live_bytes(records, region, position)).max().unwrap_or(0)
}

/// Bytes of a region that hold something at a step: the union of the live buffers (buffers that share memory count
/// once).
fn live_bytes(records: &[TensorRecord], region: u8, position: u16) -> u64 {
    let live = records.iter().filter(|r| r.region == region && r.is_live(position));
    let mut ranges: Vec<(u64, u64)> = live.map(|r| (u64::from(r.offset), r.end())).collect();
    ranges.sort_unstable();
    let (mut covered, mut sum) = (0, 0);
    for (start, end) in ranges {
        sum += end.max(covered) - start.max(covered);
        covered = covered.max(end);
    }
    sum
}

fn qmodel(model: &QModel) -> String {
    let mut text = String::new();
    let _ = writeln!(text, "quantized model  {} ({})", model.name, model.system);
    for (key, value) in &model.provenance {
        let _ = writeln!(text, "{key:>20}  {value}");
    }
    let _ = writeln!(text);
    let mut steps = table(&["step", "op", "type", "shape", "scale", "zero point", "headroom bits", "weight bytes"], 3);
    for step in &model.steps {
        let output = model.tensor(step.op.output());
        steps.add_row([
            step.name.clone(),
            step.op.name().to_owned(),
            element_name(output.element).to_owned(),
            format!("{}×{}×{}", output.shape.height, output.shape.width, output.shape.channels),
            format!("{:.6}", output.scale),
            output.zero_point.to_string(),
            step.bounds.headroom_bits.to_string(),
            step.op.weight_bytes().to_string(),
        ]);
    }
    let _ = writeln!(text, "{}", steps.trim_fmt());
    text
}

fn build_record(record: &Record) -> String {
    let mut text = String::new();
    let _ = writeln!(text, "build record     image {}", hex(&record.image_sha256));
    let _ = writeln!(text, "target           {}", record.target);
    let plan = &record.plan;
    let (arena, bound) = (plan.arena_bytes(), plan.bound_bytes());
    let _ = writeln!(text, "arena            {arena} B, bound {bound} B: {}\n", plan.status().words());
    if plan.regions.len() > 1 {
        let mut rows = table(&["region", "bytes", "capacity", "bound", "traffic", ""], 1);
        for part in &plan.regions {
            let capacity = part.capacity.map(|bytes| bytes.to_string()).unwrap_or_default();
            let share = format!("{:.1} %", 100.0 * plan.traffic_share(part));
            let (bytes, bound) = (part.bytes.to_string(), part.bound_bytes.to_string());
            rows.add_row([part.name.clone(), bytes, capacity, bound, share, part.status.words().to_owned()]);
        }
        let _ = writeln!(text, "{}\n", rows.trim_fmt());
    }
    text + &qmodel(&record.model)
}

fn network(model: &onnx::Model, digest: &str) -> String {
    let mut text = String::new();
    let (constants, values) = model.parameters();
    let operators = model.operators();
    let _ = writeln!(text, "ONNX model  opset {}", model.opset());
    if !model.producer().is_empty() {
        let _ = writeln!(text, "producer    {}", model.producer());
    }
    let _ = writeln!(text, "sha256      {digest}");
    let _ = writeln!(text, "parameters  {constants} tensors, {values} values");
    let _ = writeln!(text, "nodes       {}\n", operators.values().sum::<usize>());
    let mut ports = table(&["port", "name", "type"], 3);
    for (name, kind) in model.inputs() {
        ports.add_row(["input", name, &kind]);
    }
    for (name, kind) in model.outputs() {
        ports.add_row(["output", name, &kind]);
    }
    let _ = writeln!(text, "{ports}\n");
    let mut nodes = table(&["operator", "nodes"], 1);
    for (operator, count) in operators {
        nodes.add_row([operator, count.to_string()]);
    }
    let _ = writeln!(text, "{nodes}");
    text
}

fn tensors(checkpoint: &checkpoint::Checkpoint) -> String {
    let mut text = String::new();
    let named = NamedTensors::from(checkpoint.clone());
    let system = System::detect(&named).map_or("not recognized", System::name);
    let values: usize = checkpoint.tensors().iter().map(|t| t.shape.iter().product::<usize>()).sum();
    let _ = writeln!(text, "checkpoint  {}", checkpoint.format().name());
    let _ = writeln!(text, "system      {system}");
    let _ = writeln!(text, "sha256      {}", hex(checkpoint.sha256()));
    let _ = writeln!(text, "tensors     {}, {values} values\n", checkpoint.tensors().len());
    let mut rows = table(&["tensor", "type", "shape", "values"], 2);
    for tensor in checkpoint.tensors() {
        let count = tensor.shape.iter().product::<usize>().to_string();
        rows.add_row([tensor.name.clone(), format!("{:?}", tensor.dtype), format!("{:?}", tensor.shape), count]);
    }
    let _ = writeln!(text, "{}", rows.trim_fmt());
    if !checkpoint.skipped().is_empty() {
        let _ = writeln!(text, "\nnot tensors, skipped: {}", checkpoint.skipped().join(", "));
    }
    text
}
