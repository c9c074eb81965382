//! Operators that move values without changing them: slice, pad, concat.

use crate::ir::{Axis, Pad, Shape, Slice};

/// `out[i] = in[begin + i·stride]` per axis.
pub(super) fn slice(s: &Slice, shape: Shape, map: &[f32]) -> Vec<f32> {
    let axis = |axis: usize| (s.begin[axis]..s.end[axis]).step_by(usize::from(s.stride[axis])).map(usize::from);
    let (width, channels) = (usize::from(shape.width), usize::from(shape.channels));
    let mut out = Vec::new();
    for y in axis(0) {
        for x in axis(1) {
            let pixel = &map[(y * width + x) * channels..][..channels];
            out.extend(axis(2).map(|c| pixel[c]));
        }
    }
    out
}

/// The map inside a border of one value.
pub(super) fn pad(pad: &Pad, shape: Shape, map: &[f32], output: Shape) -> Vec<f32> {
    let mut out = vec![pad.value; output.elements() as usize];
    let [top, left, first] = pad.before.map(usize::from);
    let (width, channels) = (usize::from(output.width), usize::from(output.channels));
    for (i, pixel) in map.chunks_exact(usize::from(shape.channels)).enumerate() {
        let (y, x) = (i / usize::from(shape.width), i % usize::from(shape.width));
        let start = ((y + top) * width + x + left) * channels + first;
        out[start..][..pixel.len()].copy_from_slice(pixel);
    }
    out
}

/// The maps one after the other along an axis.
pub(super) fn concat(axis: Axis, shapes: &[Shape], maps: &[&[f32]]) -> Vec<f32> {
    // One run per map in turn.
    let runs = maps.iter().zip(shapes).map(|(map, shape)| map.chunks_exact(axis.run(*shape) as usize));
    let mut runs: Vec<_> = runs.collect();
    let mut out = Vec::with_capacity(maps.iter().map(|map| map.len()).sum());
    for _ in 0..runs[0].len() {
        runs.iter_mut().for_each(|run| out.extend_from_slice(run.next().unwrap_or_default()));
    }
    out
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::ir::Op;

    fn numbers(shape: Shape) -> Vec<f32> {
        (0..shape.elements()).map(|i| i as f32).collect()
    }

    #[test]
    fn slice_takes_every_other_pixel_and_the_last_channels() {
        let shape = Shape::map(3, 4, 3);
        let s = Slice { begin: [0, 1, 1], end: [3, 4, 3], stride: [2, 2, 1] };
        assert_eq!(Op::Slice(s).output_shape(&[shape]), Ok(Shape::map(2, 2, 2)));
        assert_eq!(slice(&s, shape, &numbers(shape)), [4.0, 5.0, 10.0, 11.0, 28.0, 29.0, 34.0, 35.0]);
    }

    #[test]
    fn slice_of_a_pad_is_the_map() {
        let shape = Shape::map(2, 3, 2);
        let border = Pad { before: [1, 2, 3], after: [2, 0, 1], value: -1.0 };
        let padded = Op::Pad(border).output_shape(&[shape]).unwrap();
        assert_eq!(padded, Shape::map(5, 5, 6));
        let out = pad(&border, shape, &numbers(shape), padded);
        assert_eq!(out.iter().filter(|x| **x == -1.0).count(), 150 - 12);
        let inner = Slice { begin: [1, 2, 3], end: [3, 5, 5], stride: [1; 3] };
        assert_eq!(slice(&inner, padded, &out), numbers(shape));
    }

    #[test]
    fn concat_follows_the_axis() {
        let (a, b) = (Shape::map(1, 2, 2), Shape::map(1, 2, 1));
        let maps: [&[f32]; 2] = [&[1.0, 2.0, 3.0, 4.0], &[5.0, 6.0]];
        assert_eq!(Op::Concat(Axis::Channels).output_shape(&[a, b]), Ok(Shape::map(1, 2, 3)));
        assert_eq!(concat(Axis::Channels, &[a, b], &maps), [1.0, 2.0, 5.0, 3.0, 4.0, 6.0]);
        let flat = Shape::map(1, 1, 2);
        assert_eq!(Op::Concat(Axis::Width).output_shape(&[a, flat]), Ok(Shape::map(1, 3, 2)));
        assert_eq!(concat(Axis::Width, &[a, flat], &maps), [1.0, 2.0, 3.0, 4.0, 5.0, 6.0]);
        assert_eq!(Op::Concat(Axis::Height).output_shape(&[a, a]), Ok(Shape::map(2, 2, 2)));
        assert_eq!(concat(Axis::Height, &[a, a], &[maps[0], maps[0]])[4..], *maps[0]);
        assert!(Op::Concat(Axis::Height).output_shape(&[a, b]).unwrap_err().contains("channels"));
    }
}
