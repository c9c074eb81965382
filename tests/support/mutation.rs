//! Images that differ from a good one in one field: header, ports, tensor records, step index, steps. CRCs are valid.

use firmware::image::layout::{self, header, port, region, section, tensor};
use firmware::image::{SectionKind, TensorRecord};
use firmware::program::Step;
use firmware::tensor::ElementType;
use model_compiler::emit::{ImageParts, assemble, reseal};
use serde_json::{Value, json};
use std::ops::Range;

/// Called with what was changed and the image.
pub type Visit<'a> = &'a mut dyn FnMut(&str, &[u8]);

/// Numbers that a field is set to, beside its neighbors.
const NUMBERS: [i64; 17] = [
    0,
    1,
    2,
    -1,
    -128,
    127,
    128,
    255,
    -32768,
    32767,
    65535,
    -2_147_483_648,
    2_147_483_647,
    4_294_967_295,
    1 << 52,
    i64::MIN,
    i64::MAX,
];

/// Fields of steps that name a tensor.
const TENSOR_FIELDS: [&str; 13] = [
    "input", "indices", "output", "tensor", "map", "velocity", "query", "key", "value", "hidden", "goal", "command",
    "scratch",
];

/// Visits every mutation of an image.
///
/// # Panics
/// The parts do not fit the fields of the format.
pub fn visit_all(parts: &ImageParts, visit: Visit<'_>) {
    let image = assemble(parts).unwrap_or_else(|e| panic!("{e}"));
    let mut sealed = |what: &str, mut bytes: Vec<u8>| {
        reseal(&mut bytes);
        visit(what, &bytes);
    };
    visit_header(&image, &mut sealed);
    visit_tables(parts, &image, &mut sealed);
    visit_tensors(parts, visit);
    visit_steps(parts, visit);
}

type VisitOwned<'a> = &'a mut dyn FnMut(&str, Vec<u8>);

/// Sets a little-endian field of up to eight bytes to every interesting value.
fn visit_field(name: &str, image: &[u8], field: Range<usize>, extra: &[i64], visit: VisitOwned<'_>) {
    let mut word = [0; 8];
    let stored = &image[field.clone()];
    if stored.len() > word.len() {
        return;
    }
    word[..stored.len()].copy_from_slice(stored);
    let value = i64::from_le_bytes(word);
    let neighbors = [-16, -4, -1, 1, 4, 16].map(|d| value.wrapping_add(d));
    for new in NUMBERS.iter().chain(&neighbors).chain(extra) {
        let new_bytes = &new.to_le_bytes()[..field.len()];
        if new_bytes != stored {
            let mut bytes = image.to_vec();
            bytes[field.clone()].copy_from_slice(new_bytes);
            visit(&format!("{name} = {new}"), bytes);
        }
    }
}

fn visit_header(image: &[u8], visit: VisitOwned<'_>) {
    let in_slot = |start: usize, field: Range<usize>| start + field.start..start + field.end;
    let mut fields = vec![
        ("magic".to_owned(), header::MAGIC),
        ("format".to_owned(), header::FORMAT),
        ("step count".to_owned(), header::STEP_COUNT),
        ("total bytes".to_owned(), header::TOTAL_BYTES),
        ("features".to_owned(), header::FEATURES),
        ("tensor count".to_owned(), header::TENSOR_COUNT),
        ("input count".to_owned(), header::INPUT_COUNT),
        ("output count".to_owned(), header::OUTPUT_COUNT),
        ("region count".to_owned(), header::REGION_COUNT),
        ("reserved A".to_owned(), header::RESERVED_A),
        ("name".to_owned(), header::NAME.start..header::NAME.start + 1),
        ("name end".to_owned(), header::NAME.end - 1..header::NAME.end),
        ("region name".to_owned(), in_slot(header::REGIONS.start, region::NAME)),
        ("arena bytes".to_owned(), in_slot(header::REGIONS.start, region::ARENA_BYTES)),
        ("arena alignment".to_owned(), in_slot(header::REGIONS.start, region::ALIGNMENT)),
        ("second region".to_owned(), header::REGIONS.end - 4..header::REGIONS.end),
        ("last section".to_owned(), header::SECTIONS.end - 4..header::SECTIONS.end),
        ("target".to_owned(), header::TARGET.start..header::TARGET.start + 1),
        ("target end".to_owned(), header::TARGET.end - 1..header::TARGET.end),
        ("revision".to_owned(), header::REVISION),
        ("reserved B".to_owned(), header::RESERVED_B.start..header::RESERVED_B.start + 4),
    ];
    for kind in SectionKind::ALL {
        let slot = header::SECTIONS.start + kind as usize * section::BYTES;
        for (name, field) in [("kind", section::KIND), ("offset", section::OFFSET), ("length", section::LENGTH)] {
            fields.push((format!("{} section, {name}", kind.name()), in_slot(slot, field)));
        }
    }
    for (name, field) in fields {
        let powers: Vec<i64> = (3..13).map(|bit| 1 << bit).collect();
        visit_field(&name, image, field, &powers, visit);
    }
}

