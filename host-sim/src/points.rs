//! Points in an image, as LBC gives them.

use firmware::image::Image;
use firmware::program::Step;
use firmware::tensor::{Shape, TensorId};
use model_compiler::ir::{Graph, Op, ValueId};
use model_compiler::qmodel::{QModel, QOp, QTensorId};

/// `[x, y]` per point: from −1 at the center of the first column or row to 1 at that of the last.
pub type Points = Vec<[f64; 2]>;

/// The maps whose pixels an output names.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct PixelGrid {
    height: u16,
    width: u16,
}

impl PixelGrid {
    pub(crate) fn of_shape(shape: Shape) -> Self {
        Self { height: shape.height, width: shape.width }
    }

    /// The maps behind a tensor of an image; `None` where it holds no points.
    pub fn of_image(image: &Image<'_>, points: TensorId) -> Option<Self> {
        let logits = (0..image.step_count()).find_map(|position| match image.step(position)? {
            Step::SpatialSoftmax(step) if step.output == points => Some(step.input),
            _ => None,
        });
        Some(Self::of_shape(image.tensor(logits?)?.shape))
    }

    /// The maps behind a tensor of a quantized model; `None` where it holds no points.
    pub fn of_model(model: &QModel, points: QTensorId) -> Option<Self> {
        let logits = model.steps.iter().find_map(|step| match step.op {
            QOp::SpatialSoftmax { input, output, .. } if output == points => Some(input),
            _ => None,
        });
        Some(Self::of_shape(model.tensor(logits?).shape))
    }

    /// The maps behind the first output of a graph; `None` where it holds no points.
    pub fn of_graph(graph: &Graph) -> Option<Self> {
        logits(graph).map(|logits| Self::of_shape(graph.value(logits).shape))
    }

    /// Columns and rows.
    pub fn size(self) -> [u16; 2] {
        [self.width, self.height]
    }

    /// Points of `[column, row]` pairs in pixels.
    pub fn points<T: Copy + Into<f64>>(self, pixels: &[T]) -> Points {
        let position = |pixel: T, size: u16| 2.0 * pixel.into() / f64::from(size.max(2) - 1) - 1.0;
        let pairs = pixels.as_chunks::<2>().0.iter();
        pairs.map(|&[column, row]| [position(column, self.width), position(row, self.height)]).collect()
    }

    /// Distances of points, pixels.
    pub fn distances(self, found: &Points, expected: &Points) -> Vec<f64> {
        let pixels = |difference: f64, size: u16| 0.5 * difference * f64::from(size.max(2) - 1);
        let distance =
            |(f, e): (&[f64; 2], &[f64; 2])| pixels(f[0] - e[0], self.width).hypot(pixels(f[1] - e[1], self.height));
        found.iter().zip(expected).map(distance).collect()
    }
}

/// What the points that are a graph's first output are made of.
pub fn logits(graph: &Graph) -> Option<ValueId> {
    let producer = graph.producer(*graph.outputs.first()?)?;
    matches!(producer.op, Op::SpatialSoftmax { .. }).then(|| producer.inputs[0])
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn pixels_become_points_from_minus_one_to_one() {
        let grid = PixelGrid { height: 144, width: 256 };
        assert_eq!(grid.points(&[0.0_f32, 0.0, 255.0, 143.0, 127.5, 71.5]), [[-1.0, -1.0], [1.0, 1.0], [0.0, 0.0]]);
        assert_eq!(PixelGrid { height: 1, width: 1 }.points(&[0.0_f32, 0.0]), [[-1.0, -1.0]]);
    }

    #[test]
    fn distances_are_in_pixels() {
        let grid = PixelGrid { height: 11, width: 101 };
        let distances = grid.distances(&grid.points(&[50.0_f32, 5.0]), &grid.points(&[53.0_f32, 1.0]));
        assert!((distances[0] - 5.0).abs() < 1e-12, "{distances:?}");
    }

    #[test]
    fn networks_without_points_have_no_grid() {
        assert_eq!(PixelGrid::of_graph(&crate::testing::graph()), None);
        let sample = crate::testing::sample();
        let image = Image::parse(&sample.image).unwrap();
        assert_eq!(PixelGrid::of_image(&image, image.output(0).unwrap().tensor), None);
        assert_eq!(PixelGrid::of_model(&sample.record.model, QTensorId(2)), None);
    }
}
