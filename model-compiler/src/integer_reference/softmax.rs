//! Softmax over channels, and the base-2 exponential from a table that attention and the spatial softmax share.

use super::arithmetic::{Exactness, RoundingShift, bits, power_of_two, quotient, to_f64};
use super::operands::{Operands, expect};
use crate::error::Result;
use crate::qmodel::QTensorId;
use firmware::program::Requant;

/// Exponents from here on count as 31 whole powers of two: their weight is 0.
const LARGEST_EXPONENT: f64 = 31.0 * 65536.0;
/// Largest probability, Q15.
const LARGEST: f64 = 32767.0;

/// From logits to weights.
pub(super) struct Exponential {
    multiplier: f64,
    shift: RoundingShift,
    /// `T[k]` and `T[k] − T[k+1]`.
    table: Vec<(f64, f64)>,
}

/// `p_j = min(32767, R(e_j·R_s, c + 7))` over the channels of each position.
pub(super) fn softmax(
    operands: &Operands,
    input: QTensorId,
    output: QTensorId,
    exponential: &Exponential,
) -> Result<Vec<f64>> {
    let shape = operands.shape(output)?;
    let mut exact = Exactness::default();
    let mut codes = Vec::with_capacity(shape.elements() as usize);
    for logits in operands.codes_shaped(input, shape)?.chunks_exact(usize::from(shape.channels)) {
        let weights = exponential.of_logits(logits, &mut exact);
        let sum = exact.watch(weights.iter().sum());
        let digits = bits(sum);
        let reciprocal = quotient(exact.watch(power_of_two(digits as i32 + 22)), sum);
        let shift = RoundingShift::new(digits + 7);
        codes.extend(weights.iter().map(|weight| shift.round(weight * reciprocal, &mut exact).min(LARGEST)));
    }
    exact.finish()?;
    Ok(codes)
}

impl Exponential {
    pub(super) fn new(exponent: Requant, table: &[i16]) -> Result<Self> {
        expect("entries of the exponential table", table.len(), 257)?;
        let table = to_f64(table);
        Ok(Self {
            multiplier: f64::from(exponent.multiplier),
            shift: RoundingShift::new(u32::from(exponent.shift)),
            table: table.windows(2).map(|pair| (pair[0], pair[0] - pair[1])).collect(),
        })
    }

    /// `e_j` (Q15) of every logit of a row.
    pub(super) fn of_logits(&self, logits: &[f64], exact: &mut Exactness) -> Vec<f64> {
        let largest = logits.iter().copied().fold(f64::NEG_INFINITY, f64::max);
        logits.iter().map(|logit| self.weight(largest - logit, exact)).collect()
    }

    /// `e = 2^-u` (Q15) of a distance from the largest logit.
    fn weight(&self, distance: f64, exact: &mut Exactness) -> f64 {
        let (whole, value) = self.split(distance, exact);
        RoundingShift::new(8 + (whole as u32).min(23)).round(value, exact)
    }

    /// The same in Q23.
    pub(super) fn fine_weight(&self, distance: f64, exact: &mut Exactness) -> f64 {
        let (whole, value) = self.split(distance, exact);
        RoundingShift::new(whole as u32).round(value, exact)
    }

