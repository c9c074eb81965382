//! The GRU that emits waypoints: hidden state Q`f`, input Q8 m, gates Q15 from Q12 pre-activations, waypoints Q16 m.

use super::arithmetic::{Exactness, RoundingShift, power_of_two, saturate_i16, to_f64};
use super::operands::{Operands, expect, positions};
use crate::error::{Error, ErrorCode, Result};
use crate::qmodel::QWaypointDecoder;

/// One in Q15, which a gate approaches but does not reach.
const ONE: f64 = 32768.0;

/// Runs as many steps as the output has waypoints.
pub(super) fn waypoint_decoder(operands: &Operands, decoder: &QWaypointDecoder) -> Result<Vec<f64>> {
    let mut state = operands.codes(decoder.hidden)?.to_vec();
    let goal = operands.codes(decoder.goal)?;
    let output = operands.shape(decoder.output)?;
    expect("coordinates of the goal", goal.len(), 2)?;
    expect("coordinates of a waypoint", usize::from(output.channels), 2)?;
    let cell = Cell::new(decoder, state.len())?;
    let head = Head::new(decoder, state.len())?;

    let mut exact = Exactness::default();
    let mut waypoint = [0.0, 0.0];
    let mut waypoints = Vec::with_capacity(2 * positions(output));
    for _ in 0..positions(output) {
        let input = cell_input(waypoint, [goal[0], goal[1]], decoder.concat, &mut exact);
        state = cell.next_state(&state, &input, &mut exact);
        let step = head.displacement(&state, &mut exact);
        waypoint = [waypoint[0] + step[0], waypoint[1] + step[1]];
        waypoints.extend(waypoint);
    }
    exact.finish()?;
    Ok(waypoints)
}

/// `u`, Q8 m: sum or concatenation of waypoint and goal (Q16 m), saturated to i16.
fn cell_input(waypoint: [f64; 2], goal: [f64; 2], concat: bool, exact: &mut Exactness) -> Vec<f64> {
    let shift = RoundingShift::new(8);
    let mut narrow = |value: f64| saturate_i16(shift.round(value, exact));
    if concat {
        waypoint.into_iter().chain(goal).map(&mut narrow).collect()
    } else {
        waypoint.iter().zip(goal).map(|(w, g)| narrow(w + g)).collect()
    }
}

/// The GRU cell; rows r, z, n stacked.
struct Cell {
    size: usize,
    input: Product,
    hidden: Product,
    shifts: Vec<RoundingShift>,
    /// B of r, B of z, B_i of n, B_h of n.
    biases: Vec<f64>,
    fraction_bits: u32,
    gates: Gates,
}

impl Cell {
    fn new(decoder: &QWaypointDecoder, size: usize) -> Result<Self> {
        let fraction_bits = u32::from(decoder.hidden_fraction_bits);
        if fraction_bits > 15 {
            let message = format!("fraction bits of the hidden state: found {fraction_bits}, expected 0..=15");
            return Err(Error::new(ErrorCode::Malformed, "", message));
        }
        let width = if decoder.concat { 4 } else { 2 };
        expect("input weights", decoder.input_weights.len(), 3 * size * width)?;
        expect("hidden weights", decoder.hidden_weights.len(), 3 * size * size)?;
        expect("input multipliers", decoder.input_multipliers.len(), 3 * size)?;
        expect("hidden multipliers", decoder.hidden_multipliers.len(), 3 * size)?;
        expect("shifts", decoder.shifts.len(), 3 * size)?;
        expect("biases", decoder.biases.len(), 4 * size)?;
        Ok(Self {
            size,
            input: Product::new(&decoder.input_weights, decoder.input_pre_shift, &decoder.input_multipliers),
            hidden: Product::new(&decoder.hidden_weights, decoder.hidden_pre_shift, &decoder.hidden_multipliers),
            shifts: decoder.shifts.iter().map(|&n| RoundingShift::new(u32::from(n))).collect(),
            biases: decoder.biases.iter().map(|&b| b as f64).collect(),
            fraction_bits,
            gates: Gates::new(&decoder.tanh_table)?,
        })
    }

    /// `h' = R(c·(2^15 − z) + z·h·2^(15−f), 30 − f)`.
    fn next_state(&self, state: &[f64], input: &[f64], exact: &mut Exactness) -> Vec<f64> {
        let x = self.input.rows(input, exact);
        let h = self.hidden.rows(state, exact);
        let align = power_of_two(15 - self.fraction_bits as i32);
        let shift = RoundingShift::new(30 - self.fraction_bits);
        let mut unit = |i: usize| {
            let reset = self.gate(i, &x, &h, exact);
            let update = self.gate(self.size + i, &x, &h, exact);
            let candidate = self.candidate(i, reset, &x, &h, exact);
            let kept = exact.watch(update * state[i] * align);
            shift.round(candidate * (ONE - update) + kept, exact)
        };
        (0..self.size).map(&mut unit).collect()
    }

