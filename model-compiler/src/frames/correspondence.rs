//! Which cells of the camera image and of the LiDAR map see the same points: what Geometric Fusion gathers features by.
//!
//! Both maps are the last stage's, one cell for 32×32 pixels (8×8 cells of 256×256 pixels). A point at `x` (left), `y`
//! (forward) with `|x| < 16` and `0 < y < 32` m lies
//! * in the LiDAR cell (row `bx`, column `by`) of an area of its own, 32 m ahead and 16 m to either side, near first
//! * at the pixel `u = 1.1·F·x/y + 200`, `v = 2.3·F/y + 150` of the 400×300 image, F = 400 / (2·tan 50°), whatever its
//!   height; if that is inside the centered crop, in the image cell (column `u`, row `v`)
//!
//! The networks were trained with exactly this: the area is not the histogram's, and `x` counts to the left in the
//! histogram but to the right in the image. `bev_points[bx][by]` lists image cells as `(u, v)` and
//! `camera_points[u][v]` LiDAR cells as `(bx, by)`; the network takes each pair, and the place in the list, for a row
//! and a column.
//!
//! A list has room for K cells (5). The original draws K of more at random without a seed; here the first K in the
//! order of the points are taken, which is one of its draws. A shorter list is filled up with the cell (0, 0), which
//! the network sums like any other.

use super::ByteMap;
use super::bev::Point;
use firmware::tensor::Shape;

/// Pixels per cell and axis.
const CELL: f64 = 32.0;
/// Width and height of the camera image, pixels.
const IMAGE: [f64; 2] = [400.0, 300.0];
/// Horizontal angle of view, degrees.
const FIELD_OF_VIEW: f64 = 100.0;
/// Stretch of the horizontal focal length.
const STRETCH: f64 = 1.1;
/// Height of the camera above ground, m.
const CAMERA_HEIGHT_M: f64 = 2.3;
/// Length of the area, and its width, m.
const AREA_M: f64 = 32.0;

/// Cells of the image for the LiDAR map and cells of the LiDAR map for the image, each `H×W×2K`.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Correspondence {
    /// `bev_points`.
    pub bev: ByteMap,
    /// `camera_points`.
    pub camera: ByteMap,
}

/// Whether there are lists of this shape: square maps of which the image is a part, pairs.
pub fn is_possible(shape: Shape) -> bool {
    let fits = (1..=IMAGE[1] as u16 / CELL as u16).contains(&shape.height);
    fits && shape.height == shape.width && shape.channels > 0 && shape.channels.is_multiple_of(2)
}

/// The lists of all points; those that are not finite lie outside.
///
/// # Panics
/// The shape is not one that [`is_possible`] accepts.
pub fn correspondence(points: impl IntoIterator<Item = Point>, shape: Shape) -> Correspondence {
    assert!(is_possible(shape), "no lists have the shape {shape:?}");
    let cells = f64::from(shape.height);
    let (mut bev, mut camera) = (Lists::new(shape), Lists::new(shape));
    for [x, y, _] in points {
        if let Some((lidar, image)) = area_cell(x, y, cells).zip(image_cell(x, y, cells)) {
            bev.add(lidar, image);
            camera.add(image, lidar);
        }
    }
    Correspondence { bev: bev.map, camera: camera.map }
}

/// `(bx, by)`.
fn area_cell(x: f64, y: f64, cells: f64) -> Option<[u8; 2]> {
    let inside = x.abs() < AREA_M / 2.0 && 0.0 < y && y < AREA_M;
    inside.then(|| [x + AREA_M / 2.0, y].map(|along| (along * cells / AREA_M).min(cells - 1.0) as u8))
}

/// `(u, v)` in the centered crop.
fn image_cell(x: f64, y: f64, cells: f64) -> Option<[u8; 2]> {
    let focal = IMAGE[0] / (2.0 * (FIELD_OF_VIEW / 2.0).to_radians().tan());
    let pixel = [STRETCH * focal * x / y + IMAGE[0] / 2.0, focal * CAMERA_HEIGHT_M / y + IMAGE[1] / 2.0];
    let cell = |axis: usize| {
        let from_crop = pixel[axis] - ((IMAGE[axis] - cells * CELL) / 2.0).floor();
        (0.0..cells * CELL).contains(&from_crop).then_some((from_crop / CELL) as u8)
    };
    Some([cell(0)?, cell(1)?])
}

/// A list of cells per cell.
struct Lists {
    map: ByteMap,
    lengths: Vec<usize>,
}

impl Lists {
    fn new(shape: Shape) -> Self {
        let map = ByteMap { shape, data: vec![0; shape.elements() as usize] };
        Self { map, lengths: vec![0; shape.positions() as usize] }
    }

    fn add(&mut self, of: [u8; 2], cell: [u8; 2]) {
        let Shape { width, channels, .. } = self.map.shape;
        let list = usize::from(of[0]) * usize::from(width) + usize::from(of[1]);
        let entries = &mut self.map.data[list * usize::from(channels)..][..usize::from(channels)];
        if let Some(entry) = entries.chunks_exact_mut(2).nth(self.lengths[list]) {
            entry.copy_from_slice(&cell);
            self.lengths[list] += 1;
        }
    }
}

