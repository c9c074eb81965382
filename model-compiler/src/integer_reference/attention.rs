//! Multi-head attention: base-2 softmax from a table, one division per row.

use super::arithmetic::{Exactness, Requantizer, RoundingShift, bits, power_of_two, quotient, to_f64};
use super::operands::{Operands, expect, positions};
use crate::error::{Error, ErrorCode, Result};
use crate::qmodel::QTensorId;
use firmware::program::Requant;
use rayon::prelude::*;

/// Exponents from here on count as 31 whole powers of two: their weight is 0.
const LARGEST_EXPONENT: f64 = 31.0 * 65536.0;

/// The tensors of the step, all `T×C`.
pub(super) struct Tensors {
    pub(super) query: QTensorId,
    pub(super) key: QTensorId,
    pub(super) value: QTensorId,
    pub(super) output: QTensorId,
}

/// From logits to weights.
pub(super) struct Softmax {
    multiplier: f64,
    shift: RoundingShift,
    /// `T[k]` and `T[k] − T[k+1]`.
    table: Vec<(f64, f64)>,
}

/// From the weighted mean (Q12) to output codes.
pub(super) struct Context {
    pub(super) multiplier: f64,
    pub(super) requantizer: Requantizer,
}

/// `ctx = softmax(q·kᵀ)·v` per head, one query row at a time.
pub(super) fn attention<'a>(
    operands: &Operands<'_, 'a>,
    tensors: &Tensors,
    heads: usize,
    softmax: &Softmax,
    context: &Context,
) -> Result<Vec<f64>> {
    let shape = operands.shape(tensors.output)?;
    let channels = usize::from(shape.channels);
    if heads == 0 || !channels.is_multiple_of(heads) {
        let message = format!("{channels} channels are not divisible into {heads} heads");
        return Err(Error::new(ErrorCode::Malformed, "", message));
    }
    let query = operands.codes_shaped(tensors.query, shape)?;
    let key = operands.codes_shaped(tensors.key, shape)?;
    let value = operands.codes_shaped(tensors.value, shape)?;
    let mut result = vec![0.0; positions(shape) * channels];
    result.par_chunks_mut(channels).zip(query.par_chunks(channels)).try_for_each(|(output, query)| {
        let mut exact = Exactness::default();
        let size = channels / heads;
        for head in 0..heads {
            let of_head = head * size..(head + 1) * size;
            let rows = |matrix: &'a [f64]| matrix.chunks_exact(channels).map(|row| &row[of_head.clone()]);
            let weights = softmax.weights(&query[of_head.clone()], rows(key), &mut exact);
            context.combine(&weights, rows(value), &mut output[of_head.clone()], &mut exact);
        }
        exact.finish()
    })?;
    Ok(result)
}

impl Softmax {
    pub(super) fn new(exponent: Requant, table: &[i16]) -> Result<Self> {
        expect("entries of the exponential table", table.len(), 257)?;
        let table = to_f64(table);
        Ok(Self {
            multiplier: f64::from(exponent.multiplier),
            shift: RoundingShift::new(u32::from(exponent.shift)),
            table: table.windows(2).map(|pair| (pair[0], pair[0] - pair[1])).collect(),
        })
    }

    /// `e_j` (Q15) of every key for one query.
    fn weights<'k>(&self, query: &[f64], keys: impl Iterator<Item = &'k [f64]>, exact: &mut Exactness) -> Vec<f64> {
        let dot = |key: &[f64]| query.iter().zip(key).map(|(q, k)| q * k).sum::<f64>();
        let logits: Vec<f64> = keys.map(|key| exact.watch(dot(key))).collect();
        let largest = logits.iter().copied().fold(f64::NEG_INFINITY, f64::max);
        logits.iter().map(|logit| self.weight(largest - logit, exact)).collect()
    }

    /// `e = 2^-u` (Q15) of a distance from the largest logit.
    fn weight(&self, distance: f64, exact: &mut Exactness) -> f64 {
        let u = self.shift.round(distance * self.multiplier, exact).min(LARGEST_EXPONENT);
        let whole = (u * power_of_two(-16)).floor();
        let fraction = u - whole * power_of_two(16);
        let entry = (fraction * power_of_two(-8)).floor();
        let rest = fraction - entry * power_of_two(8);
        let (value, drop) = self.table[entry as usize];
        RoundingShift::new(8 + (whole as u32).min(23)).round(value * 256.0 - drop * rest, exact)
    }
}

impl Context {
    /// `ctx_t = clamp(z_o + R(R(A_t·R_s, c + 10)·M, n))`, `A_t = Σ e_j·v_jt`.
    fn combine<'v>(
        &self,
        weights: &[f64],
        values: impl Iterator<Item = &'v [f64]>,
        output: &mut [f64],
        exact: &mut Exactness,
    ) {
        let sum = exact.watch(weights.iter().sum());
        let digits = bits(sum);
        let reciprocal = quotient(power_of_two(digits as i32 + 22), sum);
        let shift = RoundingShift::new(digits + 10);
        output.fill(0.0);
        for (weight, value) in weights.iter().zip(values) {
            for (total, v) in output.iter_mut().zip(value) {
                *total += weight * v;
            }
        }
        for total in output {
            let mean = shift.round(*total * reciprocal, exact);
            *total = self.requantizer.code(mean * self.multiplier, exact);
        }
    }
}
