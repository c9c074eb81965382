//! Portable convolution: windows gathered into scratch, then the product of a tile of them with the weights.

use super::codes::{Code, block_mut, take, widen};
use super::product::{Product, TILE, Weights};
use super::windows::Windows;
use crate::fault::{self, Fault};
use crate::kernels::Conv2dArgs;
use crate::tensor::{CodesMut, Shape, index};

/// `acc = b' + Σ w·q` over each window, then the epilogue.
///
/// `input`: i8 map `H×W×C`; `output`: i8 or i16 map `OH×OW×O`, which may hold the residual; weights
/// `[O][kh][kw][C/groups]` in [−127, 127], packed; padding is the padding code of its input channel. Products are exact
/// in i32 under the compiler's bound. `scratch`: [`crate::kernels::plan::conv2d_scratch_bytes`], aligned to 2 bytes.
pub fn conv2d(args: &Conv2dArgs<'_>, input: &[i8], output: CodesMut<'_>, scratch: &mut [u8]) {
    match output {
        CodesMut::I8(output) => run(args, input, output, scratch),
        CodesMut::I16(output) => run(args, input, output, scratch),
    }
}

fn run<T: Code>(args: &Conv2dArgs<'_>, input: &[i8], output: &mut [T], mut scratch: &mut [u8]) {
    let Some(windows) = Windows::new(args, input) else { return };
    let (Some(outputs_per_group), Some(width)) = (
        args.output_shape.channels.checked_div(args.groups),
        core::num::NonZeroUsize::new(usize::from(args.output_shape.width)),
    ) else {
        return;
    };
    let outputs = usize::from(args.output_shape.channels);
    let depth = windows.depth();
    let positions = index(args.output_shape.positions());
    let weights = Weights::new(args.kernel, args.weights, outputs_per_group, depth);
    let Some(tile) = take::<i16>(&mut scratch, TILE.min(positions).saturating_mul(depth)) else { return };
    let Some(buffer) = weights.buffer(&mut scratch, depth) else { return };
    if depth == 0 || args.output_shape.elements() != output.len() as u64 {
        return;
    }
    let (end, step) = traversal(args.output_shape);
    for group in 0..usize::from(args.groups) {
        let first_channel = group * usize::from(outputs_per_group);
        let product = Product {
            weights,
            depth,
            channels: first_channel..first_channel + usize::from(outputs_per_group),
            outputs,
            rescale: &args.rescale,
            wide: false,
        };
        for first in (0..end).step_by(step) {
            if step == 1 && first % width == width.get() - 1 {
                continue;
            }
            let count = step.min(end - first);
            for i in 0..count {
                if let Some(row) = block_mut(tile, i, depth) {
                    windows.gather(group, (first + i) / width, (first + i) % width, row, widen);
                }
            }
            product.tile(tile.get(..count * depth).unwrap_or_default(), first, output, buffer);
        }
    }
}

/// End of the output positions and how many are taken at a time: all, by tiles. (The faults leave out the last row, or
/// go by single positions to leave out the last column.)
fn traversal(output: Shape) -> (usize, usize) {
    let last_row = if fault::active(Fault::LastRow) { usize::from(output.width) } else { 0 };
    (index(output.positions()) - last_row, if fault::active(Fault::LastColumn) { 1 } else { TILE })
}

#[cfg(test)]
mod tests {
    extern crate std;
    use super::super::oracle::{Buffer, HOSTILE, RescaleConstants, Rng, Scratch, for_seeds, pack, rescale};
    use super::*;
    use crate::kernels::plan::conv2d_scratch_bytes;
    use crate::program::{KernelId, Window};
    use std::vec::Vec;

