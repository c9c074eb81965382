//! What a step reads: tensors and their codes, with sizes checked before use.

use crate::error::{Error, ErrorCode, Result};
use crate::qmodel::{QModel, QTensor, QTensorId};
use firmware::tensor::Shape;

/// The tensors of one step.
pub(super) struct Operands<'m, 'a> {
    model: &'m QModel,
    codes: &'m dyn Fn(QTensorId) -> &'a [f64],
}

impl<'m, 'a> Operands<'m, 'a> {
    pub(super) fn new(model: &'m QModel, codes: &'m dyn Fn(QTensorId) -> &'a [f64]) -> Self {
        Self { model, codes }
    }

    pub(super) fn tensor(&self, id: QTensorId) -> Result<&'m QTensor> {
        let message = || format!("tensor {} of {} does not exist", id.0, self.model.tensors.len());
        self.model.tensors.get(id.0 as usize).ok_or_else(|| Error::new(ErrorCode::Malformed, "", message()))
    }

    /// Shape of a tensor; never empty.
    pub(super) fn shape(&self, id: QTensorId) -> Result<Shape> {
        let tensor = self.tensor(id)?;
        if tensor.shape.elements() == 0 {
            return Err(Error::new(ErrorCode::Malformed, "", format!("tensor {} has no elements", tensor.name)));
        }
        Ok(tensor.shape)
    }

    /// Codes of an operand, as many as its shape says.
    pub(super) fn codes(&self, id: QTensorId) -> Result<&'a [f64]> {
        let tensor = self.tensor(id)?;
        let codes = (self.codes)(id);
        expect(&format!("codes of tensor {}", tensor.name), codes.len(), tensor.shape.elements() as usize)?;
        Ok(codes)
    }

    /// Codes of an operand that must be shaped like the output.
    pub(super) fn codes_shaped(&self, id: QTensorId, shape: Shape) -> Result<&'a [f64]> {
        let tensor = self.tensor(id)?;
        if tensor.shape != shape {
            let message = format!("tensor {} is {:?}, expected {shape:?}", tensor.name, tensor.shape);
            return Err(Error::new(ErrorCode::Malformed, "", message));
        }
        self.codes(id)
    }
}

/// A length that must be right.
pub(super) fn expect(what: &str, found: usize, expected: usize) -> Result<()> {
    if found == expected {
        return Ok(());
    }
    Err(Error::new(ErrorCode::Malformed, "", format!("{what}: found {found}, expected {expected}")))
}

/// Positions (height × width) of a shape.
pub(super) fn positions(shape: Shape) -> usize {
    usize::from(shape.height) * usize::from(shape.width)
}
