//! Pooling: the largest code of a window, the mean of a window, the mean of whole maps.

use super::arithmetic::{Exactness, Requantizer};
use super::operands::{Operands, expect, positions};
use super::weighted::{check_window, pixel_index, tap};
use crate::error::{Error, ErrorCode, Result};
use crate::qmodel::{QTensorId, QTerm};
use firmware::program::Window;
use firmware::tensor::Shape;

/// Largest code of each window; positions in the padding are left out.
pub(super) fn max_pool(
    operands: &Operands,
    input: QTensorId,
    output: QTensorId,
    window: &Window,
) -> Result<Vec<f64>> {
    let (shape, out_shape) = (operands.shape(input)?, operands.shape(output)?);
    check_pool(window, shape, out_shape)?;
    let largest = fold_windows(operands.codes(input)?, shape, out_shape, window, f64::NEG_INFINITY, f64::max);
    if largest.contains(&f64::NEG_INFINITY) {
        return Err(Error::new(ErrorCode::Malformed, "", format!("{window:?} has windows that see padding only")));
    }
    Ok(largest)
}

/// `y = clamp(z_o + R(Σ(q − z)·M, n))` over full windows.
pub(super) fn average_pool(
    operands: &Operands,
    input: QTerm,
    output: QTensorId,
    window: &Window,
    requantizer: &Requantizer,
) -> Result<Vec<f64>> {
    let (shape, out_shape) = (operands.shape(input.tensor)?, operands.shape(output)?);
    check_pool(window, shape, out_shape)?;
    let edges = [window.pad_top, window.pad_bottom, window.pad_left, window.pad_right];
    expect("padding of an average pool", edges.into_iter().map(usize::from).sum(), 0)?;
    let sums = fold_windows(operands.codes(input.tensor)?, shape, out_shape, window, 0.0, |sum, code| {
        sum + (code - f64::from(input.zero_point))
    });
    let mut exact = Exactness::default();
    let codes = sums.iter().map(|sum| requantizer.code(sum * f64::from(input.multiplier), &mut exact)).collect();
    exact.finish()?;
    Ok(codes)
}

/// `y_c = clamp(z_o + R(Σ_k M_k·Σ_p (q_kpc − z_k), n))`.
pub(super) fn global_pool(
    operands: &Operands,
    terms: &[QTerm],
    output: QTensorId,
    requantizer: &Requantizer,
) -> Result<Vec<f64>> {
    let channels = usize::from(operands.shape(output)?.channels);
    expect("output positions", positions(operands.shape(output)?), 1)?;
    let mut exact = Exactness::default();
    let mut totals = vec![0.0; channels];
    for term in terms {
        expect("channels of the map", usize::from(operands.shape(term.tensor)?.channels), channels)?;
        let mut sums = vec![0.0; channels];
        for position in operands.codes(term.tensor)?.chunks_exact(channels) {
            sums.iter_mut().zip(position).for_each(|(sum, code)| *sum += code - f64::from(term.zero_point));
        }
        for (total, sum) in totals.iter_mut().zip(sums) {
            *total += exact.watch(sum * f64::from(term.multiplier));
        }
    }
    let codes = totals.iter().map(|&total| requantizer.code(total, &mut exact)).collect();
    exact.finish()?;
    Ok(codes)
}

fn check_pool(window: &Window, shape: Shape, output: Shape) -> Result<()> {
    check_window(window, shape, output)?;
    expect("channels of the output", usize::from(output.channels), usize::from(shape.channels))
}

/// Per output position and channel: `fold` over the codes of the window that lie inside the map.
fn fold_windows(
    codes: &[f64],
    shape: Shape,
    output: Shape,
    window: &Window,
    start: f64,
    fold: impl Fn(f64, f64) -> f64,
) -> Vec<f64> {
    let channels = usize::from(shape.channels);
    let mut values = vec![start; positions(output) * channels];
    for (position, row) in values.chunks_exact_mut(channels).enumerate() {
        let (out_y, out_x) = (position / usize::from(output.width), position % usize::from(output.width));
        for tap_y in 0..window.kernel_h {
            let y = tap(out_y, window.stride_h, tap_y, window.dilation_h, window.pad_top);
            for tap_x in 0..window.kernel_w {
                let x = tap(out_x, window.stride_w, tap_x, window.dilation_w, window.pad_left);
                if let Some(pixel) = pixel_index(shape, y, x) {
                    for (value, &code) in row.iter_mut().zip(&codes[pixel * channels..]) {
                        *value = fold(*value, code);
                    }
                }
            }
        }
    }
    values
}
