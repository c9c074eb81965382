//! Portable GRU decoder.

use super::codes::{block, element, take};
use crate::fault::{self, Fault};
use crate::fixed_point::{TANH_TABLE_LEN, requantize, round_shift, saturate_i16, saturate_i32, sigmoid_q15, tanh_q15};
use crate::kernels::WaypointDecoderArgs;

/// Emits `steps` waypoints (Q16 m) from the hidden state `h0` and the goal; gate order r, z, n.
///
/// Per step, with `X = R(Σ W_i·u, p_x)·Mx` and `Hh = R(Σ W_h·h, p_h)·Mh` per row: `r, z = σ(R(X + Hh + B, n))`,
/// `c = tanh(R(X + B_i, n) + R(r·R(Hh + B_h, n), 15))`, `h' = R(c·(2^15 − z) + z·h·2^(15−f), 30 − f)`,
/// `w' = w + RQ(Σ W_o·h' + b')`. The input u is Q8 m: `sat16(R(w + g, 8))`, or `sat16` of `R(w, 8)` and `R(g, 8)`.
///
/// `hidden`: H values, scale 2^-f; `goal`: 2; `waypoints`: `steps × 2`. `scratch`:
/// [`crate::kernels::plan::waypoint_decoder_scratch_bytes`], aligned to 2 bytes. Preconditions: f ≤ 15, n ≤ 30, sums by
/// the epilogue rule below 2^52.
pub fn waypoint_decoder(
    args: &WaypointDecoderArgs<'_>,
    hidden: &[i16],
    goal: &[i32],
    waypoints: &mut [i32],
    mut scratch: &mut [u8],
) {
    let (Some(table), [goal_x, goal_y]) = (args.tanh_table.first_chunk(), goal) else { return };
    let size = usize::from(args.hidden_size);
    let (Some(mut state), Some(mut next)) = (take(&mut scratch, size), take(&mut scratch, size)) else { return };
    if hidden.len() != size {
        return;
    }
    for (value, h0) in state.iter_mut().zip(hidden) {
        *value = *h0;
    }
    let mut goal = [*goal_x, *goal_y];
    let mut waypoint = [0; 2];
    for output in waypoints.as_chunks_mut::<2>().0.iter_mut().take(usize::from(args.steps)) {
        let input = Input::new(args.concat, waypoint, goal);
        for (unit, value) in next.iter_mut().enumerate() {
            *value = update_unit(args, table, input.codes(), state, unit);
        }
        core::mem::swap(&mut state, &mut next);
        waypoint = advance(args, waypoint, state);
        *output = waypoint;
        if fault::active(Fault::GoalFirstStepOnly) {
            goal = [0; 2];
        }
    }
}

/// Input of the GRU, Q8 m.
struct Input {
    values: [i16; 4],
    len: usize,
}

impl Input {
    fn new(concat: bool, waypoint: [i32; 2], goal: [i32; 2]) -> Self {
        let q8 = |value: i64| saturate_i16(round_shift(value, 8));
        let ([w0, w1], [g0, g1]) = (waypoint.map(i64::from), goal.map(i64::from));
        if concat {
            Self { values: [q8(w0), q8(w1), q8(g0), q8(g1)], len: 4 }
        } else {
            Self { values: [q8(w0 + g0), q8(w1 + g1), 0, 0], len: 2 }
        }
    }

    fn codes(&self) -> &[i16] {
        self.values.get(..self.len).unwrap_or_default()
    }
}

/// The two products of one gate row, scaled by `2^n`.
struct Row {
    input: i64,
    hidden: i64,
    shift: u32,
}

impl Row {
    fn new(args: &WaypointDecoderArgs<'_>, row: usize, input: &[i16], state: &[i16]) -> Self {
        let product = |weights: &[i16], codes: &[i16], pre_shift, multipliers: &[i32]| {
            let sum = dot(block(weights, row, codes.len()).unwrap_or_default(), codes);
            round_shift(sum, pre_shift).wrapping_mul(i64::from(element(multipliers, row)))
        };
        Self {
            input: product(args.input_weights, input, args.input_pre_shift, args.input_multipliers),
            hidden: product(args.hidden_weights, state, args.hidden_pre_shift, args.hidden_multipliers),
            shift: u32::from(element(args.shifts, row)),
        }
    }

