//! Every format, scale, crop and order of rows against a naive reading of the whole image.

extern crate std;

use super::*;
use crate::image::known_answer::Generator;
use proptest::prelude::*;
use std::{vec, vec::Vec};

const FORMATS: [PixelFormat; 9] = [
    PixelFormat::Rgb,
    PixelFormat::Bgr,
    PixelFormat::Rgba,
    PixelFormat::Bgra,
    PixelFormat::Grey,
    PixelFormat::Yuyv(YuvRange::Full),
    PixelFormat::Yuyv(YuvRange::Limited),
    PixelFormat::Nv12(YuvRange::Full),
    PixelFormat::Nv12(YuvRange::Limited),
];
const SCALES: [Scale; 4] = [Scale::Full, Scale::Half, Scale::Quarter, Scale::Eighth];
/// What the network's input holds where nothing was written.
const UNTOUCHED: i8 = 99;

/// A camera's image with rows of random bytes, padding included.
struct Image {
    layout: CameraLayout,
    stride: usize,
    bytes: Vec<u8>,
}

impl Image {
    fn new(layout: CameraLayout, padding: usize, random: &mut Generator) -> Self {
        let stride = row_bytes(&layout) + padding;
        let bytes = (0..stride * layout.rows() as usize).map(|_| random.draw() as u8).collect();
        Self { layout, stride, bytes }
    }

    fn row(&self, row: usize) -> &[u8] {
        &self.bytes[row * self.stride..][..self.stride]
    }

    /// Components of a pixel of the image.
    fn components(&self, x: usize, y: usize) -> [u8; 3] {
        let row = self.row(y);
        match self.layout.format {
            PixelFormat::Rgb => [row[3 * x], row[3 * x + 1], row[3 * x + 2]],
            PixelFormat::Bgr => [row[3 * x + 2], row[3 * x + 1], row[3 * x]],
            PixelFormat::Rgba => [row[4 * x], row[4 * x + 1], row[4 * x + 2]],
            PixelFormat::Bgra => [row[4 * x + 2], row[4 * x + 1], row[4 * x]],
            PixelFormat::Grey => [row[x]; 3],
            PixelFormat::Yuyv(_) => [row[2 * x], row[x / 2 * 4 + 1], row[x / 2 * 4 + 3]],
            PixelFormat::Nv12(_) => {
                let chroma = self.row(usize::from(self.layout.height) + y / 2);
                [row[x], chroma[x / 2 * 2], chroma[x / 2 * 2 + 1]]
            }
        }
    }

    /// RGB of a pixel of the scaled image.
    fn color(&self, x: usize, y: usize) -> [u8; 3] {
        let side = 1_usize << self.layout.scale.bits();
        let mut sums = [0_usize; 3];
        for (dx, dy) in (0..side * side).map(|i| (i % side, i / side)) {
            let components = self.components(x * side + dx, y * side + dy);
            sums.iter_mut().zip(components).for_each(|(sum, component)| *sum += usize::from(component));
        }
        let means = sums.map(|sum| ((sum + side * side / 2) / (side * side)) as f64);
        let [y, u, v] = means;
        let (u, v) = (u - 128.0, v - 128.0);
        let rounded = |value: f64| (value + 0.5).floor().clamp(0.0, 255.0) as u8;
        // Sums of Q16 numbers: exact.
        let q16 = |factor: f64| (factor * 65536.0).round() / 65536.0;
        match self.layout.format {
            PixelFormat::Yuyv(YuvRange::Full) | PixelFormat::Nv12(YuvRange::Full) => {
                [y + q16(1.402) * v, y - q16(0.344_136) * u - q16(0.714_136) * v, y + q16(1.772) * u].map(rounded)
            }
            PixelFormat::Yuyv(YuvRange::Limited) | PixelFormat::Nv12(YuvRange::Limited) => {
                let y = q16(255.0 / 219.0) * (y - 16.0);
                let green = y - q16(0.391_762) * u - q16(0.812_968) * v;
                [y + q16(1.596_027) * v, green, y + q16(2.017_232) * u].map(rounded)
            }
            _ => means.map(|mean| mean as u8),
        }
    }