    fn expected(args: &Conv2dArgs<'_>, input: &[i8], residual: &Buffer) -> Vec<i128> {
        let (i, o, w) = (args.input_shape, args.output_shape, args.window);
        let [groups, depth_c, depth_o] = [args.groups, i.channels / args.groups, o.channels / args.groups];
        assert_eq!((i.channels % groups, o.channels % groups), (0, 0));
        let mut codes = Vec::new();
        for (y, x, channel) in grid(o.height, o.width, o.channels) {
            let mut acc = i128::from(args.rescale.bias[channel as usize]);
            for (ky, kx, c) in grid(u16::from(w.kernel_h), u16::from(w.kernel_w), depth_c) {
                let iy = y * i64::from(w.stride_h) + ky * i64::from(w.dilation_h) - i64::from(w.pad_top);
                let ix = x * i64::from(w.stride_w) + kx * i64::from(w.dilation_w) - i64::from(w.pad_left);
                let c_in = channel / i64::from(depth_o) * i64::from(depth_c) + c;
                let inside = (0..i64::from(i.height)).contains(&iy) && (0..i64::from(i.width)).contains(&ix);
                let at = (iy * i64::from(i.width) + ix) * i64::from(i.channels) + c_in;
                let q = if inside { input[at as usize] } else { args.padding_codes[c_in as usize] };
                let tap = (channel * i64::from(w.kernel_h) + ky) * i64::from(w.kernel_w) + kx;
                acc += i128::from(args.weights[(tap * i64::from(depth_c) + c) as usize]) * i128::from(q);
            }
            codes.push(rescale(&args.rescale, channel as usize, acc, residual.get(codes.len())));
        }
        codes
    }

    fn grid(a: u16, b: u16, c: u16) -> impl Iterator<Item = (i64, i64, i64)> {
        let [a, b, c] = [a, b, c].map(i64::from);
        (0..a).flat_map(move |i| (0..b).flat_map(move |j| (0..c).map(move |k| (i, j, k))))
    }

    fn random_window(rng: &mut Rng) -> Window {
        let mut byte = |low, high| rng.range(low, high) as u8;
        Window {
            kernel_h: byte(1, 4),
            kernel_w: byte(1, 4),
            stride_h: byte(1, 3),
            stride_w: byte(1, 3),
            pad_top: byte(0, 3),
            pad_bottom: byte(0, 3),
            pad_left: byte(0, 3),
            pad_right: byte(0, 3),
            dilation_h: byte(1, 2),
            dilation_w: byte(1, 2),
        }
    }

    fn check(rng: &mut Rng, window: Window, input_shape: Shape, groups: u16, outputs: u16) {
        let Some((height, width)) = window.output_size(input_shape.height, input_shape.width) else { return };
        let output_shape = Shape::map(height, width, outputs);
        let depth =
            usize::from(window.kernel_h) * usize::from(window.kernel_w) * usize::from(input_shape.channels / groups);
        let bits = 14 + i64::from(usize::BITS - depth.leading_zeros()) / 2;
        let constants = RescaleConstants::random(rng, usize::from(outputs), output_shape.elements() as usize, bits);
        let (weights, padding) = (
            rng.values(depth * usize::from(outputs), -127, 127),
            rng.values(usize::from(input_shape.channels), -128, 127),
        );
        let input: Vec<i8> = rng.values(input_shape.elements() as usize, -128, 127);
        let args = Conv2dArgs {
            input_shape,
            output_shape,
            window,
            groups,
            kernel: KernelId::Direct,
            weights: &weights,
            padding_codes: &padding,
            rescale: constants.args(),
        };
        let expected = expected(&args, &input, &constants.residual_buffer);
        for kernel in KernelId::ALL {
            let packed = pack(*kernel, &weights, groups, outputs / groups, depth);
            let args = Conv2dArgs { kernel: *kernel, weights: &packed, ..args };
            let mut output = constants.initial_output(rng);
            let mut scratch = Scratch::new(conv2d_scratch_bytes(*kernel, input_shape, output_shape, window, groups));
            conv2d(&args, &input, output.codes_mut(), scratch.bytes());
            output.assert_equals(&expected, &std::format!("{kernel:?} {input_shape:?} {window:?} groups {groups}"));
        }
    }

