//! The fields of any step, told apart by kind: numbers, tensors, constants.

use super::{ConstRange, Error, ErrorCode, Facts, Result, Step, TensorId, Value};

/// Fields of [`Step`]'s structs that name tensors. A serialized id is a mere number, so that names have to tell.
const TENSORS: [&str; 13] = [
    "command", "goal", "hidden", "indices", "input", "key", "map", "output", "query", "scratch", "tensor", "value",
    "velocity",
];

/// The fields of a step; nested ones are named `rescale.bias`.
#[derive(Debug, Default)]
pub(super) struct Fields {
    /// Everything else: windows, kernels, factors, zero points, bounds.
    pub numbers: Facts,
    /// Operands.
    pub tensors: Vec<(String, TensorId)>,
    /// Weights, multipliers, tables.
    pub constants: Vec<(String, ConstRange)>,
}

pub(super) fn of(step: &Step) -> Result<Fields> {
    let malformed = |e: serde_json::Error| Error::new(ErrorCode::Malformed, step.name(), e.to_string());
    let mut fields = Fields::default();
    // The outermost object has one member, the variant.
    if let Value::Object(variant) = serde_json::to_value(step).map_err(malformed)? {
        variant.values().for_each(|value| fields.collect("", value));
    }
    debug_assert!(
        step.reads().into_iter().chain([Some(step.output()), step.scratch()]).flatten().all(|id| fields.names(id)),
        "{step:?}: a tensor that TENSORS does not know"
    );
    Ok(fields)
}

impl Fields {
    pub fn has_constant(&self, name: &str) -> bool {
        self.constants.iter().any(|(known, _)| known == name)
    }

    fn names(&self, id: TensorId) -> bool {
        self.tensors.iter().any(|(_, known)| *known == id)
    }

    fn collect(&mut self, name: &str, value: &Value) {
        let inner = |key: &str| if name.is_empty() { key.to_owned() } else { format!("{name}.{key}") };
        match value {
            Value::Object(members) => match serde_json::from_value::<ConstRange>(value.clone()) {
                Ok(range) if members.len() == 2 => self.constants.push((name.to_owned(), range)),
                _ => members.iter().for_each(|(key, value)| self.collect(&inner(key), value)),
            },
            Value::Array(items) => {
                items.iter().enumerate().for_each(|(i, value)| self.collect(&inner(&i.to_string()), value));
            }
            Value::Null => {}
            Value::Number(id) if TENSORS.contains(&last_word(name)) => {
                // Ids have 16 bits.
                self.tensors.push((name.to_owned(), TensorId(id.as_u64().unwrap_or_default() as u16)));
            }
            Value::String(text) => self.numbers.push((name.to_owned(), text.clone())),
            other => self.numbers.push((name.to_owned(), other.to_string())),
        }
    }
}

/// The name of a field without where it is nested, and without its place in a list.
fn last_word(name: &str) -> &str {
    name.rsplit('.').find(|word| word.parse::<usize>().is_err()).unwrap_or_default()
}