    /// The network's input, where `is_written` says of a row of the crop that it came.
    fn expected(&self, is_written: impl Fn(usize) -> bool) -> Vec<i8> {
        let CameraLayout { map, first_channel, .. } = self.layout;
        let [height, width, channels] = [map.height, map.width, map.channels].map(usize::from);
        let [top, left] = [(self.layout.height, height), (self.layout.width, width)]
            .map(|(side, crop)| ((usize::from(side) >> self.layout.scale.bits()) - crop) / 2);
        let mut input = vec![UNTOUCHED; height * width * channels];
        for (x, y) in (0..height * width).map(|i| (i % width, i / width)).filter(|&(_, y)| is_written(y)) {
            let color = self.color(left + x, top + y).map(|level| (i16::from(level) - 128) as i8);
            let pixel = &mut input[(y * width + x) * channels..][..channels];
            match channels {
                1 => pixel[0] = color[0],
                _ => pixel[usize::from(first_channel)..][..3].copy_from_slice(&color),
            }
        }
        input
    }
}

fn row_bytes(layout: &CameraLayout) -> usize {
    usize::from(layout.width)
        * match layout.format {
            PixelFormat::Rgb | PixelFormat::Bgr => 3,
            PixelFormat::Rgba | PixelFormat::Bgra => 4,
            PixelFormat::Yuyv(_) => 2,
            PixelFormat::Grey | PixelFormat::Nv12(_) => 1,
        }
}

fn below(random: &mut Generator, bound: usize) -> usize {
    (random.draw() % bound as u64) as usize
}

fn shuffle<T>(items: &mut [T], random: &mut Generator) {
    for i in (1..items.len()).rev() {
        items.swap(i, below(random, i + 1));
    }
}

/// A small camera of every kind.
fn layouts() -> impl Strategy<Value = CameraLayout> {
    let crop = (1_u16..12, 1_u16..8, 0_u16..30, 0_u16..30, 0_u16..4);
    (0..FORMATS.len(), 0..SCALES.len(), crop).prop_map(|(format, scale, (width, height, right, below, channel))| {
        let (format, scale) = (FORMATS[format], SCALES[scale]);
        let is_grey = format == PixelFormat::Grey && channel == 3;
        let channels = if is_grey { 1 } else { 3 + [0, 0, 7, 1][usize::from(channel)] };
        let even = |side: u16| side + (side & 1);
        CameraLayout {
            width: even((width << scale.bits()) + right),
            height: even((height << scale.bits()) + below),
            format,
            scale,
            map: Shape::map(height, width, channels),
            first_channel: if is_grey { 0 } else { (channels - 3).min(channel) },
            frozen_after: 0,
        }
    })
}

/// Rows of the image whose pieces may come in any order: all of them, or those of one row of the crop.
fn groups(layout: &CameraLayout, camera: &Camera<'_>) -> Vec<Vec<usize>> {
    let rows = 0..layout.rows() as usize;
    if layout.scale == Scale::Full {
        return vec![rows.collect()];
    }
    let mut groups = std::collections::BTreeMap::<(bool, Option<u32>), Vec<usize>>::new();
    for row in rows {
        let is_chroma = row >= usize::from(layout.height);
        groups.entry((is_chroma, camera.crop_row_of(row as u32))).or_default().push(row);
    }
    groups.into_values().collect()
}

impl Camera<'_> {
    /// The row of the crop that a row in memory belongs to; of chroma at full scale the first of two.
    fn crop_row_of(&self, row: u32) -> Option<u32> {
        let height = u32::from(self.layout.height);
        self.crop_row(if row < height { row } else { (row - height) * 2 })
    }
}

/// Pushes all rows but those in `lost`, in random order and random pieces.
fn push(image: &Image, camera: &mut Camera<'_>, input: &mut [i8], lost: &[usize], random: &mut Generator) {
    let layout = image.layout;
    let mut groups = groups(&layout, camera);
    shuffle(&mut groups, random);
    for group in groups {
        let mut open: Vec<(usize, usize)> =
            group.into_iter().filter(|row| !lost.contains(row)).map(|row| (row, 0)).collect();
        while !open.is_empty() {
            let at = below(random, open.len());
            let (row, offset) = open[at];
            let unit = usize::from(layout.format.unit(row >= usize::from(layout.height)).bytes);
            let rest = row_bytes(&layout) - offset;
            let units = (1 + below(random, rest / unit)).max(below(random, rest / unit + 1));
            let is_last = units * unit == rest;
            // The last piece brings the padding along; a piece may repeat bytes that came before.
            let end = if is_last { image.stride } else { offset + units * unit };
            let begin = offset - below(random, offset / unit + 1) * unit;
            camera.push(row as u32, begin as u32, &image.row(row)[begin..end], input).unwrap();
            if is_last {
                open.swap_remove(at);
            } else {
                open[at].1 = end;
            }
        }
    }
}

