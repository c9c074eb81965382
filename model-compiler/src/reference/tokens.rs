//! Two maps and the velocity to one token matrix.

use super::pool::add_mean;
use crate::ir::{Shape, Tokens};

/// `[map, map, velocity]`, see [`Tokens`].
pub(super) fn tokens(tokens: &Tokens, shapes: &[Shape], inputs: &[&[f32]]) -> Vec<f32> {
    let channels = tokens.velocity_weights.len();
    let velocity = inputs[2][0];
    let (grid_h, grid_w) = (usize::from(tokens.grid.0), usize::from(tokens.grid.1));
    let mut out = match &tokens.position {
        Some(position) => position.data.clone(),
        None => vec![0.0; 2 * grid_h * grid_w * channels],
    };
    for (t, row) in out.chunks_exact_mut(channels).enumerate() {
        let (map, cell) = (t / (grid_h * grid_w), t % (grid_h * grid_w));
        add_mean(row, cell_rows(shapes[map], inputs[map], (grid_h, grid_w), cell).into_iter());
        for ((x, w), b) in row.iter_mut().zip(tokens.velocity_weights.iter()).zip(tokens.velocity_bias.iter()) {
            *x += velocity * w + b;
        }
    }
    out
}

/// The positions of one token's cell, channels each.
fn cell_rows(shape: Shape, map: &[f32], (grid_h, grid_w): (usize, usize), cell: usize) -> Vec<&[f32]> {
    let (width, channels) = (usize::from(shape.width), usize::from(shape.channels));
    let (cell_h, cell_w) = (usize::from(shape.height) / grid_h, width / grid_w);
    let (top, left) = (cell / grid_w * cell_h, cell % grid_w * cell_w);
    let position = |i: usize| (top + i / cell_w) * width + left + i % cell_w;
    (0..cell_h * cell_w).map(|i| &map[position(i) * channels..][..channels]).collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::ir::Weights;
    use std::sync::Arc;

    /// Maps of 2×4 and 1×2 positions on a grid of 1×2.
    fn run(position: Option<Vec<f32>>) -> Vec<f32> {
        let op = Tokens {
            grid: (1, 2),
            position: position.map(|data| Arc::new(Weights { shape: vec![4, 1], data })),
            velocity_weights: Arc::new(vec![10.0]),
            velocity_bias: Arc::new(vec![0.5]),
        };
        let image = [1.0, 3.0, 100.0, 100.0, 5.0, 7.0, 200.0, 240.0];
        let shapes = [Shape::map(2, 4, 1), Shape::map(1, 2, 1), Shape::vector(1)];
        tokens(&op, &shapes, &[&image, &[-1.0, -2.0], &[3.0]])
    }

    #[test]
    fn pools_cells_row_by_row_and_adds_the_velocity() {
        assert_eq!(run(None), [34.5, 190.5, 29.5, 28.5]);
    }

    #[test]
    fn positions_are_added_per_token() {
        assert_eq!(run(Some(vec![1.0, 2.0, 3.0, 4.0])), [35.5, 192.5, 32.5, 32.5]);
    }
}
