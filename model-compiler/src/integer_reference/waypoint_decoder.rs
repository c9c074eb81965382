//! The GRU that emits waypoints: hidden state Q`f`, input Q8 m, gates Q15 from Q12 pre-activations, waypoints Q16 m.

use super::arithmetic::{Exactness, RoundingShift, power_of_two, saturate_i16, to_f64};
use super::gates::Gates;
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

#[cfg(test)]
mod tests {
    use super::{Exactness, cell_input};
    use crate::error::{ErrorCode, Result};
    use crate::integer_reference::testing::{Random, execute_alone, requant, round};
    use crate::qmodel::{QOp, QTensorId, QWaypointDecoder};
    use firmware::program::Requant;
    use firmware::tensor::{ElementType, Shape};

    /// `T[k] = min(32767, round(2^15·tanh(k/64)))`.
    fn tanh_table() -> Vec<i16> {
        (0..=512).map(|k| round(32768.0 * (f64::from(k) / 64.0).tanh()).min(32767.0) as i16).collect()
    }

    #[test]
    fn cell_input_saturates_at_128_meters() {
        let mut exact = Exactness::default();
        let meters = |m: f64| m * 65536.0;
        let mut added = |w: f64, g: f64| cell_input([w, 0.0], [g, 0.0], false, &mut exact)[0];
        assert_eq!(added(meters(1.0), meters(2.5)), 3.5 * 256.0);
        assert_eq!(added(128.0, 0.0), 1.0);
        assert_eq!(added(0.0, -128.0), 0.0);
        assert_eq!((added(meters(100.0), meters(100.0)), added(0.0, meters(-200.0))), (32767.0, -32768.0));
        let mut exact = Exactness::default();
        let concatenated = cell_input([256.0, -256.0], [meters(1.0), meters(200.0)], true, &mut exact);
        assert_eq!(concatenated, [1.0, -1.0, 256.0, 32767.0]);
    }

    /// A GRU and output layer in real numbers.
    struct Float {
        concat: bool,
        size: usize,
        input_weights: Vec<f64>,
        hidden_weights: Vec<f64>,
        input_bias: Vec<f64>,
        hidden_bias: Vec<f64>,
        output_weights: Vec<f64>,
        output_bias: [f64; 2],
    }

    impl Float {
        fn random(random: &mut Random, size: usize, concat: bool) -> Self {
            let limit = 1.0 / (size as f64).sqrt();
            let width = if concat { 4 } else { 2 };
            Self {
                concat,
                size,
                input_weights: random.reals(3 * size * width, -0.3, 0.3),
                hidden_weights: random.reals(3 * size * size, -limit, limit),
                input_bias: random.reals(3 * size, -limit, limit),
                hidden_bias: random.reals(3 * size, -limit, limit),
                output_weights: random.reals(2 * size, -limit, limit),
                output_bias: [random.real(-2.0, 2.0), random.real(-2.0, 2.0)],
            }
        }

        fn run(&self, state: &[f64], goal: [f64; 2], steps: usize) -> Vec<f64> {
            let (mut state, mut at, mut waypoints) = (state.to_vec(), [0.0, 0.0], Vec::new());
            for _ in 0..steps {
                let input = match self.concat {
                    true => vec![at[0], at[1], goal[0], goal[1]],
                    false => vec![at[0] + goal[0], at[1] + goal[1]],
                };
                state = self.next_state(&state, &input);
                for (axis, weights) in self.output_weights.chunks_exact(self.size).enumerate() {
                    at[axis] += dot(weights, &state) + self.output_bias[axis];
                }
                waypoints.extend(at);
            }
            waypoints
        }

        fn next_state(&self, state: &[f64], input: &[f64]) -> Vec<f64> {
            let sigmoid = |x: f64| 1.0 / (1.0 + (-x).exp());
            let x = |row: usize| dot(&self.input_weights[row * input.len()..], input) + self.input_bias[row];
            let h = |row: usize| dot(&self.hidden_weights[row * state.len()..], state) + self.hidden_bias[row];
            let unit = |i: usize| {
                let (r, z) = (i, self.size + i);
                let (reset, update) = (sigmoid(x(r) + h(r)), sigmoid(x(z) + h(z)));
                let n = 2 * self.size + i;
                (1.0 - update) * (x(n) + reset * h(n)).tanh() + update * state[i]
            };
            (0..self.size).map(unit).collect()
        }