/// Ports, tensor records and step index, field by field.
fn visit_tables(parts: &ImageParts, image: &[u8], visit: VisitOwned<'_>) {
    let ids: Vec<i64> = (0..=parts.tensors.len() as i64).collect();
    let mut at = header::BYTES;
    for number in 0..parts.inputs.len() + parts.outputs.len() {
        for (name, field) in [("tensor", port::TENSOR), ("zero point", port::ZERO_POINT), ("scale", port::SCALE)] {
            let field = at + field.start..at + field.end;
            visit_field(&format!("port {number}, {name}"), image, field, &ids, visit);
        }
        visit_field(
            &format!("port {number}, name"),
            image,
            at + port::NAME.start..at + port::NAME.start + 1,
            &[],
            visit,
        );
        visit_field(
            &format!("port {number}, name end"),
            image,
            at + port::NAME.end - 1..at + port::NAME.end,
            &[],
            visit,
        );
        at += port::BYTES;
    }
    at = padded(at);
    let offsets: Vec<i64> = parts.tensors.iter().map(|record| record.offset.into()).collect();
    for number in 0..parts.tensors.len() {
        for (name, field, extra) in [
            ("region", tensor::REGION, &[][..]),
            ("element", tensor::ELEMENT, &ids[..4.min(ids.len())]),
            ("in place of", tensor::IN_PLACE_OF, &ids),
            ("offset", tensor::OFFSET, &offsets),
            ("length", tensor::LENGTH, &[]),
            ("batch", tensor::BATCH, &[]),
            ("height", tensor::HEIGHT, &[]),
            ("width", tensor::WIDTH, &[]),
            ("channels", tensor::CHANNELS, &[]),
            ("first step", tensor::FIRST_STEP, &[]),
            ("last step", tensor::LAST_STEP, &[]),
            ("reserved", tensor::RESERVED, &[]),
        ] {
            visit_field(&format!("tensor {number}, {name}"), image, at + field.start..at + field.end, extra, visit);
        }
        at += tensor::BYTES;
    }
    at = padded(at);
    for number in 0..parts.steps.len() {
        let field = at + number * layout::step_index::BYTES..at + (number + 1) * layout::step_index::BYTES;
        visit_field(&format!("step index {number}"), image, field, &[], visit);
    }
}

fn padded(at: usize) -> usize {
    at.next_multiple_of(layout::ALIGNMENT)
}

fn visit_parts(what: &str, parts: &ImageParts, visit: Visit<'_>) {
    if let Ok(bytes) = assemble(parts) {
        visit(what, &bytes);
    }
}

/// Tensors of another type or shape whose length agrees, in memory of their own behind the arena.
fn visit_tensors(parts: &ImageParts, visit: Visit<'_>) {
    for (number, record) in parts.tensors.iter().enumerate() {
        let mut moved = |what: &str, change: &dyn Fn(&mut TensorRecord)| {
            let mut parts = parts.clone();
            let record = &mut parts.tensors[number];
            change(record);
            let bytes = record.shape.elements() * u64::from(record.element.bytes());
            record.bytes = if record.element == ElementType::Scratch { 64 } else { bytes as u32 };
            record.offset = parts.regions[0].bytes.next_multiple_of(16);
            parts.regions[0].bytes = record.offset.saturating_add(record.bytes).saturating_add(64);
            visit_parts(&format!("tensor {number} moved, {what}"), &parts, visit);
        };
        for element in [ElementType::I8, ElementType::I16, ElementType::I32, ElementType::Scratch] {
            moved(&format!("{element:?}"), &|record| record.element = element);
        }
        for change in [-1_i32, 1, 2, 3] {
            let grow = |size: u16| size.saturating_add_signed(change as i16);
            moved(&format!("height {change:+}"), &|record| record.shape.height = grow(record.shape.height));
            moved(&format!("width {change:+}"), &|record| record.shape.width = grow(record.shape.width));
            moved(&format!("channels {change:+}"), &|record| record.shape.channels = grow(record.shape.channels));
        }
        let transposed =
            |record: &mut TensorRecord| std::mem::swap(&mut record.shape.height, &mut record.shape.channels);
        moved("height and channels exchanged", &transposed);
        for change in [4, 16, -4, -16] {
            let mut parts = parts.clone();
            parts.tensors[number].offset = record.offset.saturating_add_signed(change);
            visit_parts(&format!("tensor {number}, offset {change:+}"), &parts, visit);
        }
    }
}