/// Rows of the crop that need one of these rows in memory.
fn needing(lost: &[usize], image: &Image) -> Vec<usize> {
    let layout = image.layout;
    let side = 1 << layout.scale.bits();
    let top = ((usize::from(layout.height) / side) - usize::from(layout.map.height)) / 2 * side;
    let needs = |row: &usize| {
        (top + row * side..top + (row + 1) * side).any(|y| {
            let is_planar = matches!(layout.format, PixelFormat::Nv12(_));
            lost.contains(&y) || is_planar && lost.contains(&(usize::from(layout.height) + y / 2))
        })
    };
    (0..usize::from(layout.map.height)).filter(needs).collect()
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(2000))]

    #[test]
    fn any_order_of_pieces_gives_the_crop(layout in layouts(), padding in 0_usize..5, seed: u64) {
        let mut random = Generator::new(seed);
        let image = Image::new(layout, padding, &mut random);
        let mut memory = vec![7; layout.memory_words()];
        let mut camera = Camera::new(layout, &mut memory).unwrap();
        for _ in 0..2 {
            let mut input = vec![UNTOUCHED; layout.map.elements() as usize];
            push(&image, &mut camera, &mut input, &[], &mut random);
            prop_assert_eq!(camera.finish(), Ok(FrameStatus::Live));
            prop_assert_eq!(&input, &image.expected(|_| true));
        }
        let mut input = vec![UNTOUCHED; layout.map.elements() as usize];
        let image = Image::new(layout, padding, &mut random);
        camera.push_image(&image.bytes, image.stride as u32, &mut input).unwrap();
        prop_assert_eq!(camera.finish(), Ok(FrameStatus::Live));
        prop_assert_eq!(&input, &image.expected(|_| true));
    }

    #[test]
    fn lost_rows_are_noticed_and_the_others_are_right(layout in layouts(), seed: u64) {
        let mut random = Generator::new(seed);
        let image = Image::new(layout, 0, &mut random);
        let lost: Vec<usize> = (0..layout.rows() as usize).filter(|_| below(&mut random, 8) == 0).collect();
        let mut memory = vec![7; layout.memory_words()];
        let mut camera = Camera::new(layout, &mut memory).unwrap();
        let mut input = vec![UNTOUCHED; layout.map.elements() as usize];
        push(&image, &mut camera, &mut input, &lost, &mut random);
        let missing = needing(&lost, &image);
        let top = camera.top as usize;
        let found = camera.finish();
        match missing.first() {
            None => prop_assert_eq!(found, Ok(FrameStatus::Live)),
            Some(first) => {
                let first = (top + (first << layout.scale.bits())) as u16;
                prop_assert_eq!(found, Err(MissingRows { count: missing.len() as u16, first }));
            }
        }
        let width = usize::from(layout.map.width) * usize::from(layout.map.channels);
        let expected = image.expected(|_| true);
        for row in (0..usize::from(layout.map.height)).filter(|row| !missing.contains(row)) {
            prop_assert_eq!(&input[row * width..][..width], &expected[row * width..][..width]);
        }
    }

    #[test]
    fn no_call_panics_or_writes_a_refused_piece(
        layout in layouts(),
        calls in prop::collection::vec((any::<u16>(), any::<u16>(), 0_usize..300, any::<bool>()), 0..60),
    ) {
        let mut memory = vec![7; layout.memory_words()];
        let mut camera = Camera::new(layout, &mut memory).unwrap();
        let mut input = vec![UNTOUCHED; layout.map.elements() as usize];
        for (row, offset, length, is_near) in calls {
            let row = if is_near { u32::from(row) % (layout.rows() + 2) } else { u32::from(row) << 16 };
            let offset = if is_near { u32::from(offset) % 64 } else { u32::from(offset) << 16 };
            let before = input.clone();
            if camera.push(row, offset, &vec![1; length], &mut input).is_err() {
                prop_assert_eq!(&before, &input);
            }
        }
        let _ = camera.finish();
    }
}

fn small(format: PixelFormat) -> CameraLayout {
    CameraLayout {
        width: 8,
        height: 6,
        format,
        scale: Scale::Full,
        map: Shape::map(4, 4, 3),
        first_channel: 0,
        frozen_after: 2,
    }
}

