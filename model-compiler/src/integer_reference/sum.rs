//! Element-wise sums of one or two operands: add, and change of scale or type.

use super::arithmetic::{Exactness, Requantizer};
use super::operands::Operands;
use crate::error::Result;
use crate::qmodel::{QTensorId, QTerm};

/// `y = clamp(z_o + R(Σ_k (q_k − z_k)·M_k, n))`, all operands shaped like the output.
pub(super) fn of_terms(
    operands: &Operands,
    terms: &[QTerm],
    output: QTensorId,
    requantizer: &Requantizer,
) -> Result<Vec<f64>> {
    let shape = operands.shape(output)?;
    let mut exact = Exactness::default();
    let mut sums = vec![0.0; shape.elements() as usize];
    for term in terms {
        for (sum, code) in sums.iter_mut().zip(operands.codes_shaped(term.tensor, shape)?) {
            *sum += exact.watch((code - f64::from(term.zero_point)) * f64::from(term.multiplier));
        }
    }
    let codes = sums.iter().map(|&sum| requantizer.code(sum, &mut exact)).collect();
    exact.finish()?;
    Ok(codes)
}
