//! Takes tensors out of a checkpoint by name and expected shape, and keeps the list of what does not fit.

use crate::error::{Error, ErrorCode, Result};
use crate::import::{NamedTensors, TensorData};
use crate::ir::Weights;
use std::sync::Arc;

/// Problems that are shown one by one.
const SHOWN: usize = 50;

struct Problem {
    name: String,
    found: String,
    expected: String,
}

/// The list of problems with a checkpoint's tensors.
#[derive(Default)]
pub(super) struct Problems(Vec<Problem>);

impl Problems {
    /// Takes the float values of a tensor of this shape. A tensor that does not fit gives no values and is listed.
    pub(super) fn take(&mut self, tensors: &mut NamedTensors, name: &str, shape: &[usize]) -> Vec<f32> {
        let expected = format!("expected {shape:?}");
        let found = match tensors.remove(name) {
            None => "missing".to_string(),
            Some(tensor) => match tensor.data {
                TensorData::Integer => format!("found integers {:?}", tensor.shape),
                TensorData::Float(_) if tensor.shape != shape => format!("found {:?}", tensor.shape),
                TensorData::Float(values) => match defect(name, &values, shape) {
                    None => return values,
                    Some(defect) => defect,
                },
            },
        };
        self.0.push(Problem { name: name.into(), found, expected });
        Vec::new()
    }

    /// Lists every tensor that is left over. Counters of training steps do not count.
    pub(super) fn add_surplus(&mut self, tensors: &NamedTensors) {
        self.0.extend(tensors.iter().filter(|(name, _)| !name.ends_with("num_batches_tracked")).map(
            |(name, tensor)| Problem {
                name: name.into(),
                found: format!("found {:?}", tensor.shape),
                expected: "surplus".into(),
            },
        ));
    }

    /// No problem, or all of them in one error.
    pub(super) fn into_result(self, system: &str) -> Result<()> {
        if self.0.is_empty() {
            return Ok(());
        }
        let width = |column: fn(&Problem) -> &str| {
            self.0.iter().take(SHOWN).map(|p| column(p).chars().count()).max().unwrap_or(0)
        };
        let (name_width, found_width) = (width(|p| &p.name), width(|p| &p.found));
        let noun = if self.0.len() == 1 { "tensor does" } else { "tensors do" };
        let mut message = format!("{} {noun} not fit the system {system}:", self.0.len());
        for p in self.0.iter().take(SHOWN) {
            message += &format!("\n  {:name_width$}  {:found_width$}  {}", p.name, p.found, p.expected);
        }
        if self.0.len() > SHOWN {
            message += &format!("\n  … and {} more", self.0.len() - SHOWN);
        }
        Err(Error::new(ErrorCode::Tensors, "", message)
            .with_help("the checkpoint must hold exactly the network's tensors; --system overrides the detection"))
    }
}

/// What makes well-shaped values unusable.
fn defect(name: &str, values: &[f32], shape: &[usize]) -> Option<String> {
    if shape.iter().try_fold(1usize, |n, &d| n.checked_mul(d)) != Some(values.len()) {
        return Some(format!("found {} values", values.len()));
    }
    if let Some(i) = values.iter().position(|v| !v.is_finite()) {
        return Some(format!("{} at index {i}", values[i]));
    }
    let negative = values.iter().position(|&v| name.ends_with("running_var") && v < 0.0);
    negative.map(|i| format!("negative variance at index {i}"))
}

/// `[O][I][kh][kw]` of the framework to `[O][kh][kw][I]` of the graph.
pub(in crate::import) fn oihw_to_ohwi(values: &[f32], [o, i, kh, kw]: [usize; 4]) -> Arc<Weights> {
    let taps = kh * kw;
    let mut data = Vec::with_capacity(values.len());
    if i * taps > 0 {
        for output in values.chunks_exact(i * taps) {
            data.extend((0..taps).flat_map(|t| (0..i).map(move |c| output[c * taps + t])));
        }
    }
    Arc::new(Weights { shape: vec![o, kh, kw, i], data })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn convolution_weights_become_channel_fastest() {
        let values: Vec<f32> = (0..2 * 3 * 4).map(|v| v as f32).collect();
        let weights = oihw_to_ohwi(&values, [2, 3, 2, 2]);
        assert_eq!(weights.shape, [2, 2, 2, 3]);
        assert_eq!(weights.data[..6], [0.0, 4.0, 8.0, 1.0, 5.0, 9.0]);
        assert_eq!(weights.data[12..15], [12.0, 16.0, 20.0]);
    }

    #[test]
    fn long_lists_are_cut() {
        let mut problems = Problems::default();
        let tensors = NamedTensors::new((0..60).map(|i| (format!("extra{i:02}"), vec![2], vec![0.0; 2])), []);
        problems.add_surplus(&tensors);
        let text = problems.into_result("aim").unwrap_err().to_string();
        assert!(text.starts_with("60 tensors do not fit the system aim:\n  extra00  found [2]  surplus\n"), "{text}");
        assert!(text.contains("\n  extra49  found [2]  surplus\n  … and 10 more\n  help: "), "{text}");
    }
}
