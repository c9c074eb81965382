//! Portable spatial softmax.

use crate::fault::{self, Fault};
use crate::fixed_point::{divide, exp2_q23, round_shift, saturate_i32, saturate_i64};
use crate::kernels::SpatialSoftmaxArgs;

/// Fraction bits of a point: 1/64 pixel.
const FRACTION_BITS: u32 = 6;

/// The pixel `[column, row]` that each channel expects under a softmax over all of its pixels.
///
/// `u_j = min(R((max(q) − q_j)·M_u, n_u), 31·2^16)`; `e_j = 2^(−u_j)` in Q23 ([`exp2_q23`]);
/// `column = floor(2^6·Σ e_j·column_j / Σ e_j)`, `row` alike.
///
/// `input`: i16 logits, `height × width × channels`; `points`: two per channel. Precondition: height and width ≤ 256,
/// so that the sums stay below 2^47. Channel by channel, each read twice: nothing is stored between the pixels.
pub fn spatial_softmax(args: &SpatialSoftmaxArgs<'_>, input: &[i16], points: &mut [i32]) {
    let channels = usize::from(args.shape.channels);
    let columns = usize::from(args.shape.width).saturating_mul(channels);
    let Some(table) = args.exp_table.first_chunk() else { return };
    let fits = args.shape.elements() == input.len() as u64 && points.len() == 2 * channels;
    if channels == 0 || columns == 0 || !fits {
        return;
    }
    for (channel, point) in points.chunks_exact_mut(2).enumerate() {
        let considered = match input {
            [front @ .., _] if fault::active(Fault::SoftmaxMaximum) => front,
            all => all,
        };
        let peak = i64::from(considered.iter().skip(channel).step_by(channels).copied().max().unwrap_or(0));
        let (mut total, mut across, mut down) = (0_i64, 0_i64, 0_i64);
        for (y, row) in (0_i64..).zip(input.chunks_exact(columns)) {
            let before = total;
            for (x, code) in (0_i64..).zip(row.iter().skip(channel).step_by(channels)) {
                let distance = (peak - i64::from(*code)).wrapping_mul(i64::from(args.exponent.multiplier));
                let weight = exp2_q23(table, round_shift(distance, args.exponent.shift.into()));
                total = total.wrapping_add(weight);
                across = across.wrapping_add(weight.wrapping_mul(x));
            }
            down = down.wrapping_add(total.wrapping_sub(before).wrapping_mul(y));
        }
        let expected = |sum: i64| {
            let scaled = sum.max(0).unsigned_abs() << FRACTION_BITS;
            saturate_i32(saturate_i64(divide(scaled, total.max(0).unsigned_abs())))
        };
        let sums = if fault::active(Fault::PointAxes) { [down, across] } else { [across, down] };
        point.copy_from_slice(&sums.map(expected));
    }
}

#[cfg(test)]
mod tests {
    extern crate std;
    use super::super::oracle::{Rng, for_seeds, round};
    use super::*;
    use crate::fixed_point::EXP_TABLE_LEN;
    use crate::program::Requant;
    use crate::tensor::Shape;
    use std::vec;
    use std::vec::Vec;

    fn table() -> [i16; EXP_TABLE_LEN] {
        core::array::from_fn(|k| f64::min(32767.0, (32768.0 * f64::exp2(-(k as f64) / 256.0)).round()) as i16)
    }

    fn expected(args: &SpatialSoftmaxArgs<'_>, logits: &[i16]) -> Vec<i32> {
        let (width, channels) = (usize::from(args.shape.width), usize::from(args.shape.channels));
        let point = |channel: usize| {
            let pixels: Vec<i128> = logits.iter().skip(channel).step_by(channels).map(|q| i128::from(*q)).collect();
            let peak = *pixels.iter().max().unwrap();
            let weight = |logit: i128| {
                let distance = (peak - logit) * i128::from(args.exponent.multiplier);
                let u = round(distance, args.exponent.shift.into()).min(31 << 16);
                let (i, k, r) = ((u >> 16) as u32, ((u >> 8) & 255) as usize, u & 255);
                let (t0, t1) = (i128::from(args.exp_table[k]), i128::from(args.exp_table[k + 1]));
                round((t0 << 8) - (t0 - t1) * r, i)
            };
            let weights: Vec<i128> = pixels.iter().map(|logit| weight(*logit)).collect();
            let total: i128 = weights.iter().sum();
            let mean = |index: &dyn Fn(usize) -> usize| {
                let sum: i128 = weights.iter().enumerate().map(|(j, e)| e * index(j) as i128).sum();
                assert!(64 * sum < 1 << 53, "{sum}");
                (64 * sum / total) as i32
            };
            [mean(&|j| j % width), mean(&|j| j / width)]
        };
        (0..channels).flat_map(point).collect()
    }

    fn check(rng: &mut Rng, shape: Shape) {
        let table = table();
        let exponent = Requant { multiplier: rng.multiplier(), shift: rng.range(8, 36) as u8 };
        let args = SpatialSoftmaxArgs { shape, exponent, exp_table: &table };
        let logits: Vec<i16> = rng.values(shape.elements() as usize, -32768, 32767);
        let mut points = vec![-7; 2 * usize::from(shape.channels)];
        spatial_softmax(&args, &logits, &mut points);
        assert_eq!(points, expected(&args, &logits), "{args:?}");
    }

    #[test]
    fn equals_the_formula() {
        for_seeds(300, |rng| {
            let shape = Shape::map(rng.range(1, 12) as u16, rng.range(1, 12) as u16, rng.range(1, 6) as u16);
            check(rng, shape);
        });
    }

    #[test]
    fn equals_the_formula_at_the_largest_size() {
        for_seeds(4, |rng| check(rng, Shape::map(256, 256, 2)));
    }

    #[test]
    fn equal_logits_give_the_middle_and_a_lone_peak_its_pixel() {
        let table = table();
        let exponent = Requant { multiplier: 1 << 23, shift: 12 };
        let shape = Shape::map(144, 256, 1);
        let args = SpatialSoftmaxArgs { shape, exponent, exp_table: &table };
        let (mut logits, mut point) = (vec![9; 144 * 256], [0; 2]);
        spatial_softmax(&args, &logits, &mut point);
        assert_eq!(point, [255 * 32, 143 * 32]);
        logits.fill(i16::MIN);
        logits[100 * 256 + 30] = i16::MAX;
        spatial_softmax(&args, &logits, &mut point);
        assert_eq!(point, [30 * 64, 100 * 64], "31 powers of two below the peak nothing is left");
    }

    #[test]
    fn hostile_constants_and_lengths_do_not_panic() {
        let shape = Shape::map(2, 1, 1);
        for entry in [i16::MIN, -1, 0, i16::MAX] {
            let table = [entry; EXP_TABLE_LEN];
            for (multiplier, shift) in [(i32::MIN, 255), (i32::MAX, 0), (1, 52)] {
                let args = SpatialSoftmaxArgs { shape, exponent: Requant { multiplier, shift }, exp_table: &table };
                let shapeless = Shape::map(0, 0, 0);
                for args in [
                    args,
                    SpatialSoftmaxArgs { exp_table: &[], ..args },
                    SpatialSoftmaxArgs { shape: shapeless, ..args },
                ] {
                    spatial_softmax(&args, &[i16::MIN, i16::MAX], &mut [0; 2]);
                    spatial_softmax(&args, &[i16::MIN], &mut [0; 2]);
                    spatial_softmax(&args, &[1, 2], &mut [0; 3]);
                    spatial_softmax(&args, &[], &mut []);
                }
            }
        }
    }
}
