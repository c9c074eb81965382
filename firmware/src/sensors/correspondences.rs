//! Which cells of the camera image and of the bird's-eye view see the same points: the inputs `bev_points` and
//! `cam_points` of Geometric Fusion.
//!
//! Both views have 8×8 cells. A point that both see joins its two cells: the camera's cell is listed under the cell on
//! the ground, and the other way round, up to five each, in the order of points. (The published preparation draws five
//! at random; the first five are one such draw.) Entries without a point are cell (0, 0), which the network was trained
//! to gather too.
//!
//! The trained network depends on how its authors looked at a point, so this is kept as it was: the height of a point
//! is ignored, left is taken for right in the image, and cells on the ground are ±16 m × 32 m, counted from the sensor.

use super::lidar::Point;
use super::{InputSize, NotFinite};
use fixed::types::I16F16;

/// Cells of a side of either view.
pub const CELLS: usize = 8;
/// Entries of a cell.
pub const ENTRIES: usize = 5;
/// Elements of each input: `[8][8][5][2]`.
pub const ELEMENTS: usize = CELLS * CELLS * ENTRIES * 2;

/// Ground cells are 4 m × 4 m: binary logarithm in Q16.
const GROUND_CELL_BITS: u32 = 18;
/// Ground cells reach 16 m to both sides.
const HALF_WIDTH: i32 = 16 << 16;
const LENGTH: i32 = 32 << 16;

/// A pinhole camera and the crop of its image, in pixels.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Intrinsics {
    /// Focal length along a row.
    pub focal_x: I16F16,
    /// Focal length along a column.
    pub focal_y: I16F16,
    /// Column and row of the optical axis, relative to the crop.
    pub center: [I16F16; 2],
    /// Binary logarithm of the side of a cell: the crop is a square of eight cells.
    pub cell_bits: u8,
    /// Of the camera above the ground, m; every point is taken to lie on the ground.
    pub height: I16F16,
}

impl Intrinsics {
    /// The published camera: 400×300 pixels, 100° field of view, `f = 200/tan 50°`, `focal_x = 1.1·f`, its crop of
    /// 256×256 pixels from column 72 and row 22 on, 2.3 m above ground.
    pub const PUBLISHED: Self = Self {
        focal_x: I16F16::from_bits(12_098_071),
        focal_y: I16F16::from_bits(10_998_247),
        center: [I16F16::from_bits(128 << 16), I16F16::from_bits(128 << 16)],
        cell_bits: 5,
        height: I16F16::from_bits(150_733),
    };

    /// Cell `(column, row)` of the image that shows a point; `None` outside of the crop.
    ///
    /// `u = focal_x·left/forward + center`, `v = focal_y·height/forward + center`. Instead of dividing, the numerator
    /// is compared with multiples of the denominator: exact in 64 bits for every point on the ground cells. With
    /// coordinates within 2^-16 m and factors within 2^-17 of the real ones, u and v of a point in the published crop
    /// (more than 3 m ahead) are met within 1/500 pixel.
    fn cell(&self, left: i32, forward: i32) -> Option<[u8; 2]> {
        let [center_x, center_y] = self.center.map(|center| product(center.to_bits(), forward));
        let across = product(self.focal_x.to_bits(), left).wrapping_add(center_x);
        let down = product(self.focal_y.to_bits(), self.height.to_bits()).wrapping_add(center_y);
        // Forward in pixels of a cell: Q32 like the numerators.
        let cell = i64::from(forward).wrapping_shl(u32::from(self.cell_bits.min(12)).wrapping_add(16));
        Some([eighth(across, cell)?, eighth(down, cell)?])
    }
}

/// Q16 times Q16, Q32.
fn product(a: i32, b: i32) -> i64 {
    i64::from(a).wrapping_mul(b.into())
}

/// `floor(numerator/denominator)` if it is one of 0..8, for a denominator of 1..2^59.
fn eighth(numerator: i64, denominator: i64) -> Option<u8> {
    if numerator < 0 || numerator >= denominator.wrapping_mul(8) {
        return None;
    }
    let step = |quotient: u8, bit: u8| {
        let tried = quotient | bit;
        if numerator >= denominator.wrapping_mul(tried.into()) { tried } else { quotient }
    };
    Some(step(step(step(0, 4), 2), 1))
}