/// Every leaf of every step, and steps exchanged, repeated or left out.
fn visit_steps(parts: &ImageParts, visit: Visit<'_>) {
    for (position, step) in parts.steps.iter().enumerate() {
        let tree = serde_json::to_value(step).expect("a step is JSON");
        let mut paths = Vec::new();
        collect_paths(&tree, String::new(), &mut paths);
        for path in &paths {
            for new in replacements(&tree, path, parts) {
                let mut changed = tree.clone();
                *changed.pointer_mut(path).expect("the path exists") = new.clone();
                let Ok(step) = serde_json::from_value::<Step>(changed) else { continue };
                let mut parts = parts.clone();
                parts.steps[position] = step;
                visit_parts(&format!("step {position}{path} = {new}"), &parts, visit);
            }
        }
        for other in 0..position {
            let mut parts = parts.clone();
            parts.steps.swap(position, other);
            visit_parts(&format!("steps {other} and {position} exchanged"), &parts, visit);
            parts.steps[position] = parts.steps[other].clone();
            visit_parts(&format!("step {position} repeated at {other}"), &parts, visit);
        }
        let mut shorter = parts.clone();
        shorter.steps.remove(position);
        visit_parts(&format!("step {position} left out"), &shorter, visit);
    }
}

/// JSON pointers of all values below a tree, inner nodes included.
fn collect_paths(tree: &Value, path: String, paths: &mut Vec<String>) {
    match tree {
        Value::Object(fields) => {
            fields.iter().for_each(|(name, value)| collect_paths(value, format!("{path}/{name}"), paths));
        }
        Value::Array(items) => {
            items.iter().enumerate().for_each(|(i, value)| collect_paths(value, format!("{path}/{i}"), paths));
        }
        _ => {}
    }
    if path.matches('/').count() > 1 {
        paths.push(path);
    }
}

fn replacements(tree: &Value, path: &str, parts: &ImageParts) -> Vec<Value> {
    let value = tree.pointer(path).expect("the path exists");
    let field = path.rsplit('/').next().unwrap_or_default();
    let ids = || (0..=parts.tensors.len()).map(|id| json!(id));
    let term = |id: usize| json!({"tensor": id, "zero_point": 0, "multiplier": 1});
    let mut new = match value {
        Value::Number(number) => {
            let number = number.as_i64().unwrap_or_default();
            let neighbors = [-16, -4, -2, -1, 1, 2, 4, 16].map(|d| number.wrapping_add(d));
            let numbers = NUMBERS.into_iter().chain(neighbors).chain([number / 2, number.wrapping_mul(2)]);
            let mut new: Vec<Value> = numbers.map(|number| json!(number)).collect();
            if TENSOR_FIELDS.contains(&field) {
                new.extend(ids());
            }
            new.push(Value::Null);
            new
        }
        Value::String(_) if field == "axis" => ["Height", "Width", "Channels"].map(|axis| json!(axis)).to_vec(),
        Value::Bool(flag) => vec![json!(!flag)],
        Value::Null => ids().chain((0..parts.tensors.len()).map(term)).collect(),
        _ if field == "residual" => {
            let streams = (0..parts.tensors.len()).map(|id| json!({"Stream": {"tensor": id}}));
            streams.chain([json!("None"), Value::Null]).collect()
        }
        Value::Object(fields) if fields.contains_key("bytes") => const_ranges(tree),
        _ => vec![Value::Null],
    };
    new.retain(|new| new != value);
    new.dedup();
    new
}

/// All constant ranges of a step.
fn const_ranges(tree: &Value) -> Vec<Value> {
    match tree {
        Value::Object(fields) if fields.contains_key("bytes") => vec![tree.clone()],
        Value::Object(fields) => fields.values().flat_map(const_ranges).collect(),
        _ => Vec::new(),
    }
}
