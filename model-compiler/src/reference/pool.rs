//! Maxima and means over windows or whole maps.

use super::conv2d::tap;
use crate::ir::Shape;
use firmware::program::Window;

/// Maximum over each window; padding never wins.
pub(super) fn max_pool(window: &Window, shape: Shape, map: &[f32], output: Shape) -> Vec<f32> {
    let mut out = vec![f32::NEG_INFINITY; output.elements() as usize];
    for_each_window(window, shape, map, output, &mut out, |best, taps| {
        for tap in taps {
            for (best, &x) in best.iter_mut().zip(*tap) {
                if x > *best || x.is_nan() {
                    *best = x;
                }
            }
        }
    });
    out
}

/// Mean over the part of each window that lies inside the map.
pub(super) fn average_pool(window: &Window, shape: Shape, map: &[f32], output: Shape) -> Vec<f32> {
    let mut out = vec![0.0; output.elements() as usize];
    for_each_window(window, shape, map, output, &mut out, |mean, taps| add_mean(mean, taps.iter().copied()));
    out
}

/// Mean over all positions of each map, the maps' means added.
pub(super) fn global_pool(maps: &[&[f32]], channels: usize) -> Vec<f32> {
    let mut out = vec![0.0; channels];
    for map in maps {
        add_mean(&mut out, map.chunks_exact(channels));
    }
    out
}

/// Adds the mean of the rows, summed in f64.
pub(super) fn add_mean<'a>(out: &mut [f32], rows: impl ExactSizeIterator<Item = &'a [f32]>) {
    let count = rows.len() as f64;
    let mut sums = vec![0.0; out.len()];
    for row in rows {
        for (sum, &x) in sums.iter_mut().zip(row) {
            *sum += f64::from(x);
        }
    }
    for (out, sum) in out.iter_mut().zip(sums) {
        *out += (sum / count) as f32;
    }
}

/// Calls `reduce` for each output position with its channels and the taps inside the map (channels each).
fn for_each_window(
    w: &Window,
    shape: Shape,
    map: &[f32],
    output: Shape,
    out: &mut [f32],
    reduce: impl Fn(&mut [f32], &[&[f32]]),
) {
    let (height, width, channels) = (usize::from(shape.height), usize::from(shape.width), usize::from(shape.channels));
    let mut taps = Vec::new();
    for (i, out) in out.chunks_exact_mut(channels).enumerate() {
        let (out_y, out_x) = (i / usize::from(output.width), i % usize::from(output.width));
        taps.clear();
        for y in (0..w.kernel_h).filter_map(|k| tap(out_y, w.stride_h, k, w.dilation_h, w.pad_top, height)) {
            for x in (0..w.kernel_w).filter_map(|k| tap(out_x, w.stride_w, k, w.dilation_w, w.pad_left, width)) {
                taps.push(&map[(y * width + x) * channels..][..channels]);
            }
        }
        reduce(out, &taps);
    }
}

#[cfg(test)]
mod tests {
    use super::super::testing::{assert_close, values};
    use super::*;

    const POOL_3X3_STRIDE_2: Window = Window::square(3, 2, 1);

    /// The values under a window, straight from the definition.
    fn under(w: &Window, shape: Shape, map: &[f32], oy: i32, ox: i32, c: usize) -> Vec<f64> {
        let mut found = Vec::new();
        for ky in 0..i32::from(w.kernel_h) {
            for kx in 0..i32::from(w.kernel_w) {
                let y = oy * i32::from(w.stride_h) + ky * i32::from(w.dilation_h) - i32::from(w.pad_top);
                let x = ox * i32::from(w.stride_w) + kx * i32::from(w.dilation_w) - i32::from(w.pad_left);
                if (0..i32::from(shape.height)).contains(&y) && (0..i32::from(shape.width)).contains(&x) {
                    let at = (y * i32::from(shape.width) + x) as usize * usize::from(shape.channels) + c;
                    found.push(f64::from(map[at]));
                }
            }
        }
        found
    }

    fn check(pool: impl Fn(&Window, Shape, &[f32], Shape) -> Vec<f32>, reduce: impl Fn(&[f64]) -> f64) {
        for seed in 0..20_u64 {
            let vary = |at: u64, limit: u64| (seed * 7 + at * 3) % limit;
            let shape = Shape::map(4 + vary(1, 5) as u16, 4 + vary(2, 4) as u16, 1 + vary(3, 3) as u16);
            let window = Window { stride_w: 1 + vary(4, 3) as u8, kernel_h: 2 + vary(5, 2) as u8, ..POOL_3X3_STRIDE_2 };
            let (h, w) = window.output_size(shape.height, shape.width).unwrap();
            // Negative throughout: padding that counted as zero would win the maximum.
            let map: Vec<f32> = values(seed, shape.elements() as usize).iter().map(|v| v - 2.0).collect();
            let mut expected = Vec::new();
            for (y, x) in (0..i32::from(h)).flat_map(|y| (0..i32::from(w)).map(move |x| (y, x))) {
                for c in 0..usize::from(shape.channels) {
                    expected.push(reduce(&under(&window, shape, &map, y, x, c)));
                }
            }
            assert_close(&pool(&window, shape, &map, Shape::map(h, w, shape.channels)), &expected, 1e-6);
        }
    }

    #[test]
    fn max_pool_meets_the_definition() {
        check(max_pool, |v| v.iter().copied().fold(f64::NEG_INFINITY, f64::max));
    }

    #[test]
    fn average_pool_meets_the_definition() {
        check(average_pool, |v| v.iter().sum::<f64>() / v.len() as f64);
    }

    #[test]
    fn global_pool_adds_the_means_of_maps_of_different_sizes() {
        let (a, b) = ([1.0, 10.0, 3.0, 30.0], [5.0, 7.0]);
        assert_eq!(global_pool(&[&a], 2), [2.0, 20.0]);
        assert_eq!(global_pool(&[&a, &b], 2), [7.0, 27.0]);
    }
}