/// Cell of the ground that holds a point: `|left| < 16 m`, `0 < forward < 32 m`, counted from the right and from the
/// sensor. All edges are multiples of 4 m, so codes decide as the real numbers do (see [`Point`]).
fn ground_cell(left: i32, forward: i32) -> Option<[u8; 2]> {
    let is_inside = -HALF_WIDTH < left && left < HALF_WIDTH && 0 < forward && forward < LENGTH;
    let cell = |code: i32| u8::try_from(code >> GROUND_CELL_BITS).ok();
    if is_inside { Some([cell(left.wrapping_add(HALF_WIDTH))?, cell(forward)?]) } else { None }
}

/// What became of the points.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub struct Statistics {
    /// Points given.
    pub points: u32,
    /// Points with a coordinate that is not finite; left out.
    pub not_finite: u32,
    /// Points that not both views see; left out.
    pub out_of_view: u32,
    /// Points that found no free entry in either cell.
    pub surplus: u32,
}

/// Lists that grow point by point in the network's inputs.
#[derive(Clone, Copy, Debug)]
pub struct Correspondences {
    intrinsics: Intrinsics,
    bev: Lengths,
    camera: Lengths,
    statistics: Statistics,
}

impl Correspondences {
    /// Lists before their first point; [`Self::start`] comes first.
    pub const fn new(intrinsics: Intrinsics) -> Self {
        let statistics = Statistics { points: 0, not_finite: 0, out_of_view: 0, surplus: 0 };
        Self { intrinsics, bev: Lengths::NONE, camera: Lengths::NONE, statistics }
    }

    /// Begins anew, with all entries (0, 0); both inputs are `[8][8][5][2]`.
    ///
    /// # Errors
    /// An input has another size.
    pub fn start(&mut self, bev_points: &mut [i8], cam_points: &mut [i8]) -> Result<(), InputSize> {
        InputSize::check(bev_points.len(), ELEMENTS as u64)?;
        InputSize::check(cam_points.len(), ELEMENTS as u64)?;
        bev_points.fill(0);
        cam_points.fill(0);
        *self = Self::new(self.intrinsics);
        Ok(())
    }

    /// Takes a point, or that it is none, into the inputs that were given to [`Self::start`].
    pub fn push(&mut self, point: Result<Point, NotFinite>, bev_points: &mut [i8], cam_points: &mut [i8]) {
        let Statistics { points, not_finite, out_of_view, surplus } = &mut self.statistics;
        *points = points.saturating_add(1);
        let Ok(Point { left, forward, .. }) = point else {
            *not_finite = not_finite.saturating_add(1);
            return;
        };
        let (left, forward) = (left.to_bits(), forward.to_bits());
        let ground = ground_cell(left, forward);
        let Some((ground, image)) = ground.and_then(|cell| Some((cell, self.intrinsics.cell(left, forward)?))) else {
            *out_of_view = out_of_view.saturating_add(1);
            return;
        };
        // Both, whatever the first one says.
        if !(self.bev.push(bev_points, ground, image) | self.camera.push(cam_points, image, ground)) {
            *surplus = surplus.saturating_add(1);
        }
    }

    /// Ends the lists.
    pub fn finish(&mut self) -> Statistics {
        core::mem::take(&mut self.statistics)
    }
}

/// How many entries each cell of a view has.
#[derive(Clone, Copy, Debug)]
struct Lengths([u8; CELLS * CELLS]);

impl Lengths {
    const NONE: Self = Self([0; CELLS * CELLS]);

    /// Adds an entry to a cell, if it has one free.
    fn push(&mut self, input: &mut [i8], [i, j]: [u8; 2], entry: [u8; 2]) -> bool {
        let (entries, _) = input.as_chunks_mut::<2>().0.as_chunks_mut::<ENTRIES>();
        let cell = usize::from(i.wrapping_mul(8).wrapping_add(j));
        let Some((list, length)) = entries.get_mut(cell).zip(self.0.get_mut(cell)) else { return false };
        let Some(free) = list.get_mut(usize::from(*length)) else { return false };
        *free = entry.map(u8::cast_signed);
        *length = length.saturating_add(1);
        true
    }
}

#[cfg(test)]
mod tests {
    extern crate std;
    use super::super::lidar::Mounting;
    use super::*;
    use proptest::prelude::*;
    use std::vec::Vec;