#[test]
fn the_crop_of_the_trained_camera_starts_at_row_22_and_column_72() {
    let layout = CameraLayout { width: 400, height: 300, map: Shape::map(256, 256, 3), ..small(PixelFormat::Bgra) };
    let mut memory = vec![0; layout.memory_words()];
    let camera = Camera::new(layout, &mut memory).unwrap();
    assert_eq!((camera.top, camera.left), (22, 72));
    let layout = CameraLayout { width: 1242, height: 375, ..layout };
    let camera = Camera::new(layout, &mut memory).unwrap();
    assert_eq!((camera.top, camera.left), (59, 493));
}

#[test]
fn several_cameras_interleave_in_one_map() {
    use crate::sensors::views::View;
    let map = Shape::map(2, 2, 10);
    let mut input = [UNTOUCHED; 40];
    for (view, level) in View::LBC.into_iter().zip([10, 20, 30]) {
        let layout =
            CameraLayout { width: 2, height: 2, map, first_channel: view.first_channel(), ..small(PixelFormat::Rgb) };
        let mut memory = [0; 2];
        let mut camera = Camera::new(layout, &mut memory).unwrap();
        camera.push_image(&[level; 12], 6, &mut input).unwrap();
    }
    let pixel = [-118, -118, -118, -108, -108, -108, -98, -98, -98, UNTOUCHED];
    assert!(input.chunks(10).all(|codes| codes == pixel), "{input:?}");
}

#[test]
fn equal_frames_in_a_row_are_a_frozen_camera() {
    let layout = small(PixelFormat::Rgb);
    let mut random = Generator::new(1);
    let mut image = Image::new(layout, 0, &mut random);
    let mut memory = vec![0; layout.memory_words()];
    let mut camera = Camera::new(layout, &mut memory).unwrap();
    let mut frame = |image: &Image| {
        push(image, &mut camera, &mut [0; 48], &[], &mut random);
        camera.finish()
    };
    assert_eq!(
        [(); 4].map(|()| frame(&image)),
        [
            Ok(FrameStatus::Live),
            Ok(FrameStatus::Live),
            Ok(FrameStatus::Frozen { repeats: 2 }),
            Ok(FrameStatus::Frozen { repeats: 3 }),
        ]
    );
    // Row 1 and column 2 begin the crop; what lies outside does not count.
    image.bytes[0] ^= 1;
    assert_eq!(frame(&image), Ok(FrameStatus::Frozen { repeats: 4 }));
    image.bytes[8 * 3 + 2 * 3] ^= 1;
    assert_eq!(frame(&image), Ok(FrameStatus::Live));
    // Two pixels that change places are another image.
    let at = 8 * 3 + 2 * 3;
    image.bytes[at..at + 6].rotate_left(3);
    assert_eq!(frame(&image), Ok(FrameStatus::Live));
}

#[test]
fn a_frame_with_lost_rows_is_not_compared() {
    let layout = CameraLayout { frozen_after: 1, ..small(PixelFormat::Rgb) };
    let mut memory = vec![0; layout.memory_words()];
    let mut camera = Camera::new(layout, &mut memory).unwrap();
    let mut input = [0; 48];
    let mut frame = |rows: core::ops::Range<u32>| {
        rows.for_each(|row| camera.push(row, 0, &[5; 24], &mut input).unwrap());
        camera.finish()
    };
    assert_eq!(frame(0..6), Ok(FrameStatus::Live));
    assert_eq!(frame(0..4), Err(MissingRows { count: 1, first: 4 }));
    assert_eq!(frame(0..0), Err(MissingRows { count: 4, first: 1 }));
    assert_eq!(frame(0..6), Ok(FrameStatus::Frozen { repeats: 1 }));
}

#[test]
fn rows_of_one_crop_row_that_come_apart_are_missing() {
    let layout = CameraLayout { scale: Scale::Half, map: Shape::map(2, 2, 3), ..small(PixelFormat::Rgb) };
    let mut memory = vec![0; layout.memory_words()];
    let mut camera = Camera::new(layout, &mut memory).unwrap();
    let mut input = [UNTOUCHED; 12];
    for row in [0, 2, 1, 3] {
        camera.push(row, 0, &[200; 24], &mut input).unwrap();
    }
    assert_eq!(camera.finish(), Err(MissingRows { count: 2, first: 0 }));
    assert_eq!(input, [UNTOUCHED; 12]);
}

