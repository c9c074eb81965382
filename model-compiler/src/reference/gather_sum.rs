//! Sums of cells that a second operand names.

use crate::ir::Shape;

/// `[map, indices]`: `out[i,j] = Σ_k map[row, column]` over the pairs of each position, summed in f64. Indices are
/// rounded and clamped to the map.
pub(super) fn gather_sum(shape: Shape, inputs: &[&[f32]], output: Shape) -> Vec<f32> {
    let (map, indices) = (inputs[0], inputs[1]);
    let (width, channels) = (usize::from(shape.width), usize::from(shape.channels));
    let pairs = indices.len() / output.positions() as usize;
    let inside = |index: f32, size: u16| index.round().clamp(0.0, f32::from(size - 1)) as usize;
    let mut out = Vec::with_capacity(output.elements() as usize);
    for of_position in indices.chunks_exact(pairs) {
        let mut sums = vec![0.0; channels];
        for pair in of_position.chunks_exact(2) {
            let cell = inside(pair[0], shape.height) * width + inside(pair[1], shape.width);
            sums.iter_mut().zip(&map[cell * channels..]).for_each(|(sum, &x)| *sum += f64::from(x));
        }
        out.extend(sums.iter().map(|&sum| sum as f32));
    }
    out
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::ir::Op;

    #[test]
    fn cells_are_rows_and_columns_repeat_and_are_clamped() {
        let (shape, indices) = (Shape::map(2, 3, 2), Shape::map(1, 2, 4));
        let map: Vec<f32> = (0..12).map(|i| i as f32).collect();
        let output = Op::GatherSum.output_shape(&[shape, indices]).unwrap();
        assert_eq!(output, Shape::map(1, 2, 2));
        // Cells (0,1) and (1,2); cell (1,0) twice, once from outside.
        let found = gather_sum(shape, &[&map, &[0.0, 1.0, 1.0, 2.0, 1.0, 0.0, 7.0, -3.0]], output);
        assert_eq!(found, [2.0 + 10.0, 3.0 + 11.0, 6.0 + 6.0, 7.0 + 7.0]);
        assert!(Op::GatherSum.output_shape(&[shape, Shape::map(1, 2, 3)]).unwrap_err().contains("no pairs"));
    }
}
