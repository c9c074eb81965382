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
    state.copy_from_slice(hidden);
    let mut goal = [*goal_x, *goal_y];
    let mut waypoint = [0; 2];
    for output in waypoints.chunks_exact_mut(2).take(usize::from(args.steps)) {
        let input = Input::new(args.concat, waypoint, goal);
        for (unit, value) in next.iter_mut().enumerate() {
            *value = update_unit(args, table, input.codes(), state, unit);
        }
        core::mem::swap(&mut state, &mut next);
        waypoint = advance(args, waypoint, state);
        output.copy_from_slice(&waypoint);
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