    /// Bound of the error of u and v, pixels.
    const PRECISION: f64 = 1.0 / 500.0;

    fn focal() -> f64 {
        200.0 / 50.0_f64.to_radians().tan()
    }

    /// Ground and image coordinates in cells, in f64; `None` where `|left| < 16, 0 < forward < 32` fails.
    fn oracle(left: f64, forward: f64) -> Option<[f64; 4]> {
        let (u, v) = (1.1 * focal() * left / forward + 200.0, focal() * 2.3 / forward + 150.0);
        let is_inside = left.abs() < 16.0 && 0.0 < forward && forward < 32.0;
        is_inside.then_some([(left + 16.0) / 4.0, forward / 4.0, (u - 72.0) / 32.0, (v - 22.0) / 32.0])
    }

    fn cells(left: f32, forward: f32) -> Option<[u8; 4]> {
        let point = Mounting::TRAINED.place([left, forward, 0.0].map(f32::to_bits)).unwrap();
        let (left, forward) = (point.left.to_bits(), point.forward.to_bits());
        let ([a, b], [c, d]) = (ground_cell(left, forward)?, Intrinsics::PUBLISHED.cell(left, forward)?);
        Some([a, b, c, d])
    }

    fn oracle_cells(left: f64, forward: f64) -> Option<[u8; 4]> {
        let cells = oracle(left, forward)?;
        cells.iter().all(|cell| (0.0..8.0).contains(cell)).then(|| cells.map(|cell| cell as u8))
    }

    #[test]
    fn the_published_camera_has_these_numbers() {
        let q16 = |value: f64| I16F16::from_bits((value * 65536.0).round() as i32);
        let expected = Intrinsics {
            focal_x: q16(1.1 * focal()),
            focal_y: q16(focal()),
            center: [q16(200.0 - 72.0), q16(150.0 - 22.0)],
            cell_bits: 5,
            height: q16(2.3),
        };
        assert_eq!(Intrinsics::PUBLISHED, expected);
    }

    #[test]
    fn edges_of_the_ground_are_exact() {
        for (left, forward, expected) in [
            (0.0, 8.0_f32, Some([4, 2])),
            (0.0, 8.0_f32.next_down(), Some([4, 1])),
            (-f32::from_bits(1), 8.0, Some([3, 2])),
            ((-16.0_f32).next_up(), 31.0, Some([0, 7])),
            (16.0_f32.next_down(), 31.0, Some([7, 7])),
            (16.0, 31.0, None),
            (-16.0, 31.0, None),
            (0.0, 0.0, None),
            (0.0, f32::from_bits(1), Some([4, 0])),
            (0.0, 32.0_f32.next_down(), Some([4, 7])),
            (0.0, 32.0, None),
        ] {
            let point = Mounting::TRAINED.place([left, forward, 0.0].map(f32::to_bits)).unwrap();
            assert_eq!(ground_cell(point.left.to_bits(), point.forward.to_bits()), expected, "{left}, {forward}");
        }
    }

    #[test]
    fn left_is_taken_for_right_in_the_image() {
        assert_eq!(cells(2.0, 10.0), Some([4, 2, 5, 5]));
        assert_eq!(cells(-2.0, 10.0), Some([3, 2, 2, 5]));
        assert_eq!(cells(0.0, 3.0), None, "below the crop");
    }