    #[test]
    fn equals_the_naive_sum_on_random_shapes() {
        for_seeds(600, |rng| {
            let groups = rng.range(1, 3) as u16;
            let channels = groups * rng.range(1, 9) as u16;
            let outputs = groups * rng.range(1, 5) as u16;
            let shape = Shape::map(rng.range(1, 9) as u16, rng.range(1, 9) as u16, channels);
            let window = random_window(rng);
            check(rng, window, shape, groups, outputs);
        });
    }

    #[test]
    fn equals_the_naive_sum_for_every_depth_around_the_block() {
        let one = Window { kernel_h: 1, kernel_w: 1, stride_h: 1, stride_w: 1, ..NO_PADDING };
        for depth in 1..=70 {
            check(&mut Rng(depth), one, Shape::map(1, 5, depth as u16), 1, 3);
        }
    }

    #[test]
    fn depthwise_and_kernels_larger_than_the_map() {
        for seed in 0..40 {
            let rng = &mut Rng(seed);
            let around =
                Window { kernel_h: 7, kernel_w: 5, pad_top: 3, pad_bottom: 3, pad_left: 2, pad_right: 2, ..NO_PADDING };
            check(rng, around, Shape::map(1, 1, 4), 1, 2);
            check(rng, around, Shape::map(2, 3, 6), 6, 6);
            check(rng, around, Shape::map(2, 3, 6), 6, 12);
        }
    }

    const NO_PADDING: Window = Window::square(1, 1, 0);

    #[test]
    fn scratch_of_transfusers_largest_layers_is_small() {
        let seven =
            Window { kernel_h: 7, kernel_w: 7, stride_h: 2, stride_w: 2, pad_top: 3, pad_left: 3, ..NO_PADDING };
        let first = conv2d_scratch_bytes(KernelId::Direct, Shape::map(256, 256, 3), Shape::map(128, 128, 64), seven, 1);
        assert_eq!(first, 4 * 147 * 2);
        let three = Window { kernel_h: 3, kernel_w: 3, pad_top: 1, pad_left: 1, ..NO_PADDING };
        let last = conv2d_scratch_bytes(KernelId::Direct, Shape::map(8, 8, 512), Shape::map(8, 8, 512), three, 1);
        assert_eq!(last, 4 * 4608 * 2);
    }

    #[test]
    fn hostile_constants_and_lengths_do_not_panic() {
        let shape = Shape::map(3, 3, 2);
        let args = Conv2dArgs {
            input_shape: shape,
            output_shape: shape,
            window: NO_PADDING,
            groups: 1,
            kernel: KernelId::Direct,
            weights: &[-128; 4],
            padding_codes: &[],
            rescale: HOSTILE,
        };
        let (input, mut output, mut scratch) = ([-128; 18], [i16::MIN; 18], Scratch::new(16));
        conv2d(&args, &input, CodesMut::I16(&mut output), scratch.bytes());
        assert_eq!(output, [i16::MIN; 18], "the upper bound wins");
        for args in [
            Conv2dArgs { groups: 0, ..args },
            Conv2dArgs { groups: 5, ..args },
            Conv2dArgs { weights: &[], ..args },
            Conv2dArgs { input_shape: Shape::map(0, 3, 2), ..args },
            Conv2dArgs { output_shape: Shape::map(3, 0, 2), ..args },
            Conv2dArgs { output_shape: Shape::map(u16::MAX, u16::MAX, u16::MAX), ..args },
            Conv2dArgs { window: Window { kernel_h: 0, ..NO_PADDING }, ..args },
            Conv2dArgs { window: Window { kernel_h: 255, dilation_h: 255, pad_top: 255, ..NO_PADDING }, ..args },
            Conv2dArgs { window: Window { stride_h: 0, stride_w: 255, pad_left: 255, ..NO_PADDING }, ..args },
        ] {
            conv2d(&args, &input, CodesMut::I16(&mut output), scratch.bytes());
            conv2d(&args, &input, CodesMut::I8(&mut [0; 18]), &mut []);
            conv2d(&args, &[], CodesMut::I8(&mut []), scratch.bytes());
        }
    }
}
