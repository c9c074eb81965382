//! Portable copy of a strided box into a bordered map.

use super::codes::{Code, block, block_mut};
use crate::fault::{self, Fault};
use crate::kernels::CopyBoxArgs;
use crate::tensor::{Codes, CodesMut, Shape};

/// `y[before + i] = q[begin + i·stride]` for i in `0..size`, elsewhere `y = border`; per axis height, width, channels.
///
/// `input`: i8 or i16 map; `output`: map of the same type. Preconditions: stride ≥ 1, the box lies in both maps.
pub fn copy_box(args: &CopyBoxArgs, input: Codes<'_>, output: CodesMut<'_>) {
    match (input, output) {
        (Codes::I8(input), CodesMut::I8(output)) => copy_into(args, input, output),
        (Codes::I16(input), CodesMut::I16(output)) => copy_into(args, input, output),
        (Codes::I8(_), CodesMut::I16(_)) | (Codes::I16(_), CodesMut::I8(_)) => {}
    }
}

fn copy_into<T: Code>(args: &CopyBoxArgs, input: &[T], output: &mut [T]) {
    let (from, to) = (args.input_shape, args.output_shape);
    if from.elements() != input.len() as u64 || to.elements() != output.len() as u64 {
        return;
    }
    let border = if fault::active(Fault::BorderZero) { T::ZERO } else { T::from_code(args.border) };
    output.fill(border);
    let begin = begin(args).map(usize::from);
    let [before, size, stride] = [args.before, args.size, args.stride].map(|axes| axes.map(usize::from));
    let pixel = |y: usize, x: usize, shape: Shape| y * usize::from(shape.width) + x;
    for (y, x) in (0..size[0]).flat_map(|y| (0..size[1]).map(move |x| (y, x))) {
        let source = pixel(begin[0] + y * stride[0], begin[1] + x * stride[1], from);
        let target = pixel(before[0] + y, before[1] + x, to);
        let taken = block(input, source, from.channels.into()).and_then(|pixel| pixel.get(begin[2]..));
        let place = block_mut(output, target, to.channels.into()).and_then(|pixel| pixel.get_mut(before[2]..));
        let (Some(taken), Some(place)) = (taken, place) else { continue };
        for (code, q) in place.iter_mut().take(size[2]).zip(taken.iter().step_by(stride[2].max(1))) {
            *code = *q;
        }
    }
}

/// Where the box begins; the fault moves it by one along the last axis that leaves room.
fn begin(args: &CopyBoxArgs) -> [u16; 3] {
    let mut begin = args.begin;
    if fault::active(Fault::BoxOffset) {
        let Shape { height, width, channels } = args.input_shape;
        let sizes = [height, width, channels].into_iter().zip(args.stride).zip(args.size);
        let moved = begin.iter_mut().zip(sizes).rev().find(|(begin, ((axis, stride), size))| {
            u32::from(**begin) + u32::from(size.saturating_sub(1)) * u32::from(*stride) + 1 < u32::from(*axis)
        });
        if let Some((begin, _)) = moved {
            *begin += 1;
        }
    }
    begin
}

#[cfg(test)]
mod tests {
    extern crate std;
    use super::super::oracle::for_seeds;
    use super::*;
    use std::vec::Vec;

    #[test]
    fn equals_the_formula() {
        for_seeds(400, |rng| {
            let mut axis = || {
                let [stride, size, begin, before] =
                    [(1, 3), (1, 4), (0, 3), (0, 3)].map(|(l, h)| rng.range(l, h) as u16);
                let from = begin + (size - 1) * stride + 1 + rng.range(0, 3) as u16;
                [from, before + size + rng.range(0, 3) as u16, begin, stride, size, before]
            };
            let axes = [axis(), axis(), axis()];
            let field = |index: usize| axes.map(|axis| axis[index]);
            let map = |[height, width, channels]: [u16; 3]| Shape { height, width, channels };
            let element = rng.element_type();
            let codes = element.codes();
            let args = CopyBoxArgs {
                input_shape: map(field(0)),
                output_shape: map(field(1)),
                begin: field(2),
                stride: field(3),
                size: field(4),
                before: field(5),
                border: rng.range((*codes.start()).into(), (*codes.end()).into()) as i16,
            };
            let input = rng.buffer(element, args.input_shape.elements() as usize);
            let expected: Vec<i128> = (0..args.output_shape.elements() as usize)
                .map(|at| {
                    let [_, width, channels] = field(1).map(usize::from);
                    let place = [at / channels / width, at / channels % width, at % channels];
                    let source = [0, 1, 2].map(|k| {
                        let [begin, stride, size, before] = [2, 3, 4, 5].map(|index| usize::from(axes[k][index]));
                        place[k].checked_sub(before).filter(|i| *i < size).map(|i| begin + i * stride)
                    });
                    let [_, width, channels] = field(0).map(usize::from);
                    match source {
                        [Some(y), Some(x), Some(c)] => input.get((y * width + x) * channels + c),
                        _ => args.border.into(),
                    }
                })
                .collect();
            let mut output = rng.buffer(element, expected.len());
            copy_box(&args, input.codes(), output.codes_mut());
            output.assert_equals(&expected, "copy_box");
        });
    }

    #[test]
    fn hostile_boxes_and_lengths_do_not_panic() {
        let args = CopyBoxArgs {
            input_shape: Shape::map(2, 2, 2),
            output_shape: Shape::map(2, 2, 2),
            begin: [0; 3],
            stride: [1; 3],
            size: [2; 3],
            before: [0; 3],
            border: i16::MIN,
        };
        for args in [
            args,
            CopyBoxArgs { begin: [u16::MAX; 3], stride: [u16::MAX; 3], ..args },
            CopyBoxArgs { before: [u16::MAX; 3], ..args },
            CopyBoxArgs { size: [u16::MAX, 9, u16::MAX], stride: [0; 3], ..args },
            CopyBoxArgs { input_shape: Shape::map(u16::MAX, u16::MAX, u16::MAX), ..args },
            CopyBoxArgs { output_shape: Shape::map(8, 1, 0), ..args },
        ] {
            copy_box(&args, Codes::I8(&[1; 8]), CodesMut::I8(&mut [0; 8]));
            copy_box(&args, Codes::I16(&[1; 8]), CodesMut::I16(&mut [0; 7]));
            copy_box(&args, Codes::I16(&[1; 8]), CodesMut::I8(&mut [0; 8]));
        }
    }
}