#[test]
fn frames_become_readings_of_the_driver() {
    assert_eq!(Reading::from(Ok(FrameStatus::Live)), Reading::now(()));
    assert_eq!(Reading::from(Ok(FrameStatus::Frozen { repeats: 2 })), Reading::Frozen);
    assert_eq!(Reading::from(Err(MissingRows { count: 1, first: 0 })), Reading::Missing);
}

#[test]
fn a_refused_piece_leaves_the_sums_under_way() {
    let layout = CameraLayout { scale: Scale::Half, map: Shape::map(2, 2, 3), ..small(PixelFormat::Rgb) };
    let mut memory = vec![0; layout.memory_words()];
    let mut camera = Camera::new(layout, &mut memory).unwrap();
    let mut input = [UNTOUCHED; 12];
    camera.push(0, 0, &[200; 24], &mut input).unwrap();
    // Of another row of the crop: one piece begins too far to the right, one ends before the crop begins.
    let refused = camera.push(2, 12, &[7; 12], &mut input);
    assert_eq!(refused, Err(CameraError::Gap { row: 2, expected: 2, found: 4 }));
    assert_eq!(camera.push(2, 0, &[7; 6], &mut input), Ok(()));
    camera.push(1, 0, &[100; 24], &mut input).unwrap();
    assert_eq!((&input[..6], &input[6..]), (&[22; 6][..], &[UNTOUCHED; 6][..]));
}

#[test]
fn wrong_pieces_are_named() {
    let layout = small(PixelFormat::Rgb);
    let mut memory = vec![0; layout.memory_words()];
    let mut camera = Camera::new(layout, &mut memory).unwrap();
    let mut input = [UNTOUCHED; 48];
    let mut refused =
        |row, offset, length| camera.push(row, offset, &vec![0; length], &mut input).unwrap_err().to_string();
    use std::string::ToString;
    assert_eq!(refused(6, 0, 24), "row 6: the image has 6 rows in memory");
    assert_eq!(refused(1, 0, 10), "row 1: a piece splits its units of 3 bytes");
    assert_eq!(refused(1, 2, 3), "row 1: a piece splits its units of 3 bytes");
    assert_eq!(refused(1, 9, 3), "row 1: a piece begins at column 3, the row lacks column 2");
    let error = camera.push(1, 0, &[0; 24], &mut [0; 47]).unwrap_err();
    assert_eq!(error.to_string(), "network input: 47 elements given, expected 48");
    let error = camera.push_image(&[0; 24 * 5 - 1], 24, &mut input).unwrap_err();
    assert_eq!(error.to_string(), "row 4: the image ends after 119 bytes");
}

#[test]
fn impossible_layouts_are_named() {
    let layout = small(PixelFormat::Rgb);
    let map = |height, width, channels| CameraLayout { map: Shape::map(height, width, channels), ..layout };
    let nv12 = small(PixelFormat::Nv12(YuvRange::Full));
    use std::string::ToString;
    for (layout, expected) in [
        (map(7, 4, 3), "image is 8×6, the crop needs 4×7 and at least one pixel"),
        (map(4, 9, 3), "image is 8×6, the crop needs 9×4 and at least one pixel"),
        (map(0, 4, 3), "image is 8×6, the crop needs 4×0 and at least one pixel"),
        (CameraLayout { scale: Scale::Half, ..layout }, "image is 8×6, the crop needs 8×8 and at least one pixel"),
        (CameraLayout { width: 7, ..nv12 }, "image is 7×6, its pixels share chroma in pairs"),
        (CameraLayout { height: 5, ..nv12 }, "image is 8×5, its pixels share chroma in pairs"),
        (map(4, 4, 1), "channels 0.. of a map of 1: a camera writes three, or grey the only one"),
        (map(4, 4, 2), "channels 0.. of a map of 2: a camera writes three, or grey the only one"),
        (
            CameraLayout { first_channel: 1, ..layout },
            "channels 1.. of a map of 3: a camera writes three, or grey the only one",
        ),
    ] {
        assert_eq!(Camera::new(layout, &mut [0; 100]).unwrap_err().to_string(), expected);
    }
    let grey = CameraLayout { map: Shape::map(4, 4, 1), ..small(PixelFormat::Grey) };
    assert!(Camera::new(grey, &mut [0; 4]).is_ok());
    assert_eq!(Camera::new(nv12, &mut [0; 7]).unwrap_err(), LayoutError::Memory { found: 7, needed: 8 });
}
