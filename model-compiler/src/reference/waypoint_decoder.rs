//! GRU cell and output layer, run once per waypoint; f64 inside.

use crate::ir::{WaypointDecoder, Weights};

/// `[hidden, goal]` to `steps × 2`, see [`WaypointDecoder`].
pub(super) fn waypoint_decoder(decoder: &WaypointDecoder, inputs: &[&[f32]]) -> Vec<f32> {
    let mut hidden = widen(inputs[0]);
    let goal = widen(inputs[1]);
    let concatenates = decoder.input_weights.shape[1] == 4;
    let mut waypoint = [0.0; 2];
    let mut out = Vec::new();
    for _ in 0..decoder.steps {
        let input = if concatenates {
            vec![waypoint[0], waypoint[1], goal[0], goal[1]]
        } else {
            vec![waypoint[0] + goal[0], waypoint[1] + goal[1]]
        };
        hidden = gru_cell(decoder, &input, &hidden);
        let step = affine(&decoder.output_weights, &decoder.output_bias, &hidden);
        for (w, d) in waypoint.iter_mut().zip(step) {
            *w += d;
            out.push(*w as f32);
        }
    }
    out
}

/// One step of the cell; rows of the weights are the gates r, z, n.
fn gru_cell(decoder: &WaypointDecoder, input: &[f64], hidden: &[f64]) -> Vec<f64> {
    let from_input = affine(&decoder.input_weights, &decoder.input_bias, input);
    let from_hidden = affine(&decoder.hidden_weights, &decoder.hidden_bias, hidden);
    let size = hidden.len();
    let cell = |i: usize| {
        let reset = sigmoid(from_input[i] + from_hidden[i]);
        let update = sigmoid(from_input[size + i] + from_hidden[size + i]);
        let new = (from_input[2 * size + i] + reset * from_hidden[2 * size + i]).tanh();
        (1.0 - update) * new + update * hidden[i]
    };
    (0..size).map(cell).collect()
}

fn sigmoid(x: f64) -> f64 {
    1.0 / (1.0 + (-x).exp())
}

fn widen(x: &[f32]) -> Vec<f64> {
    x.iter().map(|&v| f64::from(v)).collect()
}

/// `weights · x + bias`.
fn affine(weights: &Weights, bias: &[f32], x: &[f64]) -> Vec<f64> {
    let product = |row: &[f32]| row.iter().zip(x).map(|(&w, x)| f64::from(w) * x).sum::<f64>();
    weights.data.chunks_exact(x.len()).zip(bias).map(|(row, &b)| product(row) + f64::from(b)).collect()
}

#[cfg(test)]
mod tests {
    use super::super::testing::assert_close;
    use super::*;
    use std::sync::Arc;

    fn matrix(rows: usize, data: &[f32]) -> Arc<Weights> {
        Arc::new(Weights { shape: vec![rows, data.len() / rows], data: data.to_vec() })
    }

    /// One hidden unit; the output layer emits `[2·h, −h]`.
    fn decoder(input_weights: &[f32], input_bias: [f32; 3], hidden_bias: [f32; 3]) -> WaypointDecoder {
        WaypointDecoder {
            input_weights: matrix(3, input_weights),
            hidden_weights: matrix(3, &[0.0, 0.0, 1.0]),
            input_bias: Arc::new(input_bias.to_vec()),
            hidden_bias: Arc::new(hidden_bias.to_vec()),
            output_weights: matrix(2, &[2.0, -1.0]),
            output_bias: Arc::new(vec![0.0, 0.5]),
            steps: 2,
        }
    }

    /// Gates r and z get only biases, so they stay σ(0) = ½ and σ(ln 3) = ¾; the n row adds up waypoint and goal.
    #[test]
    fn adds_waypoint_and_goal_by_hand() {
        let third = 3.0_f32.ln();
        let d = decoder(&[0.0, 0.0, 0.0, 0.0, 0.25, 0.5], [0.0, third, 0.0], [0.0, 0.0, 2.0]);
        // Step 1: u = goal = (4, −2); n = tanh(1 − 1 + ½·(1·h0 + 2)) = tanh(1.5), h1 = ¼·tanh(1.5) + ¾·1.
        let h1 = 0.25 * 1.5_f64.tanh() + 0.75;
        let w1 = [2.0 * h1, 0.5 - h1];
        // Step 2: u = w1 + goal.
        let n2 = (0.25 * (w1[0] + 4.0) + 0.5 * (w1[1] - 2.0) + 0.5 * (h1 + 2.0)).tanh();
        let h2 = 0.25 * n2 + 0.75 * h1;
        let w2 = [w1[0] + 2.0 * h2, w1[1] + 0.5 - h2];
        assert_close(&waypoint_decoder(&d, &[&[1.0], &[4.0, -2.0]]), &[w1[0], w1[1], w2[0], w2[1]], 1e-6);
    }

    /// The bias of the hidden product lies inside the reset gate, the bias of the input outside.
    #[test]
    fn closed_reset_gate_hides_the_hidden_bias() {
        let closed = -200.0;
        let d = decoder(&[0.0; 6], [closed, closed, 0.5], [0.0, 0.0, 100.0]);
        let h = 0.5_f64.tanh();
        let expected = [2.0 * h, 0.5 - h, 4.0 * h, 1.0 - 2.0 * h];
        assert_close(&waypoint_decoder(&d, &[&[1.0], &[0.0, 0.0]]), &expected, 1e-6);
    }

    #[test]
    fn concatenates_waypoint_and_goal() {
        // The n row reads only the goal's second value, then also the first waypoint's second.
        let mut weights = [0.0; 12];
        weights[9] = 1.0;
        weights[11] = 0.25;
        let d = decoder(&weights, [-200.0, -200.0, 0.0], [0.0; 3]);
        let h1 = (-0.5_f64).tanh();
        let w1 = [2.0 * h1, 0.5 - h1];
        let h2 = (w1[1] - 0.5).tanh();
        let expected = [w1[0], w1[1], w1[0] + 2.0 * h2, w1[1] + 0.5 - h2];
        assert_close(&waypoint_decoder(&d, &[&[1.0], &[9.0, -2.0]]), &expected, 1e-6);
    }
}