    /// The whole powers of two of a distance, and `(T[k]<<8) − (T[k]−T[k+1])·r` of the rest.
    fn split(&self, distance: f64, exact: &mut Exactness) -> (f64, f64) {
        let u = self.shift.round(distance * self.multiplier, exact).min(LARGEST_EXPONENT);
        let whole = (u * power_of_two(-16)).floor();
        let fraction = u - whole * power_of_two(16);
        let entry = (fraction * power_of_two(-8)).floor();
        let rest = fraction - entry * power_of_two(8);
        let (value, drop) = self.table[entry as usize];
        (whole, value * 256.0 - drop * rest)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::error::ErrorCode;
    use crate::integer_reference::testing::{Random, execute_alone, requant};
    use crate::qmodel::QOp;
    use crate::quantize::tables::exp2_table;
    use firmware::tensor::{ElementType, Shape};

    /// A logit of 1 is 2^-16 powers of two.
    fn unit() -> Exponential {
        Exponential::new(Requant { multiplier: 1 << 23, shift: 23 }, &exp2_table()).unwrap()
    }

    #[test]
    fn weights_of_whole_and_half_entries() {
        let (exponential, table) = (unit(), exp2_table());
        let mut exact = Exactness::default();
        let mut weight = |u: f64| exponential.weight(u, &mut exact);
        assert_eq!(weight(0.0), 32767.0);
        assert_eq!(weight(65536.0), 16384.0);
        assert_eq!(weight(256.0), f64::from(table[1]));
        assert_eq!(weight(128.0), ((32767.0 + f64::from(table[1])) / 2.0 + 0.5).floor());
        assert_eq!(weight(15.0 * 65536.0), 1.0);
        assert_eq!(weight(17.0 * 65536.0), 0.0);
        assert_eq!(weight(31.0 * 65536.0), 0.0);
        assert_eq!(weight(1e9), 0.0);
    }

    #[test]
    fn weights_fall_and_follow_the_power_of_two() {
        let exponential = unit();
        let mut exact = Exactness::default();
        let mut last = f64::INFINITY;
        for u in (0..18 * 65536).step_by(7) {
            let weight = exponential.weight(f64::from(u), &mut exact);
            let expected = 32768.0 * (-f64::from(u) / 65536.0).exp2();
            assert!(weight <= last, "u = {u}");
            assert!((weight - expected).abs() < 1.51, "u = {u}: {weight} for {expected}");
            last = weight;
        }
    }

    fn run(shape: Shape, element: ElementType, codes: Vec<f64>, scale: f64) -> Result<Vec<f64>> {
        let op = QOp::Softmax {
            input: QTensorId(0),
            output: QTensorId(1),
            exponent: requant(scale * std::f64::consts::LOG2_E * 65536.0),
            exp_table: exp2_table(),
        };
        execute_alone(op, &[(shape, element, codes)], (shape, ElementType::I16))
    }

    #[test]
    fn softmax_equals_a_float_softmax_and_sums_to_one() {
        let seed = 0x50f7;
        let mut random = Random(seed);
        for (channels, element, limit, scale) in [
            (1, ElementType::I8, 127, 0.1),
            (10, ElementType::I8, 127, 0.05),
            (1000, ElementType::I16, 32767, 3e-4),
            (4096, ElementType::I16, 32767, 1e-5),
            (32768, ElementType::I16, 32767, 1e-4),
        ] {
            let shape = Shape::map(1, 2, channels);
            let codes = random.codes(2 * usize::from(channels), -limit, limit);
            let result = run(shape, element, codes.clone(), scale).unwrap();
            for (row, (found, logits)) in result.chunks(channels.into()).zip(codes.chunks(channels.into())).enumerate()
            {
                let place = format!("row {row} of {channels} channels, seed {seed:#x}");
                let largest = logits.iter().copied().fold(f64::MIN, f64::max);
                let weights: Vec<f64> = logits.iter().map(|l| ((l - largest) * scale).exp()).collect();
                let sum: f64 = weights.iter().sum();
                for (found, weight) in found.iter().zip(&weights) {
                    let expected = weight / sum;
                    // Half a step of the output, two of the table, and what the small weights of the sum lose.
                    let bound = 1.0 / 65536.0 + expected * (1e-4 + f64::from(channels) * 1.6 / 32768.0 / sum);
                    let error = (found / 32768.0 - expected).abs();
                    assert!(error <= bound + 2.0 / 32768.0 / sum, "{found} for {expected}, {place}");
                }
                let total: f64 = found.iter().sum();
                assert!((total - 32768.0).abs() <= 1.0 + 0.5 * f64::from(channels), "{total}, {place}");
            }
        }
    }

    #[test]
    fn more_channels_than_are_exact_are_refused() {
        let shape = Shape::vector(32800);
        let error = run(shape, ElementType::I8, vec![5.0; 32800], 0.1).unwrap_err();
        assert_eq!(error.code, ErrorCode::Numeric);
        assert_eq!(run(Shape::vector(32768), ElementType::I8, vec![5.0; 32768], 0.1).unwrap(), [1.0; 32768]);
    }
}