        /// Integers by the rules of numerics, "GRU and waypoints".
        fn quantize(&self, fraction_bits: u8) -> QWaypointDecoder {
            let (input_weights, input_scales) = rows(&self.input_weights, if self.concat { 4 } else { 2 });
            let (hidden_weights, hidden_scales) = rows(&self.hidden_weights, self.size);
            let (output_weights, output_scales) = rows(&self.output_weights, self.size);
            // 18 bits of weights' sums above 28 at most; the multipliers of a row share n with |t·M| below 2^50.
            let pre_shift = 8;
            let scale_up = f64::from(pre_shift).exp2();
            let factors = |row: usize| {
                let m_x = input_scales[row] * 16.0 * scale_up;
                (m_x, hidden_scales[row] * f64::from(12 - i32::from(fraction_bits)).exp2() * scale_up)
            };
            let n = |row: usize| {
                (0..=30).rev().find(|&n| factors(row).0.max(factors(row).1) * f64::from(n).exp2() < 4194304.0)
            };
            let shifts: Vec<u8> = (0..3 * self.size).map(|row| n(row).unwrap() as u8).collect();
            let multiplier = |row: usize, m: f64| round(m * f64::from(shifts[row]).exp2()) as i32;
            let bias = |row: usize, b: f64| round(b * f64::from(i32::from(shifts[row]) + 12).exp2()) as i64;
            let gates = (0..2 * self.size).map(|row| bias(row, self.input_bias[row] + self.hidden_bias[row]));
            let candidate = 2 * self.size..3 * self.size;
            let input_biases = candidate.clone().map(|row| bias(row, self.input_bias[row]));
            let hidden_biases = candidate.map(|row| bias(row, self.hidden_bias[row]));
            let head = |row: usize| {
                let m = output_scales[row] * f64::from(16 - i32::from(fraction_bits)).exp2();
                (requant(m * scale_up), round(self.output_bias[row] * 65536.0 / m) as i64)
            };
            QWaypointDecoder {
                hidden: QTensorId(0),
                goal: QTensorId(1),
                output: QTensorId(2),
                hidden_fraction_bits: fraction_bits,
                concat: self.concat,
                input_weights,
                hidden_weights,
                input_pre_shift: pre_shift as u8,
                hidden_pre_shift: pre_shift as u8,
                input_multipliers: (0..3 * self.size).map(|row| multiplier(row, factors(row).0)).collect(),
                hidden_multipliers: (0..3 * self.size).map(|row| multiplier(row, factors(row).1)).collect(),
                biases: gates.chain(input_biases).chain(hidden_biases).collect(),
                output_weights,
                output_bias: vec![head(0).1, head(1).1],
                output_pre_shift: pre_shift as u8,
                output_requant: [head(0).0, head(1).0],
                tanh_table: tanh_table(),
                shifts,
            }
        }
    }

    fn dot(weights: &[f64], vector: &[f64]) -> f64 {
        weights.iter().zip(vector).map(|(w, v)| w * v).sum()
    }

    /// i16 weights with a scale per row.
    fn rows(weights: &[f64], width: usize) -> (Vec<i16>, Vec<f64>) {
        let scale = |row: &[f64]| row.iter().fold(0f64, |max, w| max.max(w.abs())) / 32767.0;
        let scales: Vec<f64> = weights.chunks_exact(width).map(scale).collect();
        let codes = weights.iter().enumerate().map(|(i, w)| round(w / scales[i / width]) as i16);
        (codes.collect(), scales)
    }

    fn execute_decoder(decoder: QWaypointDecoder, hidden: Vec<f64>, goal: [f64; 2]) -> Result<Vec<f64>> {
        let operands = [
            (Shape::vector(hidden.len() as u16), ElementType::I16, hidden),
            (Shape::vector(2), ElementType::I32, goal.map(|g| round(g * 65536.0)).to_vec()),
        ];
        execute_alone(QOp::WaypointDecoder(decoder), &operands, (Shape::map(4, 1, 2), ElementType::I32))
    }

