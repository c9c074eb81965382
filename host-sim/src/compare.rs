//! Byte for byte: the first place where the engine and the f64 model differ.

use crate::codes::decode;
use firmware::tensor::{ElementType, Shape};
use model_compiler::error::{Error, ErrorCode};
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

/// Differing elements of one tensor.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct ElementDifference {
    /// The first differing element, in memory order.
    pub index: usize,
    /// Code of the engine; `None` where it wrote fewer.
    pub found: Option<i32>,
    /// Code of the f64 model; `None` where the engine wrote more.
    pub expected: Option<i32>,
    /// How many elements differ.
    pub differing: usize,
}

/// Compares the stored bytes of a tensor; `None` if all are equal.
pub fn first_difference(found: &[u8], expected: &[u8], element: ElementType) -> Option<ElementDifference> {
    if found == expected {
        return None;
    }
    let (found, expected) = (decode(found, element), decode(expected, element));
    let length = found.len().max(expected.len());
    let mut unequal = (0..length).filter(|&i| found.get(i) != expected.get(i));
    let index = unequal.next()?;
    let differing = 1 + unequal.count();
    Some(ElementDifference {
        index,
        found: found.get(index).copied(),
        expected: expected.get(index).copied(),
        differing,
    })
}

/// The first unequal step of a frame, in the order of execution.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
pub struct StepDifference {
    /// Frame.
    pub frame: String,
    /// Position in the program.
    pub position: usize,
    /// Step.
    pub step: String,
    /// Tensor that it writes.
    pub tensor: String,
    /// First differing element, in memory order.
    pub index: usize,
    /// The same as `[row, column, channel]`.
    pub at: [usize; 3],
    /// Code of the engine.
    pub found: Option<i32>,
    /// Code of the f64 model.
    pub expected: Option<i32>,
    /// Differing elements of this tensor.
    pub differing: usize,
    /// Elements of this tensor.
    pub elements: u64,
}

impl StepDifference {
    /// Row, column and channel of an element.
    pub fn place(index: usize, shape: Shape) -> [usize; 3] {
        let (width, channels) = (usize::from(shape.width).max(1), usize::from(shape.channels).max(1));
        [index / channels / width, index / channels % width, index % channels]
    }
}

impl From<&StepDifference> for Error {
    fn from(d: &StepDifference) -> Self {
        let code = |c: Option<i32>| c.map_or("nothing".to_owned(), |c| c.to_string());
        let [row, column, channel] = d.at;
        let message = format!(
            "the engine differs from the f64 model: tensor {}, element {} (row {row}, column {column}, channel {channel}): \
             found {}, expected {}; {} of {} elements differ",
            d.tensor,
            d.index,
            code(d.found),
            code(d.expected),
            d.differing,
            d.elements
        );
        Error::new(ErrorCode::Check, format!("frame {}: step {} {}", d.frame, d.position, d.step), message)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_single_altered_byte_is_found_wherever_it_is() {
        let expected: Vec<u8> = (0..=255).collect();
        assert_eq!(first_difference(&expected, &expected, ElementType::I16), None);
        for at in 0..expected.len() {
            let mut found = expected.clone();
            found[at] ^= 0x10;
            let difference = first_difference(&found, &expected, ElementType::I16).unwrap();
            assert_eq!((difference.index, difference.differing), (at / 2, 1));
            assert_ne!(difference.found, difference.expected);
        }
    }

    #[test]
    fn both_values_and_the_number_of_differences_are_told() {
        let difference = first_difference(&[1, 0xff, 3, 9], &[1, 2, 3, 4], ElementType::I8).unwrap();
        assert_eq!(difference, ElementDifference { index: 1, found: Some(-1), expected: Some(2), differing: 2 });
    }

    #[test]
    fn missing_elements_differ() {
        let difference = first_difference(&[1], &[1, 2], ElementType::I8).unwrap();
        assert_eq!(difference, ElementDifference { index: 1, found: None, expected: Some(2), differing: 1 });
    }

    #[test]
    fn the_message_names_step_tensor_place_and_values() {
        let difference = StepDifference {
            frame: "a".into(),
            position: 7,
            step: "layer1.0.conv1".into(),
            tensor: "layer1.0.relu".into(),
            index: 11,
            at: StepDifference::place(11, Shape::map(2, 2, 3)),
            found: Some(-3),
            expected: Some(4),
            differing: 1,
            elements: 12,
        };
        assert_eq!(
            Error::from(&difference).to_string(),
            "frame a: step 7 layer1.0.conv1: the engine differs from the f64 model: tensor layer1.0.relu, element 11 \
             (row 1, column 1, channel 2): found -3, expected 4; 1 of 12 elements differ"
        );
    }
}
