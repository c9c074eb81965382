//! Scaled dot-product attention with heads.

use crate::ir::Shape;
use rayon::prelude::*;

/// `[query, key, value]`, each `T×C`: softmax(q·kᵀ/√(C/heads))·v per head; head h owns channels `h·C/heads ..`.
pub(super) fn attention(heads: u16, shape: Shape, inputs: &[&[f32]]) -> Vec<f32> {
    let &[queries, keys, values] = inputs else { unreachable!("three operands, checked by the shape rule") };
    let (tokens, channels) = (shape.positions() as usize, usize::from(shape.channels));
    let weights = attention_weights(heads, shape, queries, keys);
    let depth = channels / usize::from(heads);
    let mut out = vec![0.0; tokens * channels];
    let rows = weights.par_chunks_exact(tokens * usize::from(heads));
    out.par_chunks_exact_mut(channels).zip(rows).for_each(|(out, rows)| {
        for (head, (context, row)) in out.chunks_exact_mut(depth).zip(rows.chunks_exact(tokens)).enumerate() {
            for (&weight, value) in row.iter().zip(values.chunks_exact(channels)) {
                add_scaled(context, weight, &value[head * depth..][..depth]);
            }
        }
    });
    out
}

/// softmax(q·kᵀ/√(C/heads)) of [`Op::Attention`](crate::ir::Op::Attention) with queries and keys `T×C`: by query, then
/// head, a row of T weights that add up to 1.
pub fn attention_weights(heads: u16, shape: Shape, queries: &[f32], keys: &[f32]) -> Vec<f32> {
    let (tokens, channels) = (shape.positions() as usize, usize::from(shape.channels));
    let depth = channels / usize::from(heads);
    let columns = transpose(keys, channels);
    let mut weights = vec![0.0; tokens * usize::from(heads) * tokens];
    let rows = weights.par_chunks_exact_mut(tokens * usize::from(heads));
    rows.zip(queries.par_chunks_exact(channels)).for_each(|(rows, query)| {
        for (head, row) in rows.chunks_exact_mut(tokens).enumerate() {
            for c in head * depth..(head + 1) * depth {
                add_scaled(row, query[c], &columns[c * tokens..][..tokens]);
            }
            softmax(row, 1.0 / (depth as f64).sqrt());
        }
    });
    weights
}

/// `T×C` to `C×T`.
fn transpose(rows: &[f32], channels: usize) -> Vec<f32> {
    (0..channels).flat_map(|c| rows.iter().skip(c).step_by(channels).copied()).collect()
}

fn add_scaled(out: &mut [f32], factor: f32, x: &[f32]) {
    for (out, x) in out.iter_mut().zip(x) {
        *out += factor * x;
    }
}

/// `exp(scale·(x − max))` over its sum, exponentials and sum in f64.
fn softmax(scores: &mut [f32], scale: f64) {
    let max = scores.iter().copied().fold(f32::NEG_INFINITY, f32::max);
    let powers: Vec<f64> = scores.iter().map(|&x| (scale * (f64::from(x) - f64::from(max))).exp()).collect();
    let sum: f64 = powers.iter().sum();
    for (out, power) in scores.iter_mut().zip(powers) {
        *out = (power / sum) as f32;
    }
}

#[cfg(test)]
mod tests {
    use super::super::testing::{assert_close, values};
    use super::*;

    /// The definition in f64, one output element at a time.
    fn naive(heads: usize, tokens: usize, channels: usize, q: &[f32], k: &[f32], v: &[f32]) -> Vec<f64> {
        let depth = channels / heads;
        let mut out = Vec::new();
        for t in 0..tokens {
            for c in 0..channels {
                let first = c / depth * depth;
                let score = |j: usize| {
                    let product = |i: usize| f64::from(q[t * channels + i]) * f64::from(k[j * channels + i]);
                    (first..first + depth).map(product).sum::<f64>() / (depth as f64).sqrt()
                };
                let sum: f64 = (0..tokens).map(|j| score(j).exp()).sum();
                out.push((0..tokens).map(|j| score(j).exp() / sum * f64::from(v[j * channels + c])).sum());
            }
        }
        out
    }

    #[test]
    fn meets_the_definition() {
        for (seed, (heads, tokens, depth)) in
            [(1, 1, 1), (1, 5, 3), (2, 7, 4), (4, 9, 2), (3, 16, 5)].iter().enumerate()
        {
            let (seed, channels) = (10 * seed as u64, heads * depth);
            let [q, k, v] = [1, 2, 3].map(|i| values(seed + i, tokens * channels));
            // Scores of several units, so that the softmax is far from uniform.
            let q: Vec<f32> = q.iter().map(|x| 8.0 * x).collect();
            let shape = Shape::tokens(*tokens as u16, channels as u16);
            let expected = naive(*heads, *tokens, channels, &q, &k, &v);
            assert_close(&attention(*heads as u16, shape, &[&q, &k, &v]), &expected, 1e-5);
        }
    }

    #[test]
    fn weights_stand_by_query_and_head_and_add_up_to_one() {
        // Two heads of one channel; logits of query 0 are 0 and ln 3 in head 0, equal in head 1.
        let keys = [0.0, 1.0, 1.0, 1.0];
        let queries = [3.0_f32.ln(), 0.0, 0.0, 50.0];
        let found = attention_weights(2, Shape::tokens(2, 2), &queries, &keys);
        assert_close(&found, &[0.25, 0.75, 0.5, 0.5, 0.5, 0.5, 0.5, 0.5], 1e-6);
        let found = attention_weights(1, Shape::tokens(2, 2), &queries, &keys);
        let first = 1.0 / (1.0 + (3.0_f64.ln() / 2.0_f64.sqrt()).exp());
        assert_close(&found, &[first, 1.0 - first, 0.5, 0.5], 1e-6);
    }

    #[test]
    fn huge_scores_do_not_overflow() {
        let found = attention(1, Shape::tokens(2, 1), &[&[1e4, -1e4], &[1e4, -1e4], &[3.0, 5.0]]);
        assert_eq!(found, [3.0, 5.0]);
    }
}