    /// `R(X + Hh + B, n)`, Q12.
    fn joint(&self, bias: i64) -> i64 {
        round_shift(self.input.wrapping_add(self.hidden).wrapping_add(bias), self.shift)
    }
}

/// `h'` of one unit.
fn update_unit(
    args: &WaypointDecoderArgs<'_>,
    table: &[i16; TANH_TABLE_LEN],
    input: &[i16],
    state: &[i16],
    unit: usize,
) -> i16 {
    let size = state.len();
    let row = |gate: usize| Row::new(args, gate * size + unit, input, state);
    let bias = |block: usize| element(args.biases, block * size + unit);
    let gate = |number| i64::from(sigmoid_q15(table, row(number).joint(bias(number))));
    let (reset, update) = if fault::active(Fault::GateOrder) { (gate(1), gate(0)) } else { (gate(0), gate(1)) };
    let row = row(2);
    let scaled = |value: i64| round_shift(value, row.shift);
    let from_input = scaled(row.input.wrapping_add(bias(2)));
    let gated = |value: i64| round_shift(reset.wrapping_mul(value), 15);
    let from_hidden = if fault::active(Fault::ResetBeforeBias) {
        gated(scaled(row.hidden)).wrapping_add(scaled(bias(3)))
    } else {
        gated(scaled(row.hidden.wrapping_add(bias(3))))
    };
    let candidate = i64::from(tanh_q15(table, from_input.wrapping_add(from_hidden)));
    let fraction = args.hidden_fraction_bits.min(15);
    let kept = (update * i64::from(element(state, unit))) << (15 - fraction);
    saturate_i16(round_shift(candidate * ((1 << 15) - update) + kept, 30 - fraction))
}

/// `w' = w + RQ(Σ W_o·h' + b')` for both coordinates.
fn advance(args: &WaypointDecoderArgs<'_>, waypoint: [i32; 2], state: &[i16]) -> [i32; 2] {
    let step = |coordinate: usize, from: i32, requant| {
        let sum = dot(block(args.output_weights, coordinate, state.len()).unwrap_or_default(), state);
        let acc = sum.wrapping_add(element(args.output_bias, coordinate));
        saturate_i32(i64::from(from).wrapping_add(requantize(acc, args.output_pre_shift, requant)))
    };
    let ([x, y], [requant_x, requant_y]) = (waypoint, args.output_requant);
    [step(0, x, requant_x), step(1, y, requant_y)]
}

/// `Σ w·q` in 64 bits.
fn dot(weights: &[i16], codes: &[i16]) -> i64 {
    weights.iter().zip(codes).map(|(w, q)| i64::from(i32::from(*w) * i32::from(*q))).sum()
}

#[cfg(test)]
mod tests {
    extern crate std;
    use super::super::oracle::{Rng, Scratch, for_seeds, round};
    use super::*;
    use crate::kernels::plan::waypoint_decoder_scratch_bytes;
    use crate::program::Requant;
    use std::vec::Vec;

    struct Constants {
        weights: [Vec<i16>; 3],
        multipliers: [Vec<i32>; 2],
        shifts: Vec<u8>,
        biases: Vec<i64>,
        output_bias: Vec<i64>,
        tanh: Vec<i16>,
    }

    impl Constants {
        fn random(rng: &mut Rng, size: usize, inputs: usize) -> Self {
            Self {
                weights: [3 * size * inputs, 3 * size * size, 2 * size].map(|n| rng.values(n, -32767, 32767)),
                multipliers: [3 * size, 3 * size].map(|n| rng.values(n, 1, 1 << 8)),
                shifts: (0..3 * size).map(|_| rng.range(24, 30) as u8).collect(),
                biases: rng.values(4 * size, -(1 << 40), 1 << 40),
                output_bias: rng.values(2, -(1 << 30), 1 << 30),
                tanh: (0..TANH_TABLE_LEN)
                    .map(|k| f64::min(32767.0, (32768.0 * (k as f64 / 64.0).tanh()).round()) as i16)
                    .collect(),
            }
        }

