//! Multi-head attention: base-2 softmax from a table, one division per row.

use super::arithmetic::{Exactness, Requantizer, RoundingShift, bits, power_of_two, quotient};
use super::operands::{Operands, positions};
use super::softmax::Exponential;
use crate::error::{Error, ErrorCode, Result};
use crate::qmodel::QTensorId;
use rayon::prelude::*;

/// The tensors of the step, all `T×C`.
pub(super) struct Tensors {
    pub(super) query: QTensorId,
    pub(super) key: QTensorId,
    pub(super) value: QTensorId,
    pub(super) output: QTensorId,
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
    exponential: &Exponential,
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
            let weights = weights(exponential, &query[of_head.clone()], rows(key), &mut exact);
            context.combine(&weights, rows(value), &mut output[of_head.clone()], &mut exact);
        }
        exact.finish()
    })?;
    Ok(result)
}

/// `e_j` (Q15) of every key for one query.
fn weights<'k>(
    exponential: &Exponential,
    query: &[f64],
    keys: impl Iterator<Item = &'k [f64]>,
    exact: &mut Exactness,
) -> Vec<f64> {
    let dot = |key: &[f64]| query.iter().zip(key).map(|(q, k)| q * k).sum::<f64>();
    let logits: Vec<f64> = keys.map(|key| exact.watch(dot(key))).collect();
    exponential.of_logits(&logits, exact)
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

#[cfg(test)]
mod tests {
    use crate::error::ErrorCode;
    use crate::integer_reference::testing::{Random, clamp, execute_alone, requant, round};
    use crate::qmodel::{QOp, QTensorId};
    use firmware::tensor::{ElementType, Shape};

    /// `T[k] = min(32767, round(2^15·2^(−k/256)))`.
    fn exp_table() -> Vec<i16> {
        (0..=256).map(|k| round(32768.0 * (-f64::from(k) / 256.0).exp2()).min(32767.0) as i16).collect()
    }

    struct Case {
        shape: Shape,
        heads: u16,
        codes: [Vec<f64>; 3],
        /// s_q·s_k.
        logit_scale: f64,
        /// s_v/s_o.
        gain: f64,
    }

    fn run(case: &Case) -> Vec<f64> {
        let size = f64::from(case.shape.channels / case.heads);
        let op = QOp::Attention {
            query: QTensorId(0),
            key: QTensorId(1),
            value: QTensorId(2),
            output: QTensorId(3),
            heads: case.heads,
            exponent: requant(case.logit_scale * std::f64::consts::LOG2_E / size.sqrt() * 65536.0),
            exp_table: exp_table(),
            requant: requant(case.gain / 4096.0),
            zero_point: 0,
            clamp: clamp(-32768, 32767),
        };
        let operands = case.codes.clone().map(|codes| (case.shape, ElementType::I8, codes));
        execute_alone(op, &operands, (case.shape, ElementType::I16)).unwrap()
    }

    #[test]
    fn equal_logits_give_the_mean_and_one_large_logit_its_value() {
        let shape = Shape::tokens(3, 1);
        let case = |query: [f64; 3], key: [f64; 3], value: [f64; 3]| {
            let codes = [query.to_vec(), key.to_vec(), value.to_vec()];
            run(&Case { shape, heads: 1, codes, logit_scale: 0.05, gain: 1.0 })
        };
        assert_eq!(case([0.0; 3], [1.0, 2.0, 3.0], [100.0, 100.0, 100.0]), [100.0; 3]);
        assert_eq!(case([0.0; 3], [1.0, 2.0, 3.0], [-90.0, 30.0, 61.0]), [0.0; 3]);
        let far = case([127.0, -127.0, 127.0], [-127.0, 1.0, 127.0], [-90.0, 30.0, 61.0]);
        assert_eq!(far, [61.0, -90.0, 61.0]);
    }

    #[test]
    fn attention_equals_a_float_softmax() {
        let seed = 0xa77;
        let mut random = Random(seed);
        for (tokens, channels, heads, logit_scale) in [(40u16, 32u16, 2u16, 5e-4), (128, 64, 4, 2e-3), (7, 12, 3, 1e-6)]
        {
            let (size, channels_per_head) = (usize::from(tokens * channels), usize::from(channels / heads));
            let shape = Shape::tokens(tokens, channels);
            let codes = [(); 3].map(|()| random.codes(size, -127, 127));
            let case = Case { shape, heads, codes, logit_scale, gain: 64.0 };
            let result = run(&case);
            let [query, key, value] = &case.codes;
            for (element, &found) in result.iter().enumerate() {
                let (row, channel) = (element / usize::from(channels), element % usize::from(channels));
                let first = channel / channels_per_head * channels_per_head;
                let of_head =
                    |m: &[f64], row: usize| m[row * usize::from(channels) + first..][..channels_per_head].to_vec();
                let logit = |key_row: usize| {
                    let products = of_head(query, row).into_iter().zip(of_head(key, key_row)).map(|(q, k)| q * k);
                    products.sum::<f64>() * logit_scale / (channels_per_head as f64).sqrt()
                };
                let logits: Vec<f64> = (0..usize::from(tokens)).map(logit).collect();
                let largest = logits.iter().copied().fold(f64::MIN, f64::max);
                let weights: Vec<f64> = logits.iter().map(|l| (l - largest).exp()).collect();
                let values = (0..usize::from(tokens)).map(|r| value[r * usize::from(channels) + channel]);
                let mean = weights.iter().zip(values).map(|(w, v)| w * v).sum::<f64>() / weights.iter().sum::<f64>();
                let error = (found / case.gain - mean).abs();
                assert!(error < 0.03, "{} for {mean} at {row},{channel}, seed {seed:#x}", found / case.gain);
            }
        }
    }

    #[test]
    fn heads_must_divide_the_channels() {
        let shape = Shape::tokens(2, 4);
        let op = QOp::Attention {
            query: QTensorId(0),
            key: QTensorId(1),
            value: QTensorId(2),
            output: QTensorId(3),
            heads: 3,
            exponent: requant(1.0),
            exp_table: exp_table(),
            requant: requant(1.0),
            zero_point: 0,
            clamp: clamp(-128, 127),
        };
        let operands = [(); 3].map(|()| (shape, ElementType::I8, vec![0.0; 8]));
        let error = execute_alone(op, &operands, (shape, ElementType::I8)).unwrap_err();
        assert_eq!(error.code, ErrorCode::Malformed);
    }
}
