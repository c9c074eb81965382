//! Convolution: patches of the map as rows of a matrix, times the weights.

use super::elementwise::{finish, normalize};
use super::matmul::{Panels, ROWS_PER_TASK};
use crate::ir::{Conv2d, Shape};
use firmware::program::Window;
use rayon::prelude::*;
use std::borrow::Cow;

/// `[map]` or `[map, residual]` to `output`, see [`Conv2d`].
pub(super) fn conv2d(conv: &Conv2d, shape: Shape, inputs: &[&[f32]], output: Shape) -> Vec<f32> {
    let map: Cow<[f32]> = match &conv.normalization {
        Some(n) => Cow::Owned(normalize(n, inputs[0])),
        None => Cow::Borrowed(inputs[0]),
    };
    let groups = usize::from(conv.groups);
    let outputs = usize::from(output.channels);
    let outputs_per_group = outputs / groups;
    let depth = conv.weights.data.len() / outputs;
    let panels: Vec<Panels> =
        conv.weights.data.chunks_exact(outputs_per_group * depth).map(|w| Panels::new(w, outputs_per_group)).collect();
    let patches = Patches { map: &map, shape, window: conv.window, output, groups };

    let mut out = vec![0.0; output.elements() as usize];
    out.par_chunks_mut(ROWS_PER_TASK * outputs).enumerate().for_each(|(task, out)| {
        let mut rows = vec![0.0; out.len() / outputs * depth];
        for (group, panels) in panels.iter().enumerate() {
            for (i, row) in rows.chunks_exact_mut(depth).enumerate() {
                patches.gather(group, task * ROWS_PER_TASK + i, row);
            }
            panels.multiply(&rows, out, outputs, group * outputs_per_group);
        }
    });
    finish(&mut out, conv.bias.as_ref().map(|b| &b[..]), inputs.get(1).copied(), conv.clip);
    out
}

struct Patches<'a> {
    map: &'a [f32],
    shape: Shape,
    window: Window,
    output: Shape,
    groups: usize,
}

impl Patches<'_> {
    /// The inputs of one output position, `[kh][kw][input / groups]`; taps outside the map are zero.
    fn gather(&self, group: usize, position: usize, patch: &mut [f32]) {
        let w = &self.window;
        let (height, width, channels) =
            (usize::from(self.shape.height), usize::from(self.shape.width), usize::from(self.shape.channels));
        let (out_y, out_x) = (position / usize::from(self.output.width), position % usize::from(self.output.width));
        let channels_per_group = channels / self.groups;
        let mut taps = patch.chunks_exact_mut(channels_per_group);
        for ky in 0..w.kernel_h {
            let y = tap(out_y, w.stride_h, ky, w.dilation_h, w.pad_top, height);
            for (kx, tap_out) in (0..w.kernel_w).zip(&mut taps) {
                let x = tap(out_x, w.stride_w, kx, w.dilation_w, w.pad_left, width);
                match (y, x) {
                    (Some(y), Some(x)) => {
                        let at = (y * width + x) * channels + group * channels_per_group;
                        tap_out.copy_from_slice(&self.map[at..][..channels_per_group]);
                    }
                    _ => tap_out.fill(0.0),
                }
            }
        }
    }
}

/// Coordinate of a tap along one axis, or `None` in the padding.
pub(super) fn tap(out: usize, stride: u8, k: u8, dilation: u8, pad: u8, size: usize) -> Option<usize> {
    let padded = out * usize::from(stride) + usize::from(k) * usize::from(dilation);
    padded.checked_sub(usize::from(pad)).filter(|&at| at < size)
}

#[cfg(test)]
mod tests {
    use super::super::testing::{assert_close, values};
    use super::*;
    use crate::ir::Clip;
    use crate::ir::{Normalization, Op, Weights};
    use proptest::prelude::*;
    use std::sync::Arc;