        fn args(&self, rng: &mut Rng, size: usize, concat: bool) -> WaypointDecoderArgs<'_> {
            WaypointDecoderArgs {
                hidden_size: size as u16,
                steps: 4,
                hidden_fraction_bits: rng.range(0, 15) as u32,
                concat,
                input_weights: &self.weights[0],
                hidden_weights: &self.weights[1],
                input_pre_shift: rng.range(0, 4) as u32,
                hidden_pre_shift: rng.range(0, 8) as u32,
                input_multipliers: &self.multipliers[0],
                hidden_multipliers: &self.multipliers[1],
                shifts: &self.shifts,
                biases: &self.biases,
                output_weights: &self.weights[2],
                output_bias: &self.output_bias,
                output_pre_shift: 8,
                output_requant: [0, 1]
                    .map(|_| Requant { multiplier: rng.multiplier(), shift: rng.range(28, 36) as u8 }),
                tanh_table: &self.tanh,
            }
        }
    }

    fn sat16(value: i128) -> i128 {
        value.clamp(-32768, 32767)
    }

    /// tanh with `bits` of fraction between table entries.
    fn interpolate(table: &[i16], x: i128, bits: u32) -> i128 {
        let a = x.abs().min((512 << bits) - 1);
        let (k, r) = ((a >> bits) as usize, a & ((1 << bits) - 1));
        let (t0, t1) = (i128::from(table[k]), i128::from(table[k + 1]));
        round((t0 << bits) + (t1 - t0) * r, bits) * x.signum()
    }

    fn expected(a: &WaypointDecoderArgs<'_>, hidden: &[i16], goal: [i32; 2]) -> Vec<i128> {
        let size = usize::from(a.hidden_size);
        let [gx, gy] = goal.map(i128::from);
        let sigmoid = |x| round(32768 + interpolate(a.tanh_table, x, 7), 1).min(32767);
        let dot = |w: &[i16], row: usize, q: &[i128]| -> i128 {
            (0..q.len()).map(|k| i128::from(w[row * q.len() + k]) * q[k]).sum()
        };
        let mut h: Vec<i128> = hidden.iter().map(|h| i128::from(*h)).collect();
        let (mut wx, mut wy) = (0, 0);
        let mut waypoints = Vec::new();
        for _ in 0..a.steps {
            let u = if a.concat { std::vec![wx, wy, gx, gy] } else { std::vec![wx + gx, wy + gy] };
            let u: Vec<i128> = u.into_iter().map(|v| sat16(round(v, 8))).collect();
            let x = |row: usize| {
                round(dot(a.input_weights, row, &u), a.input_pre_shift) * i128::from(a.input_multipliers[row])
            };
            let hh = |row: usize| {
                round(dot(a.hidden_weights, row, &h), a.hidden_pre_shift) * i128::from(a.hidden_multipliers[row])
            };
            let bias = |row: usize| i128::from(a.biases[row]);
            let f = a.hidden_fraction_bits;
            let next = (0..size).map(|i| {
                let n = |row: usize| u32::from(a.shifts[row]);
                let [ri, zi, ni] = [i, size + i, 2 * size + i];
                let r = sigmoid(round(x(ri) + hh(ri) + bias(ri), n(ri)));
                let z = sigmoid(round(x(zi) + hh(zi) + bias(zi), n(zi)));
                let from_input = round(x(ni) + bias(ni), n(ni));
                let from_hidden = round(hh(ni) + bias(3 * size + i), n(ni));
                let c = interpolate(a.tanh_table, from_input + round(r * from_hidden, 15), 6);
                sat16(round(c * (32768 - z) + ((z * h[i]) << (15 - f)), 30 - f))
            });
            h = next.collect();
            let step = |row: usize| {
                let acc = round(dot(a.output_weights, row, &h) + i128::from(a.output_bias[row]), a.output_pre_shift);
                round(acc * i128::from(a.output_requant[row].multiplier), a.output_requant[row].shift.into())
            };
            (wx, wy) = (wx + step(0), wy + step(1));
            waypoints.extend([wx, wy]);
        }
        waypoints
    }

    #[test]
    fn equals_the_formula() {
        for_seeds(300, |rng| {
            let size = rng.range(1, 20) as usize;
            let concat = rng.flag();
            let constants = Constants::random(rng, size, if concat { 4 } else { 2 });
            let args = constants.args(rng, size, concat);
            let hidden: Vec<i16> = rng.values(size, -32768, 32767);
            let goal = [rng.range(-(1 << 24), 1 << 24) as i32, rng.range(-(1 << 24), 1 << 24) as i32];
            let expected = expected(&args, &hidden, goal);
            let mut waypoints = [0x5555; 8];
            let mut scratch = Scratch::new(waypoint_decoder_scratch_bytes(size as u16));
            waypoint_decoder(&args, &hidden, &goal, &mut waypoints, scratch.bytes());
            assert!(
                waypoints.iter().map(|w| i128::from(*w)).eq(expected.iter().copied()),
                "{waypoints:?} {expected:?}"
            );
        });
    }

    #[test]
    fn opposite_halves_of_the_candidate_are_not_clamped_apart() {
        // i = 40 and j = −40 in Q12 would both saturate at 8 if they were kept in 16 bits: tanh must see 0 to within r
        // < 1.
        let table = Constants::random(&mut Rng(0), 1, 2).tanh;
        let args = WaypointDecoderArgs {
            hidden_size: 1,
            steps: 1,
            hidden_fraction_bits: 15,
            concat: false,
            input_weights: &[0; 6],
            hidden_weights: &[0; 3],
            input_pre_shift: 0,
            hidden_pre_shift: 0,
            input_multipliers: &[0; 3],
            hidden_multipliers: &[0; 3],
            shifts: &[0; 3],
            // r = 1, z = 0
            biases: &[1 << 20, -(1 << 20), 40 << 12, -(38 << 12)],
            output_weights: &[1, 0],
            output_bias: &[0; 2],
            output_pre_shift: 0,
            output_requant: [Requant { multiplier: 1 << 23, shift: 23 }; 2],
            tanh_table: &table,
        };
        let mut waypoints = [0; 2];
        waypoint_decoder(&args, &[0], &[0, 0], &mut waypoints, Scratch::new(4).bytes());
        let h = f64::from(waypoints[0]) / 32768.0;
        assert!((h - 2f64.tanh()).abs() < 1e-3, "h = {h}");
    }

    #[test]
    fn hostile_constants_and_lengths_do_not_panic() {
        for size in [0usize, 1, 3, 65535] {
            let len = size.min(3);
            let table = [i16::MIN; TANH_TABLE_LEN];
            let args = WaypointDecoderArgs {
                hidden_size: size as u16,
                steps: u16::MAX,
                hidden_fraction_bits: u32::MAX,
                concat: true,
                input_weights: &[i16::MIN; 36],
                hidden_weights: &[i16::MIN; 27],
                input_pre_shift: u32::MAX,
                hidden_pre_shift: 0,
                input_multipliers: &[i32::MIN; 9],
                hidden_multipliers: &[i32::MAX; 9],
                shifts: &[255; 9],
                biases: &[i64::MIN; 12],
                output_weights: &[i16::MIN; 6],
                output_bias: &[i64::MAX; 2],
                output_pre_shift: 0,
                output_requant: [Requant { multiplier: i32::MIN, shift: 0 }; 2],
                tanh_table: &table,
            };
            for args in [
                args,
                WaypointDecoderArgs { concat: false, hidden_fraction_bits: 0, ..args },
                WaypointDecoderArgs { biases: &[], shifts: &[], output_weights: &[], ..args },
                WaypointDecoderArgs { tanh_table: &[], ..args },
            ] {
                let mut scratch = Scratch::new(waypoint_decoder_scratch_bytes(size as u16));
                let hidden = std::vec![i16::MIN; len];
                waypoint_decoder(&args, &hidden, &[i32::MIN; 2], &mut [0; 9], scratch.bytes());
                waypoint_decoder(&args, &hidden, &[0; 1], &mut [0; 8], scratch.bytes());
                waypoint_decoder(&args, &hidden, &[i32::MAX; 2], &mut [0; 8], &mut []);
            }
        }
    }
}