    #[test]
    fn the_first_five_points_of_a_cell_stay() {
        let (mut bev, mut camera) = ([9; ELEMENTS], [9; ELEMENTS]);
        let mut lists = Correspondences::new(Intrinsics::PUBLISHED);
        lists.start(&mut bev, &mut camera).unwrap();
        let place = |left: f32, forward: f32| Mounting::TRAINED.place([left, forward, 0.0].map(f32::to_bits));
        lists.push(place(1.0, 11.0), &mut bev, &mut camera);
        (0..5).for_each(|_| lists.push(place(2.0, 10.0), &mut bev, &mut camera));
        lists.push(place(-2.0, 10.0), &mut bev, &mut camera);
        lists.push(place(2.0, 10.0), &mut bev, &mut camera);
        lists.push(place(0.0, -1.0), &mut bev, &mut camera);
        lists.push(place(f32::NAN, 1.0), &mut bev, &mut camera);
        let statistics = lists.finish();
        assert_eq!(statistics, Statistics { points: 10, not_finite: 1, out_of_view: 1, surplus: 1 });
        let list = |input: &[i8; ELEMENTS], i: usize, j: usize| input[(i * 8 + j) * 10..][..10].to_vec();
        assert_eq!(list(&bev, 4, 2), [4, 5, 5, 5, 5, 5, 5, 5, 5, 5]);
        assert_eq!(list(&camera, 5, 5), [4, 2, 4, 2, 4, 2, 4, 2, 4, 2]);
        assert_eq!(list(&camera, 4, 5), [4, 2, 0, 0, 0, 0, 0, 0, 0, 0]);
        assert_eq!(list(&bev, 3, 2), [2, 5, 0, 0, 0, 0, 0, 0, 0, 0]);
        assert_eq!(bev.iter().chain(&camera).filter(|entry| **entry == 9).count(), 0);
        let mut lists = Correspondences::new(Intrinsics::PUBLISHED);
        lists.start(&mut bev, &mut camera).unwrap();
        lists.push(place(2.0, 10.0), &mut bev, &mut camera);
        lists.start(&mut bev, &mut camera).unwrap();
        assert_eq!(lists.finish(), Statistics::default());
        assert_eq!((bev, camera), ([0; ELEMENTS], [0; ELEMENTS]));
    }

    #[test]
    fn other_sizes_are_refused() {
        let mut good = [0; ELEMENTS];
        for length in [0, 639, 641] {
            let mut bad = std::vec![0; length];
            let error = InputSize { found: length as u32, expected: 640 };
            assert_eq!(Correspondences::new(Intrinsics::PUBLISHED).start(&mut bad, &mut good).unwrap_err(), error);
            assert_eq!(Correspondences::new(Intrinsics::PUBLISHED).start(&mut good, &mut bad).unwrap_err(), error);
        }
    }

    /// Points anywhere, points on edges of the ground, and points beside edges of the image's columns and rows.
    fn points() -> impl Strategy<Value = [f32; 2]> {
        let coordinate = || prop_oneof![4 => -18.0_f32..34.0, 1 => (-5_i8..=9).prop_map(|i| f32::from(i) * 4.0)];
        let columns = (0_i8..=8, 2.9_f64..32.0, -1e-4..1e-4).prop_map(|(edge, forward, off)| {
            let left = (f64::from(edge) * 32.0 - 128.0) * forward / (1.1 * focal());
            [(left + off) as f32, forward as f32]
        });
        let rows = (5_i8..=8, -4.0_f64..4.0, -1e-4..1e-4).prop_map(|(edge, left, off)| {
            let forward = focal() * 2.3 / (f64::from(edge) * 32.0 - 128.0);
            [left as f32, (forward + off) as f32]
        });
        prop_oneof![[coordinate(), coordinate()], columns, rows]
    }

    proptest! {
        #![proptest_config(ProptestConfig::with_cases(20_000))]

        #[test]
        fn cells_differ_from_f64_only_within_the_precision_of_a_border([left, forward] in points()) {
            let (found, expected) = (cells(left, forward), oracle_cells(left.into(), forward.into()));
            if found != expected {
                let [_, _, u, v] = oracle(left.into(), forward.into()).expect("the ground is exact");
                let distance = |cell: f64| (cell - cell.round()).abs() * 32.0;
                let message = std::format!("{found:?} against {expected:?}: {u} {v}");
                prop_assert!(distance(u) < PRECISION || distance(v) < PRECISION, "{}", message);
            }
        }

        #[test]
        fn any_intrinsics_and_points_give_cells(bits: [i32; 5], cell_bits: u8, left: i32, forward in 1..=i32::MAX) {
            let [a, b, c, d, e] = bits.map(I16F16::from_bits);
            let intrinsics = Intrinsics { focal_x: a, focal_y: b, center: [c, d], cell_bits, height: e };
            for cell in intrinsics.cell(left, forward).into_iter().flatten() {
                prop_assert!(cell < 8);
            }
        }
    }

    #[test]
    fn the_quotient_is_the_floor() {
        let quotients: Vec<_> = (-3..20).map(|numerator| eighth(numerator, 2)).collect();
        let expected = |numerator: i64| u8::try_from(numerator.div_euclid(2)).ok().filter(|quotient| *quotient < 8);
        assert_eq!(quotients, (-3..20).map(expected).collect::<Vec<_>>());
    }
}
