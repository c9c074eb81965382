//! The GRU decoder: i16 weights with one scale per row, pre-activations in Q12, waypoints in Q16 meters.

use super::factors::{self, Factor, bits, round};
use super::{Builder, bounds_of, tables};
use crate::error::{Error, ErrorCode, Result};
use crate::ir::{Node, WaypointDecoder, Weights};
use crate::qmodel::{QOp, QWaypointDecoder};
use firmware::program::Requant;

/// Accumulator bits after the pre-shift, and the largest shift of a gate row.
const ACCUMULATOR_BITS: u32 = 28;
const MAX_GATE_SHIFT: u8 = 30;

/// i16 rows with one scale each.
struct Rows {
    codes: Vec<i16>,
    scales: Vec<f64>,
    /// `Σ|w|·32768` per row.
    bounds: Vec<f64>,
    pre_shift: u8,
}

impl Rows {
    fn quantize(weights: &Weights, extra_bound: impl Fn(usize, f64) -> f64) -> Self {
        let depth = weights.shape[1];
        let mut rows = Self { codes: Vec::new(), scales: Vec::new(), bounds: Vec::new(), pre_shift: 0 };
        for (r, row) in weights.data.chunks_exact(depth).enumerate() {
            let largest = row.iter().fold(0.0, |m: f64, &w| m.max(f64::from(w.abs())));
            let scale = if largest == 0.0 { 1.0 } else { largest / 32767.0 };
            let codes = row.iter().map(|&w| round(f64::from(w) / scale).clamp(-32767.0, 32767.0));
            let magnitude: f64 = codes.clone().map(f64::abs).sum();
            rows.codes.extend(codes.map(|q| q as i16));
            rows.scales.push(scale);
            rows.bounds.push(32768.0 * magnitude + extra_bound(r, scale));
        }
        let largest = rows.bounds.iter().copied().fold(0.0, f64::max);
        rows.pre_shift = bits(largest).saturating_sub(ACCUMULATOR_BITS) as u8;
        rows
    }

    fn unit(&self) -> f64 {
        f64::exp2(f64::from(self.pre_shift))
    }

    fn largest(&self) -> f64 {
        self.bounds.iter().copied().fold(0.0, f64::max)
    }
}

impl Builder<'_> {
    pub(super) fn waypoint_decoder(&mut self, node: &Node, decoder: &WaypointDecoder) -> Result<()> {
        let (hidden, goal) = (self.tensor(node.inputs[0]), self.tensor(node.inputs[1]));
        let output = self.tensor(node.output);
        let hidden_scale = self.scale(hidden);
        let size = decoder.hidden_weights.shape[1];
        let input_rows = Rows::quantize(&decoder.input_weights, |_, _| 0.0);
        let hidden_rows = Rows::quantize(&decoder.hidden_weights, |_, _| 0.0);
        let mut q = QWaypointDecoder {
            hidden,
            goal,
            output,
            hidden_fraction_bits: -factors::floor_log2(hidden_scale) as u8,
            concat: decoder.input_weights.shape[1] == 4,
            input_pre_shift: input_rows.pre_shift,
            hidden_pre_shift: hidden_rows.pre_shift,
            input_multipliers: Vec::with_capacity(3 * size),
            hidden_multipliers: Vec::with_capacity(3 * size),
            shifts: Vec::with_capacity(3 * size),
            biases: vec![0; 4 * size],
            output_weights: Vec::new(),
            output_bias: Vec::new(),
            output_pre_shift: 0,
            output_requant: [Requant { multiplier: 0, shift: 0 }; 2],
            tanh_table: tables::tanh_table(),
            input_weights: Vec::new(),
            hidden_weights: Vec::new(),
        };
        let mut worst = 0.0;
        for row in 0..3 * size {
            let (input_bias, hidden_bias) = (f64::from(decoder.input_bias[row]), f64::from(decoder.hidden_bias[row]));
            let factors = [
                Factor {
                    m: input_rows.scales[row] * f64::exp2(4.0) * input_rows.unit(),
                    bound: input_rows.bounds[row] / input_rows.unit() + 1.0,
                },
                Factor {
                    m: hidden_rows.scales[row] * hidden_scale * f64::exp2(12.0) * hidden_rows.unit(),
                    bound: hidden_rows.bounds[row] / hidden_rows.unit() + 1.0,
                },
            ];
            let offset = (input_bias.abs() + hidden_bias.abs()) * f64::exp2(12.0);
            let terms =
                factors::terms(&factors, offset, MAX_GATE_SHIFT).map_err(|e| e.within(format!("GRU row {row}")))?;
            q.input_multipliers.push(terms.multipliers[0]);
            q.hidden_multipliers.push(terms.multipliers[1]);
            q.shifts.push(terms.shift);
            worst = f64::max(worst, terms.bound);
            let unit = f64::exp2(f64::from(terms.shift) + 12.0);
            if row < 2 * size {
                q.biases[row] = round((input_bias + hidden_bias) * unit) as i64;
            } else {
                q.biases[row] = round(input_bias * unit) as i64;
                q.biases[row + size] = round(hidden_bias * unit) as i64;
            }
        }
        let output_rows = Rows::quantize(&decoder.output_weights, |row, scale| {
            (f64::from(decoder.output_bias[row]) / (scale * hidden_scale)).abs() + 1.0
        });
        if bits(output_rows.largest()) > 52 {
            return Err(Error::new(ErrorCode::Numeric, "output layer", "the bias exceeds 52 bits"));
        }
        q.output_pre_shift = output_rows.pre_shift;
        for (row, requant) in q.output_requant.iter_mut().enumerate() {
            let scale = output_rows.scales[row] * hidden_scale;
            q.output_bias.push(round(f64::from(decoder.output_bias[row]) / scale) as i64);
            *requant = factors::requant(scale * f64::exp2(16.0) * output_rows.unit())?;
            worst =
                f64::max(worst, (output_rows.bounds[row] / output_rows.unit() + 1.0) * f64::from(requant.multiplier));
        }
        let accumulator = input_rows.largest().max(hidden_rows.largest()).max(output_rows.largest());
        q.input_weights = input_rows.codes;
        q.hidden_weights = hidden_rows.codes;
        q.output_weights = output_rows.codes;
        self.step(node, QOp::WaypointDecoder(q), bounds_of(bits(accumulator), &[worst], 0.0));
        Ok(())
    }
}