    #[test]
    fn waypoints_follow_a_float_decoder() {
        let seed = 0x6c0;
        let mut random = Random(seed);
        for round_number in 0..40 {
            let concat = round_number % 2 == 1;
            let fraction_bits = [15, 13, 12][round_number % 3];
            let float = Float::random(&mut random, 64, concat);
            let limit = 32767.0 / f64::from(fraction_bits).exp2();
            let state: Vec<f64> = random.codes(64, 0, 32767);
            let goal = [random.real(-30.0, 30.0), random.real(-60.0, 10.0)];
            let real_state: Vec<f64> = state.iter().map(|h| h * limit / 32767.0).collect();
            let expected = float.run(&real_state, goal, 4);
            let found = execute_decoder(float.quantize(fraction_bits as u8), state, goal).unwrap();
            for (found, expected) in found.iter().map(|w| w / 65536.0).zip(expected) {
                // Input Q8 m, state down to Q12: below a few millimeters.
                let error = (found - expected).abs();
                assert!(error < 0.003, "{found} m for {expected} m, round {round_number}, seed {seed:#x}");
            }
        }
    }

    /// One hidden unit without weights: each gate is its bias.
    fn biased(r: i64, z: i64, input: i64, hidden: i64) -> QWaypointDecoder {
        QWaypointDecoder {
            hidden: QTensorId(0),
            goal: QTensorId(1),
            output: QTensorId(2),
            hidden_fraction_bits: 15,
            concat: false,
            input_weights: vec![0; 6],
            hidden_weights: vec![0; 3],
            input_pre_shift: 0,
            hidden_pre_shift: 0,
            input_multipliers: vec![0; 3],
            hidden_multipliers: vec![0; 3],
            shifts: vec![0; 3],
            biases: vec![r, z, input, hidden],
            output_weights: vec![1, -1],
            output_bias: vec![0, 1],
            output_pre_shift: 0,
            output_requant: [Requant { multiplier: 1 << 23, shift: 23 }; 2],
            tanh_table: tanh_table(),
        }
    }

    #[test]
    fn bias_vectors_are_r_z_input_hidden() {
        let run = |decoder, h: f64| execute_decoder(decoder, vec![h], [0.0, 0.0]).unwrap()[..2].to_vec();
        let far = 1 << 20;
        // z = 32767/32768 keeps the state: R(0 + 32767·1000, 15) = 1000.
        assert_eq!(run(biased(0, far, 0, 0), 1000.0), [1000.0, -999.0]);
        // z = 1/32768 takes the candidate tanh(1): R(24956·32767 + 1·1000, 15).
        let candidate = f64::from(tanh_table()[64]);
        let taken = ((candidate * 32767.0 + 1000.0) / 32768.0 + 0.5).floor();
        assert_eq!(run(biased(0, -far, 4096, 0), 1000.0), [taken, 1.0 - taken]);
        // The reset gate scales the hidden half alone: r = 1/2 of 2.0 is 1.0, r ≈ 0 leaves nothing of it.
        assert_eq!(run(biased(0, -far, 0, 8192), 1000.0), [taken, 1.0 - taken]);
        assert_eq!(run(biased(-far, -far, 0, 8192), 0.0), run(biased(0, -far, 0, 0), 0.0));
    }

    #[test]
    fn opposite_halves_of_the_candidate_cancel_before_the_table() {
        // i = 20.0 and r·j ≈ −19.0 lie beyond i16 Q12; their sum 1.0 does not. r = 1 − 2^−15 costs up to 8 codes.
        let decoder = biased(1 << 20, -(1 << 20), 20 * 4096, -19 * 4096);
        let h = execute_decoder(decoder, vec![0.0], [0.0, 0.0]).unwrap()[0];
        assert!((h - 32768.0 * 1f64.tanh()).abs() < 12.0, "{h}");
    }

    #[test]
    fn misfitting_arrays_are_malformed() {
        let with = |change: fn(&mut QWaypointDecoder)| {
            let mut decoder = biased(0, 0, 0, 0);
            change(&mut decoder);
            execute_decoder(decoder, vec![0.0], [0.0, 0.0]).map_err(|e| e.code)
        };
        assert!(with(|_| {}).is_ok());
        assert_eq!(with(|d| d.concat = true), Err(ErrorCode::Malformed));
        assert_eq!(with(|d| d.biases.truncate(3)), Err(ErrorCode::Malformed));
        assert_eq!(with(|d| d.tanh_table.truncate(512)), Err(ErrorCode::Malformed));
        assert_eq!(with(|d| d.hidden_fraction_bits = 16), Err(ErrorCode::Malformed));
        assert_eq!(with(|d| d.biases[0] = 1 << 53), Err(ErrorCode::Numeric));
    }
}
