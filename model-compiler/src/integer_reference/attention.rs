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

#[cfg(test)]
mod tests {
    use super::{Exactness, Softmax};
    use crate::error::ErrorCode;
    use crate::integer_reference::testing::{Random, clamp, execute_alone, requant, round};
    use crate::qmodel::{QOp, QTensorId};
    use firmware::program::Requant;
    use firmware::tensor::{ElementType, Shape};

    /// `T[k] = min(32767, round(2^15·2^(−k/256)))`.
    fn exp_table() -> Vec<i16> {
        (0..=256).map(|k| round(32768.0 * (-f64::from(k) / 256.0).exp2()).min(32767.0) as i16).collect()
    }

    /// Distances are already in Q16: u = δ.
    fn unit_softmax() -> Softmax {
        Softmax::new(Requant { multiplier: 1 << 23, shift: 23 }, &exp_table()).unwrap()
    }

    #[test]
    fn weights_at_known_distances() {
        let softmax = unit_softmax();
        let mut exact = Exactness::default();
        let mut weight = |u: f64| softmax.weight(u, &mut exact);
        assert_eq!(weight(0.0), 32767.0);
        // 32767/2 is a tie; 2^(−1/256) is an entry of its own, and half way to it lies the mean of both entries.
        assert_eq!(weight(65536.0), 16384.0);
        assert_eq!(weight(256.0), f64::from(exp_table()[1]));
        assert_eq!(weight(128.0), ((32767.0 + f64::from(exp_table()[1])) / 2.0 + 0.5).floor());
        assert_eq!(weight(15.0 * 65536.0), 1.0);
        assert_eq!(weight(17.0 * 65536.0), 0.0);
        assert_eq!(weight(31.0 * 65536.0), 0.0);
        assert_eq!(weight(1e9), 0.0);
    }

    #[test]
    fn weights_fall_and_follow_the_power_of_two() {
        let softmax = unit_softmax();
        let mut exact = Exactness::default();
        let mut last = f64::INFINITY;
        for u in (0..18 * 65536).step_by(7) {
            let weight = softmax.weight(f64::from(u), &mut exact);
            let expected = 32768.0 * (-f64::from(u) / 65536.0).exp2();
            assert!(weight <= last, "u = {u}");
            assert!((weight - expected).abs() < 1.51, "u = {u}: {weight} for {expected}");
            last = weight;
        }
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
    fn a_row_of_weights_sums_to_one() {
        let seed = 0xa78;
        let mut random = Random(seed);
        let softmax = Softmax::new(requant(1e-3 * std::f64::consts::LOG2_E * 65536.0), &exp_table()).unwrap();
        for count in [1, 2, 17, 128, 512] {
            let query = random.codes(32, -127, 127);
            let keys: Vec<Vec<f64>> = (0..count).map(|_| random.codes(32, -127, 127)).collect();
            let mut exact = Exactness::default();
            let weights = softmax.weights(&query, keys.iter().map(Vec::as_slice), &mut exact);
            let sum: f64 = weights.iter().sum();
            let reciprocal = ((f64::from(super::bits(sum)) + 22.0).exp2() / sum).floor();
            // Probabilities in Q15, as a stand-alone softmax would give them.
            let unit = (f64::from(super::bits(sum)) + 7.0).exp2();
            let total: f64 = weights.iter().map(|e| (e * reciprocal / unit + 0.5).floor()).sum();
            assert!((total - 32768.0).abs() <= 1.0 + 0.5 * f64::from(count), "{total} of {count} keys, seed {seed:#x}");
            assert_eq!(weights.iter().copied().fold(0.0, f64::max), 32767.0);
            exact.finish().unwrap();
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
