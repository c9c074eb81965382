//! Pooling: the largest code of a window, the mean of a window, the mean of whole maps.

use super::arithmetic::{Exactness, Requantizer};
use super::operands::{Operands, expect, positions};
use super::weighted::{check_window, pixel_index, tap};
use crate::error::{Error, ErrorCode, Result};
use crate::qmodel::{QTensorId, QTerm};
use firmware::program::Window;
use firmware::tensor::Shape;

/// Largest code of each window; positions in the padding are left out.
pub(super) fn max_pool(operands: &Operands, input: QTensorId, output: QTensorId, window: &Window) -> Result<Vec<f64>> {
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

#[cfg(test)]
mod tests {
    use crate::error::ErrorCode;
    use crate::integer_reference::testing::{Random, clamp, execute_alone, rounding_shift};
    use crate::qmodel::{QOp, QTensorId, QTerm};
    use firmware::program::{Requant, Window};
    use firmware::tensor::{ElementType, Shape};

    fn max_pool(window: Window, shape: Shape, codes: &[f64], output: Shape) -> Result<Vec<f64>, ErrorCode> {
        let op = QOp::MaxPool { input: QTensorId(0), output: QTensorId(1), window };
        let input = (shape, ElementType::I8, codes.to_vec());
        execute_alone(op, &[input], (output, ElementType::I8)).map_err(|e| e.code)
    }

    #[test]
    fn padding_never_wins_a_max_pool() {
        let codes = [-128.0, 5.0, -127.0, -9.0, -126.0, -9.0];
        let shape = Shape::map(1, 3, 2);
        let pooled = max_pool(Window::square(3, 2, 1), shape, &codes, Shape::map(1, 2, 2));
        assert_eq!(pooled, Ok(vec![-127.0, 5.0, -126.0, -9.0]));
        let only_padding = Window { kernel_h: 1, kernel_w: 1, ..Window::square(1, 1, 1) };
        assert_eq!(max_pool(only_padding, shape, &codes, Shape::map(3, 5, 2)), Err(ErrorCode::Malformed));
    }

    #[test]
    fn average_pool_takes_full_windows_and_rounds_ties_up() {
        let average = |codes: &[f64]| {
            let op = QOp::AveragePool {
                input: QTensorId(0),
                output: QTensorId(1),
                window: Window::square(2, 2, 0),
                input_zero_point: 10,
                requant: Requant { multiplier: 1 << 23, shift: 25 },
                zero_point: -3,
                clamp: clamp(-128, 127),
            };
            let input = (Shape::map(2, 5, 1), ElementType::I8, codes.to_vec());
            execute_alone(op, &[input], (Shape::map(1, 2, 1), ElementType::I8)).unwrap()
        };
        // Σ(q − 10) = 2 and −2: means 0.5 → 1 and −0.5 → 0; the fifth column belongs to no full window.
        assert_eq!(average(&[10.0, 11.0, 10.0, 9.0, 99.0, 11.0, 10.0, 9.0, 10.0, 99.0]), [-2.0, -3.0]);
        assert_eq!(average(&[-128.0; 10]), [-128.0, -128.0]);
    }

    #[test]
    fn global_pool_adds_two_maps_with_one_rounding() {
        let seed = 0x9001;
        let mut random = Random(seed);
        let (shape, channels) = (Shape::map(8, 8, 12), 12);
        let maps = [random.codes(768, -128, 127), random.codes(768, -32768, 32767)];
        let terms = [(7, 1_234_567_890), (0, 4_123_457)].map(|(zero_point, multiplier)| QTerm {
            tensor: QTensorId(0),
            zero_point,
            multiplier,
        });
        let [first, second] = [terms[0], QTerm { tensor: QTensorId(1), ..terms[1] }];
        let op = QOp::GlobalPool {
            first,
            second: Some(second),
            output: QTensorId(2),
            shift: 33,
            zero_point: 0,
            clamp: clamp(-32768, 32767),
        };
        let operands = [(shape, ElementType::I8, maps[0].clone()), (shape, ElementType::I16, maps[1].clone())];
        let codes = execute_alone(op, &operands, (Shape::vector(12), ElementType::I16)).unwrap();
        for (channel, &code) in codes.iter().enumerate() {
            let sum = |map: &[f64], term: QTerm| {
                let of_channel = map.iter().skip(channel).step_by(channels);
                of_channel
                    .map(|&q| (q as i128 - i128::from(term.zero_point)) * i128::from(term.multiplier))
                    .sum::<i128>()
            };
            let expected = rounding_shift(sum(&maps[0], first) + sum(&maps[1], second), 33).clamp(-32768, 32767);
            assert_eq!(code as i128, expected, "channel {channel}, seed {seed:#x}");
        }
    }
}