/// The lists of the mirrored scene, `x` for `−x`: first indices count from the other side, in lists and in places.
///
/// Exact but for points on the very edge of a cell. A list is filled up with (0, 0), so this pair stays; of 8×8 cells
/// no point ever gives it: image points lie below the horizon (`v ≥ 4`), and the near corner of the area is out of
/// sight.
pub(super) fn mirrored(lists: &ByteMap) -> ByteMap {
    let last = (lists.shape.height - 1) as u8;
    let mut mirrored = super::flip_rows(lists);
    for pair in mirrored.data.chunks_exact_mut(2).filter(|pair| *pair != [0, 0]) {
        pair[0] = last.saturating_sub(pair[0]);
    }
    mirrored
}

#[cfg(test)]
mod tests {
    use super::*;

    const SHAPE: Shape = Shape::map(8, 8, 10);

    /// The cells of one list.
    fn list(map: &ByteMap, [i, j]: [usize; 2]) -> Vec<[u8; 2]> {
        map.data[(i * 8 + j) * 10..][..10].as_chunks::<2>().0.to_vec()
    }

    #[test]
    fn a_point_is_listed_on_both_sides_under_the_other_sides_cell() {
        // 1 m to the left and 10 m ahead: pixel (200 + 18.46, 150 + 38.6), less the corner (72, 22) of the crop.
        let Correspondence { bev, camera } = correspondence([[1.0, 10.0, 7.0]], SHAPE);
        let mut expected = vec![[0, 0]; 5];
        expected[0] = [4, 5];
        assert_eq!(list(&bev, [4, 2]), expected);
        expected[0] = [4, 2];
        assert_eq!(list(&camera, [4, 5]), expected);
        let listed = |map: &ByteMap| map.data.iter().filter(|&&v| v != 0).count();
        assert_eq!((listed(&bev), listed(&camera)), (2, 2));
    }

    #[test]
    fn the_first_five_in_the_order_of_the_points_are_kept() {
        // All in LiDAR cell (4, 5), in image columns 4, 4, 4, 4, 5, 5.
        let points = [0.5, 1.0, 1.5, 2.0, 3.5, 3.9].map(|x| [x, 21.0, 0.0]);
        let kept = |points: &[Point]| list(&correspondence(points.iter().copied(), SHAPE).bev, [4, 5]);
        assert_eq!(kept(&points), [[4, 4], [4, 4], [4, 4], [4, 4], [4, 4]]);
        let reversed: Vec<Point> = points.into_iter().rev().collect();
        assert_eq!(kept(&reversed), [[5, 4], [4, 4], [4, 4], [4, 4], [4, 4]]);
    }

    #[test]
    fn only_points_of_the_area_and_of_the_crop_count() {
        let focal = 200.0 / 50.0_f64.to_radians().tan();
        // Left edge of the crop at 20 m: u = 72.
        let edge = -128.0 * 20.0 / (1.1 * focal);
        for (x, y, inside) in [
            (edge + 1e-9, 20.0, true),
            (edge - 1e-9, 20.0, false),
            (-edge - 1e-9, 20.0, true),
            (-edge + 1e-9, 20.0, false),
            (0.0, 32.0_f64.next_down(), true),
            (0.0, 32.0, false),
            (0.0, 0.0, false),
            // Lower edge of the crop: v = 278.
            (0.0, focal * 2.3 / 128.0 + 1e-9, true),
            (0.0, focal * 2.3 / 128.0 - 1e-9, false),
            (16.0, 31.0, false),
            (f64::NAN, 10.0, false),
            (0.0, f64::INFINITY, false),
        ] {
            let found = correspondence([[x, y, 0.0]], SHAPE).bev.data.iter().any(|&v| v != 0);
            assert_eq!(found, inside, "{x}, {y}");
        }
    }

    #[test]
    fn mirrored_points_give_the_mirrored_lists() {
        // Irrational steps keep the points off the edges of the cells.
        let points: Vec<Point> = (1..2000)
            .map(|i| [(f64::from(i) * 0.618_034 % 1.0 - 0.5) * 32.0, f64::from(i) * 0.414_214 % 32.0, 0.0])
            .collect();
        let [lists, opposite] = [1.0, -1.0].map(|side| {
            let Correspondence { bev, camera } =
                correspondence(points.iter().map(|p| [side * p[0], p[1], p[2]]), SHAPE);
            [bev, camera]
        });
        assert!(lists.iter().all(|map| map.data.iter().filter(|&&v| v != 0).count() > 100));
        assert_eq!(lists.each_ref().map(mirrored), opposite);
        assert_eq!(opposite.each_ref().map(mirrored), lists, "twice is the same again");
    }

    #[test]
    fn smaller_networks_see_a_smaller_crop_of_the_same_area() {
        let shape = Shape::map(2, 2, 4);
        let Correspondence { bev, camera } = correspondence([[-0.5, 15.0, 0.0], [0.5, 20.0, 0.0]], shape);
        assert_eq!(bev.data[..4], [0, 1, 0, 0]);
        assert_eq!(bev.data[12..], [1, 1, 0, 0]);
        assert_eq!(camera.data, [0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 1, 1, 0, 0]);
        for (height, width, channels) in [(8, 4, 10), (10, 10, 10), (8, 8, 9), (0, 0, 10), (8, 8, 0)] {
            assert!(!is_possible(Shape::map(height, width, channels)), "{height}×{width}×{channels}");
        }
    }
}
