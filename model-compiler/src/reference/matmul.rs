//! The one matrix product: rows of `depth` values times weights `[outputs][depth]`.
//!
//! Each result is one running sum over the depth, multiply and add rounded apart, whatever the machine: wide vectors
//! hold more outputs, never more summands. So any number of threads and any CPU give the same bits, and a calibration
//! made on one machine is the calibration made on every other.

use rayon::prelude::*;

/// Outputs computed side by side (one AVX-512 vector, two of AVX2, four of SSE or NEON).
const LANES: usize = 16;

/// Rows computed side by side: enough independent sums to hide the latency of an addition.
const TILE: usize = 6;

/// Rows that one task computes; its patches stay in the second-level cache.
pub(super) const ROWS_PER_TASK: usize = 24;

/// Weights regrouped so that one step of the depth reads [`LANES`] neighboring outputs; missing outputs are zero.
pub(super) struct Panels {
    outputs: usize,
    depth: usize,
    /// `[panel][depth]`.
    data: Vec<[f32; LANES]>,
}

impl Panels {
    /// Regroups row-major `[outputs][depth]`.
    pub(super) fn new(weights: &[f32], outputs: usize) -> Self {
        let depth = weights.len() / outputs;
        let mut data = vec![[0.0; LANES]; outputs.div_ceil(LANES) * depth];
        data.par_chunks_mut(depth).zip(weights.par_chunks(LANES * depth)).for_each(|(panel, rows)| {
            for (k, lanes) in panel.iter_mut().enumerate() {
                for (lane, row) in lanes.iter_mut().zip(rows.chunks_exact(depth)) {
                    *lane = row[k];
                }
            }
        });
        Self { outputs, depth, data }
    }

    /// `out[r·stride + first + o] = Σ_k rows[r][k]·weights[o][k]` for row-major `rows` of `depth` values each.
    pub(super) fn multiply(&self, rows: &[f32], out: &mut [f32], stride: usize, first: usize) {
        pulp::Arch::new().dispatch(Product { panels: self, rows, out, stride, first });
    }
}

/// The arguments of [`Panels::multiply`]. Its code is compiled once per instruction set, with everything inlined.
struct Product<'a> {
    panels: &'a Panels,
    rows: &'a [f32],
    out: &'a mut [f32],
    stride: usize,
    first: usize,
}

impl pulp::WithSimd for Product<'_> {
    type Output = ();

    #[inline(always)]
    fn with_simd<S: pulp::Simd>(self, _: S) {
        let Self { panels: &Panels { outputs, depth, ref data }, rows, out, stride, first } = self;
        for (p, panel) in data.chunks_exact(depth).enumerate() {
            let column = first + p * LANES;
            let width = LANES.min(outputs - p * LANES);
            let mut tiles = rows.chunks_exact(TILE * depth);
            let mut r = 0;
            for tile in &mut tiles {
                for sums in sums::<TILE>(tile, panel) {
                    out[r * stride + column..][..width].copy_from_slice(&sums[..width]);
                    r += 1;
                }
            }
            for row in tiles.remainder().chunks_exact(depth) {
                let [sums] = sums::<1>(row, panel);
                out[r * stride + column..][..width].copy_from_slice(&sums[..width]);
                r += 1;
            }
        }
    }
}

/// Products of `ROWS` rows with one panel. Counted loops, not iterators: these unroll, so the sums stay in registers.
#[inline(always)]
fn sums<const ROWS: usize>(rows: &[f32], panel: &[[f32; LANES]]) -> [[f32; LANES]; ROWS] {
    let depth = panel.len();
    let rows: [&[f32]; ROWS] = std::array::from_fn(|r| &rows[r * depth..][..depth]);
    let mut sums = [[0.0; LANES]; ROWS];
    for (k, weights) in panel.iter().enumerate() {
        let x: [f32; ROWS] = std::array::from_fn(|r| rows[r][k]);
        for r in 0..ROWS {
            for o in 0..LANES {
                sums[r][o] += x[r] * weights[o];
            }
        }
    }
    sums
}

#[cfg(test)]
mod tests {
    use super::super::testing::values;
    use super::*;
    use proptest::prelude::*;

    proptest! {
        /// Bit for bit, not within a tolerance: the order of the sum is part of the promise.
        #[test]
        fn every_result_is_one_running_sum(
            rows in 1..20_usize, outputs in 1..40_usize, depth in 1..50_usize, first in 0..3_usize, seed: u64,
        ) {
            let x = values(seed, rows * depth);
            let w = values(seed ^ 1, outputs * depth);
            let stride = outputs + 4;
            let mut out = vec![f32::NAN; rows * stride];
            Panels::new(&w, outputs).multiply(&x, &mut out, stride, first);
            for r in 0..rows {
                for c in 0..stride {
                    let found = out[r * stride + c];
                    if c < first || c >= first + outputs {
                        prop_assert!(found.is_nan(), "column {c} outside the result was written");
                        continue;
                    }
                    let w = &w[(c - first) * depth..][..depth];
                    let expected = x[r * depth..][..depth].iter().zip(w).fold(0.0, |sum, (x, w)| sum + x * w);
                    prop_assert_eq!(found, expected, "row {} column {}", r, c);
                }
            }
        }
    }
}