    /// `σ(R(X + Hh + B, n))` of a row of r or z.
    fn gate(&self, row: usize, x: &[f64], h: &[f64], exact: &mut Exactness) -> f64 {
        let bias = exact.watch(self.biases[row]);
        let sum = exact.watch(x[row] + h[row]) + bias;
        self.gates.sigmoid(self.shifts[row].round(sum, exact), exact)
    }

    /// `c = tanh(i + R(r·j, 15))`.
    fn candidate(&self, unit: usize, reset: f64, x: &[f64], h: &[f64], exact: &mut Exactness) -> f64 {
        let row = 2 * self.size + unit;
        let input_bias = exact.watch(self.biases[row]);
        let hidden_bias = exact.watch(self.biases[row + self.size]);
        let i = self.shifts[row].round(x[row] + input_bias, exact);
        let j = self.shifts[row].round(h[row] + hidden_bias, exact);
        let gated = RoundingShift::new(15).round(reset * j, exact);
        self.gates.tanh(i + gated, exact)
    }
}

/// `R(Σ W·v, p)·M` of every row.
struct Product {
    weights: Vec<f64>,
    pre_shift: RoundingShift,
    multipliers: Vec<f64>,
}

impl Product {
    fn new(weights: &[i16], pre_shift: u8, multipliers: &[i32]) -> Self {
        let pre_shift = RoundingShift::new(u32::from(pre_shift));
        Self { weights: to_f64(weights), pre_shift, multipliers: to_f64(multipliers) }
    }

    fn rows(&self, vector: &[f64], exact: &mut Exactness) -> Vec<f64> {
        let rows = self.weights.chunks_exact(vector.len()).zip(&self.multipliers);
        rows.map(|(row, multiplier)| {
            let t = self.pre_shift.round(dot(row, vector), exact);
            exact.watch(t * multiplier)
        })
        .collect()
    }
}

/// The output layer: displacement to the next waypoint, Q16 m.
struct Head {
    weights: Vec<f64>,
    bias: [f64; 2],
    pre_shift: RoundingShift,
    multipliers: [f64; 2],
    shifts: [RoundingShift; 2],
}

impl Head {
    fn new(decoder: &QWaypointDecoder, size: usize) -> Result<Self> {
        expect("output weights", decoder.output_weights.len(), 2 * size)?;
        expect("output biases", decoder.output_bias.len(), 2)?;
        Ok(Self {
            weights: to_f64(&decoder.output_weights),
            bias: [decoder.output_bias[0] as f64, decoder.output_bias[1] as f64],
            pre_shift: RoundingShift::new(u32::from(decoder.output_pre_shift)),
            multipliers: decoder.output_requant.map(|r| f64::from(r.multiplier)),
            shifts: decoder.output_requant.map(|r| RoundingShift::new(u32::from(r.shift))),
        })
    }

    fn displacement(&self, state: &[f64], exact: &mut Exactness) -> [f64; 2] {
        [0, 1].map(|row| {
            let weights = &self.weights[row * state.len()..(row + 1) * state.len()];
            let sum = dot(weights, state) + exact.watch(self.bias[row]);
            let t = self.pre_shift.round(sum, exact);
            self.shifts[row].round(t * self.multipliers[row], exact)
        })
    }
}

/// i16 by i16 products: exact for any vector that fits a tensor.
fn dot(weights: &[f64], vector: &[f64]) -> f64 {
    weights.iter().zip(vector).map(|(w, v)| w * v).sum()
}

/// tanh and σ by linear interpolation of one table, x in Q12, result in Q15.
struct Gates {
    /// `T[k] = min(32767, round(2^15·tanh(k/64)))`, k = 0..=512.
    table: Vec<f64>,
}

impl Gates {
    fn new(table: &[i16]) -> Result<Self> {
        expect("entries of the tanh table", table.len(), 513)?;
        Ok(Self { table: to_f64(table) })
    }

    fn tanh(&self, x: f64, exact: &mut Exactness) -> f64 {
        self.interpolate(x, 6, exact)
    }

    /// `σ(x) = (1 + tanh(x/2)) / 2`.
    fn sigmoid(&self, x: f64, exact: &mut Exactness) -> f64 {
        let half = self.interpolate(x, 7, exact);
        RoundingShift::new(1).round(ONE + half, exact).min(ONE - 1.0)
    }

    /// `±R(T[k]·2^b + (T[k+1] − T[k])·r, b)`, `k = a >> b`, r the low b bits of `a = min(|x|, 2^(b+9) − 1)`.
    fn interpolate(&self, x: f64, index_shift: u32, exact: &mut Exactness) -> f64 {
        let spacing = power_of_two(index_shift as i32);
        let a = exact.watch(x).abs().min(512.0 * spacing - 1.0);
        let k = (a / spacing).floor();
        let r = a - k * spacing;
        let (low, high) = (self.table[k as usize], self.table[k as usize + 1]);
        let y = RoundingShift::new(index_shift).round(low * spacing + (high - low) * r, exact);
        if x < 0.0 { -y } else { y }
    }
}
