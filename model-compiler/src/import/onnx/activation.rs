//! Activations as ONNX sees them (`N×C×H×W`, batch 1) over values of the graph (`height × width × channels`).

use super::tensor::{Tensor, elements};
use crate::ir::{Shape, ValueId};

/// A tensor of ONNX whose elements, in their order, are those of a map in the order channel, row, column.
///
/// Flattening, reshaping and squeezing change only the extents; whether an operator can read the result is the
/// operator's question.
#[derive(Clone, Debug, PartialEq)]
pub(super) struct Activation {
    /// The map.
    pub(super) id: ValueId,
    pub(super) shape: Shape,
    /// ONNX's extents.
    pub(super) dims: Vec<usize>,
    /// The node that last changed the extents, for messages.
    pub(super) reshaped_by: Option<String>,
}

impl Activation {
    /// `1×C×H×W`.
    pub(super) fn map(id: ValueId, shape: Shape) -> Self {
        let dims = map_dims(shape).to_vec();
        Self { id, shape, dims, reshaped_by: None }
    }

    /// `1×C`.
    pub(super) fn vector(id: ValueId, shape: Shape) -> Self {
        Self { dims: vec![1, usize::from(shape.channels)], ..Self::map(id, shape) }
    }

    pub(super) fn is_map(&self) -> bool {
        self.dims == map_dims(self.shape)
    }

    /// Per axis of ONNX the axis of the map (height 0, width 1, channels 2), none for the batch; or `None` where the
    /// extents are of neither a map nor a vector.
    pub(super) fn map_axes(&self) -> Option<Vec<Option<usize>>> {
        if self.is_map() {
            Some(vec![None, Some(2), Some(0), Some(1)])
        } else if self.shape.positions() == 1 && self.dims == [1, usize::from(self.shape.channels)] {
            Some(vec![None, Some(2)])
        } else {
            None
        }
    }

    /// The axis of the channels, where it is one of the extents: `1×C×…`, rows and columns behind it in any form.
    pub(super) fn has_channels_second(&self) -> bool {
        self.dims.len() > 1 && self.dims[..2] == [1, usize::from(self.shape.channels)]
    }

    /// Extents for messages, with the node that made them.
    pub(super) fn described(&self) -> String {
        match &self.reshaped_by {
            None => extents(&self.dims),
            Some(node) => {
                format!("{}, made by {node} of a map {}", extents(&self.dims), extents(&map_dims(self.shape)))
            }
        }
    }
}

fn map_dims(shape: Shape) -> [usize; 4] {
    [1, usize::from(shape.channels), usize::from(shape.height), usize::from(shape.width)]
}

/// `1×3×32×32`; a scalar has none.
pub(super) fn extents(dims: &[usize]) -> String {
    if dims.is_empty() {
        return "a scalar".into();
    }
    dims.iter().map(usize::to_string).collect::<Vec<_>>().join("×")
}

/// What a name of the file stands for.
#[derive(Clone, Debug)]
pub(super) enum Value {
    Constant(Tensor),
    Activation(Activation),
}

impl Value {
    pub(super) fn dims(&self) -> &[usize] {
        match self {
            Self::Constant(tensor) => &tensor.dims,
            Self::Activation(activation) => &activation.dims,
        }
    }

    /// The same elements with other extents of the same product.
    ///
    /// # Errors
    /// The products differ.
    pub(super) fn reshaped(self, dims: Vec<usize>, node: String) -> Result<Self, String> {
        if elements(&dims).is_none() || elements(&dims) != elements(self.dims()) {
            return Err(format!("{} has not the elements of {}", extents(&dims), extents(self.dims())));
        }
        Ok(match self {
            Self::Constant(tensor) => Self::Constant(Tensor { dims, ..tensor }),
            Self::Activation(activation) => {
                let reshaped_by = if dims == activation.dims { activation.reshaped_by } else { Some(node) };
                Self::Activation(Activation { dims, reshaped_by, ..activation })
            }
        })
    }

    pub(super) fn described(&self) -> String {
        match self {
            Self::Constant(tensor) => format!("a constant {}", extents(&tensor.dims)),
            Self::Activation(activation) => activation.described(),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn extents_come_and_go_around_one_map() {
        let shape = Shape::map(2, 3, 5);
        let map = Value::Activation(Activation::map(ValueId(0), shape));
        assert_eq!(map.dims(), [1, 5, 2, 3]);
        let flat = map.clone().reshaped(vec![1, 30], "Flatten f".into()).unwrap();
        assert_eq!(flat.described(), "1×30, made by Flatten f of a map 1×5×2×3");
        let Value::Activation(flat) = flat else { panic!() };
        assert!(!flat.is_map() && flat.map_axes().is_none());
        let Value::Activation(back) = Value::Activation(flat).reshaped(vec![1, 5, 2, 3], "Reshape r".into()).unwrap()
        else {
            panic!()
        };
        assert!(back.is_map());
        assert_eq!(map.reshaped(vec![1, 29], "f".into()).unwrap_err(), "1×29 has not the elements of 1×5×2×3");
    }
}