    /// The definition, one output element at a time, in f64.
    fn naive(conv: &Conv2d, shape: Shape, map: &[f32], residual: Option<&[f32]>, output: Shape) -> Vec<f64> {
        let w = &conv.window;
        let per_group = usize::from(shape.channels / conv.groups);
        let outputs_per_group = usize::from(output.channels / conv.groups);
        let mut out = Vec::new();
        for oy in 0..i64::from(output.height) {
            for ox in 0..i64::from(output.width) {
                for o in 0..usize::from(output.channels) {
                    let mut sum = conv.bias.as_ref().map_or(0.0, |b| f64::from(b[o]));
                    for ky in 0..i64::from(w.kernel_h) {
                        for kx in 0..i64::from(w.kernel_w) {
                            let y = oy * i64::from(w.stride_h) + ky * i64::from(w.dilation_h) - i64::from(w.pad_top);
                            let x = ox * i64::from(w.stride_w) + kx * i64::from(w.dilation_w) - i64::from(w.pad_left);
                            if y < 0 || x < 0 || y >= i64::from(shape.height) || x >= i64::from(shape.width) {
                                continue;
                            }
                            for i in 0..per_group {
                                let c = o / outputs_per_group * per_group + i;
                                let at = (y * i64::from(shape.width) + x) as usize * usize::from(shape.channels) + c;
                                let value = match &conv.normalization {
                                    Some(n) => f64::from(map[at] - n.mean[c]) / f64::from(n.std[c]),
                                    None => f64::from(map[at]),
                                };
                                let taps = usize::from(w.kernel_h) * usize::from(w.kernel_w);
                                let tap = ky as usize * usize::from(w.kernel_w) + kx as usize;
                                sum += value * f64::from(conv.weights.data[(o * taps + tap) * per_group + i]);
                            }
                        }
                    }
                    let sum = sum + residual.map_or(0.0, |r| f64::from(r[out.len()]));
                    out.push(sum.clamp(f64::from(conv.clip.min), f64::from(conv.clip.max)));
                }
            }
        }
        out
    }

    fn windows() -> impl Strategy<Value = Window> {
        ((1..4_u8, 1..4_u8, 1..3_u8, 1..3_u8), (0..3_u8, 0..3_u8, 0..3_u8, 0..3_u8), (1..3_u8, 1..3_u8)).prop_map(
            |((kernel_h, kernel_w, stride_h, stride_w), pads, (dilation_h, dilation_w))| {
                let (pad_top, pad_bottom, pad_left, pad_right) = pads;
                Window {
                    kernel_h,
                    kernel_w,
                    stride_h,
                    stride_w,
                    pad_top,
                    pad_bottom,
                    pad_left,
                    pad_right,
                    dilation_h,
                    dilation_w,
                }
            },
        )
    }

    proptest! {
        #[test]
        fn meets_the_definition(
            window in windows(), height in 5..11_u16, width in 5..11_u16, groups in 1..4_u16, inputs in 1..4_u16,
            outputs in 1..9_u16, options in any::<[bool; 4]>(), seed: u64,
        ) {
            let [with_bias, clipped, with_residual, with_normalization] = options;
            let clip = if clipped { Clip { min: 0.0, max: 1.5 } } else { Clip::NONE };
            let (inputs, outputs) = (inputs * groups, outputs * groups);
            let dims = [outputs, u16::from(window.kernel_h), u16::from(window.kernel_w), inputs / groups];
            let dims = dims.map(usize::from).to_vec();
            let normalization = with_normalization.then(|| {
                let std = values(seed ^ 1, inputs.into()).iter().map(|v| 1.5 + v).collect();
                Arc::new(Normalization { mean: values(seed ^ 2, inputs.into()), std })
            });
            let conv = Conv2d {
                weights: Arc::new(Weights { data: values(seed ^ 3, dims.iter().product()), shape: dims }),
                bias: with_bias.then(|| Arc::new(values(seed ^ 4, outputs.into()))),
                window, groups, normalization, clip,
            };
            let shape = Shape::map(height, width, inputs);
            let output = Op::Conv2d(conv.clone()).output_shape(&[shape]).unwrap();
            let map = values(seed ^ 5, shape.elements() as usize);
            let residual = values(seed ^ 6, output.elements() as usize);
            let operands: &[&[f32]] = if with_residual { &[&map, &residual] } else { &[&map] };
            let expected = naive(&conv, shape, &map, operands.get(1).copied(), output);
            assert_close(&conv2d(&conv, shape, operands, output), &expected, 1e-4);
        }
    }
}
