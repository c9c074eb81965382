//! From what sensors give to the codes that networks read: the runtime's integers against the host's preparation in
//! f64, and against what the networks' own preparation gave.

use firmware::sensors::NotFinite;
use firmware::sensors::camera::{Camera, CameraLayout, FrameStatus, PixelFormat, Scale};
use firmware::sensors::correspondences::{CELLS, Correspondences, ELEMENTS, ENTRIES, Intrinsics};
use firmware::sensors::heatmap;
use firmware::sensors::inputs;
use firmware::sensors::lidar::{Axes, Histogram, Mounting, Point, Statistics, Sweep};
use firmware::sensors::views::View;
use firmware::tensor::Shape;
use fixed::types::I16F16;
use model_compiler::frames::bev::{self, LidarAxes};
use model_compiler::frames::{self, Frame, FrameFormat, camera};
use model_compiler::integer_reference::encode_input;
use model_compiler::ir::InputKind;
use safetensors::SafeTensors;
use tests::commands::{self, Folder};
use tests::golden;
use tests::random::Random;

/// A raw point, as a sensor gives it.
type Raw = [f32; 3];

fn meters(value: f64) -> I16F16 {
    I16F16::from_num(value)
}

/// The histogram of a sweep, in the runtime's integers.
fn sweep(histogram: Histogram, points: impl IntoIterator<Item = Result<Point, NotFinite>>) -> (Vec<i8>, Statistics) {
    let mut counts = vec![99; histogram.shape().elements() as usize];
    let mut sweep = Sweep::new(histogram);
    sweep.start(&mut counts).unwrap();
    points.into_iter().for_each(|point| sweep.push(point, &mut counts));
    let statistics = sweep.finish();
    (counts, statistics)
}

/// A frame's input as the host gives it to a network.
fn codes(frame: &Frame, kind: InputKind) -> Vec<i64> {
    let raw: Vec<f64> = frame.raw(kind).unwrap().into_iter().map(f64::from).collect();
    encode_input(kind, &raw).into_iter().map(|code| code as i64).collect()
}

fn widened<T: Copy + Into<i64>>(codes: &[T]) -> Vec<i64> {
    codes.iter().map(|&code| code.into()).collect()
}

/// Points and counts of the stored sweep.
fn golden_sweep() -> (Vec<Raw>, Vec<u8>) {
    let bytes = std::fs::read(golden::path("bev.safetensors")).unwrap();
    let file = SafeTensors::deserialize(&bytes).unwrap();
    let coordinates = file.tensor("points").unwrap().data().as_chunks::<4>().0.iter().map(|&b| f32::from_le_bytes(b));
    let points = coordinates.collect::<Vec<_>>().as_chunks::<3>().0.to_vec();
    (points, file.tensor("bev_counts").unwrap().data().to_vec())
}

fn place(point: &Raw) -> Result<Point, NotFinite> {
    Mounting::TRAINED.place(point.map(f32::to_bits))
}

#[test]
fn golden_points_give_the_golden_histogram() {
    let (points, expected) = golden_sweep();
    let (counts, statistics) = sweep(Histogram::TRANSFUSER, points.iter().map(place));
    assert_eq!((statistics.points as usize, statistics.not_finite), (points.len(), 0));
    assert_eq!(counts.iter().map(|&count| i32::from(count)).sum::<i32>(), 9422);
    assert_eq!(counts.len(), expected.len());
    for (i, (&found, &expected)) in counts.iter().zip(&expected).enumerate() {
        assert_eq!(i32::from(found), i32::from(expected), "row {}, column {}, channel {}", i / 512, i / 2 % 256, i % 2);
    }
}

/// Cell of the ground and cell of the image that see a point, by the published formulas in f64; `None` outside, and an
/// error where u or v is so near to the border of a cell that the runtime may decide otherwise.
fn cells([left, forward, _]: Raw) -> Result<Option<[[i8; 2]; 2]>, f64> {
    let (x, y) = (f64::from(left), f64::from(forward));
    if !(x.abs() < 16.0 && 0.0 < y && y < 32.0) {
        return Ok(None);
    }
    let focal = 200.0 / 50.0_f64.to_radians().tan();
    let image = [1.1 * focal * x / y + 200.0 - 72.0, focal * 2.3 / y + 150.0 - 22.0].map(|pixel| pixel / 32.0);
    if let Some(&near) = image.iter().find(|cell| (*cell - cell.round()).abs() * 32.0 < 1.0 / 500.0) {
        return Err(near);
    }
    let is_inside = image.iter().all(|cell| (0.0..8.0).contains(cell));
    let ground = [((x + 16.0) * 8.0).min(255.0) / 32.0, (y * 8.0).min(255.0) / 32.0];
    Ok(is_inside.then(|| [ground, image].map(|cell| cell.map(|i| i as i8))))
}

#[test]
fn golden_points_join_the_cells_of_f64() {
    let (mut points, _) = golden_sweep();
    let count = points.len();
    points.retain(|&point| cells(point).is_ok());
    assert!(points.len() + 50 > count, "{} of {count} points lie beside borders of cells", count - points.len());
    let mut expected = [[[[[0_i8; 2]; ENTRIES]; CELLS]; CELLS]; 2];
    let mut lengths = [[[0; CELLS]; CELLS]; 2];
    for [ground, image] in points.iter().filter_map(|&point| cells(point).ok().flatten()) {
        for (view, [i, j], entry) in [(0, ground, image), (1, image, ground)] {
            let (i, j) = (i as usize, j as usize);
            if lengths[view][i][j] < ENTRIES {
                expected[view][i][j][lengths[view][i][j]] = entry;
                lengths[view][i][j] += 1;
            }
        }
    }
    let (mut bev, mut camera) = ([99; ELEMENTS], [99; ELEMENTS]);
    let mut lists = Correspondences::new(Intrinsics::PUBLISHED);
    lists.start(&mut bev, &mut camera).unwrap();
    points.iter().for_each(|point| lists.push(place(point), &mut bev, &mut camera));
    let statistics = lists.finish();
    assert_eq!((statistics.points as usize, statistics.not_finite), (points.len(), 0));
    assert!(lengths.as_flattened().as_flattened().iter().filter(|&&length| length == ENTRIES).count() > 20);
    for (found, expected) in [bev, camera].iter().zip(&expected) {
        assert_eq!(found.as_slice(), expected.as_flattened().as_flattened().as_flattened());
    }
}

/// Coordinates of every kind: inside, on edges of bins and beside them, tiny, huge, not finite.
fn coordinate(random: &mut Random) -> f32 {
    let edge = |random: &mut Random, step: f32| (random.below(1400) as f32 - 700.0) * step;
    match random.below(16) {
        0..8 => random.signed_unit() * 36.0,
        8 => edge(random, 65.0 / 256.0),
        9 => edge(random, 65.0 / 1024.0).next_up(),
        10 => edge(random, 0.125).next_down(),
        11 => edge(random, 1.0 / 32.0),
        12 => *random.pick(&[0.0, -0.0, 32.0, -32.0, 33.0, -2.0, 2.0, f32::MAX, f32::MIN, f32::MIN_POSITIVE]),
        13 => f32::from_bits(random.below(1 << 23) as u32 | (random.below(2) as u32) << 31),
        14 => *random.pick(&[f32::NAN, f32::INFINITY, f32::NEG_INFINITY]),
        _ => f32::from_bits(random.bits() as u32),
    }
}

#[test]
fn random_clouds_give_the_histogram_of_f64() {
    let sides = [1, 2, 32, 128, 256, 1024];
    for seed in 0..60 {
        let mut random = Random::new(seed);
        let shape = Shape::map(*random.pick(&sides), *random.pick(&sides), 2);
        // Splits and heights whose codes are even: exact.
        let split = (f64::from(random.signed_unit()) * 512.0).round() / 128.0;
        let height = *random.pick(&[2.5, 1.75, 1.5, 3.0, 2.5 + 1.0 / 32768.0]);
        let (axes, host_axes) = *random.pick(&[(Axes::Carla, LidarAxes::Carla), (Axes::Velodyne, LidarAxes::Velodyne)]);
        let points: Vec<Raw> = (0..5000).map(|_| [(); 3].map(|()| coordinate(&mut random))).collect();
        let mounting = Mounting::new(axes, meters(height));
        let histogram = Histogram::new(shape, meters(split)).unwrap();
        let (counts, statistics) = sweep(histogram, points.iter().map(|point| mounting.place(point.map(f32::to_bits))));
        let placed = points.iter().map(|&point| host_axes.to_trained_frame(point, height));
        let (expected, dropped) = bev::histogram(placed, split, shape);
        assert_eq!(statistics.not_finite as usize, dropped, "seed {seed}");
        let unequal = counts.iter().zip(&expected.data).position(|(&a, &b)| i32::from(a) != i32::from(b));
        assert_eq!(unequal, None, "seed {seed}, {shape:?}, split at {split} m, sensor at {height} m");
        assert_eq!(statistics.points, 5000);
        let counted: u32 = expected.data.iter().map(|&count| u32::from(count)).sum();
        let left_out = statistics.not_finite + statistics.out_of_range + statistics.saturated;
        assert_eq!(counted + left_out, 5000, "seed {seed}: every point is accounted for");
    }
}

/// An image of random pixels as a PNG file, and the same pixels as bytes.
fn picture(folder: &Folder, width: u32, height: u32, random: &mut Random) -> image::RgbImage {
    let image = image::RgbImage::from_fn(width, height, |_, _| image::Rgb([(); 3].map(|()| random.bits() as u8)));
    image.save(folder.path("rgb.png")).unwrap();
    image
}

/// Bytes of an image in another order of channels, rows `padding` bytes apart, and their stride.
fn laid_out(image: &image::RgbImage, format: PixelFormat, padding: usize) -> (Vec<u8>, u32) {
    let pixel = |&[r, g, b]: &[u8; 3]| match format {
        PixelFormat::Rgb => vec![r, g, b],
        PixelFormat::Bgr => vec![b, g, r],
        PixelFormat::Rgba => vec![r, g, b, 0],
        _ => vec![b, g, r, 255],
    };
    let row_pixels = image.width() as usize * 3;
    let rows = image.as_raw().chunks(row_pixels).map(|row| {
        let mut bytes: Vec<u8> = row.as_chunks::<3>().0.iter().flat_map(pixel).collect();
        bytes.resize(bytes.len() + padding, 0xEE);
        bytes
    });
    let rows: Vec<_> = rows.collect();
    (rows.concat(), rows[0].len() as u32)
}

#[test]
fn images_give_the_crop_of_the_host() {
    for seed in 0..12 {
        let mut random = Random::new(seed);
        let folder = Folder::default();
        let map = Shape::map(1 + random.below(60) as u16, 1 + random.below(60) as u16, 3);
        let (width, height) = (u32::from(map.width) + random.below(50) as u32, u32::from(map.height) + 13);
        let image = picture(&folder, width, height, &mut random);
        let formats = [PixelFormat::Rgb, PixelFormat::Bgr, PixelFormat::Rgba, PixelFormat::Bgra];
        let layout = CameraLayout {
            width: width as u16,
            height: height as u16,
            format: *random.pick(&formats),
            scale: Scale::Full,
            map,
            first_channel: 0,
            frozen_after: 0,
        };
        let (bytes, stride) = laid_out(&image, layout.format, random.below(9));
        let found = capture(layout, &bytes, stride);
        let rgb = Some(camera::load(&folder.path("rgb.png"), map).unwrap());
        let expected = codes(&Frame { rgb, ..Frame::default() }, InputKind::Image);
        assert_eq!(widened(&found), expected, "seed {seed}, {layout:?}");
    }
}

/// The network's input of a camera that gave one image.
fn capture(layout: CameraLayout, bytes: &[u8], stride: u32) -> Vec<i8> {
    let mut memory = vec![0; layout.memory_words()];
    let mut input = vec![0; layout.map.elements() as usize];
    let mut camera = Camera::new(layout, &mut memory).unwrap();
    camera.push_image(bytes, stride, &mut input).unwrap();
    assert_eq!(camera.finish(), Ok(FrameStatus::Live));
    input
}

/// All inputs of one frame of a street, from the files of a frame folder.
#[test]
fn a_street_scene_gives_the_inputs_of_the_host() {
    let Some(kitti) = commands::shared("data/kitti/000008") else { return };
    let folder = Folder::default();
    for file in ["rgb.png", "lidar.bin", "frame.json"] {
        folder.write(&format!("kitti/000008/{file}"), std::fs::read(kitti.join(file)).unwrap());
    }
    let shapes = [
        (InputKind::Image, Shape::map(256, 256, 3)),
        (InputKind::Bev, bev::SHAPE),
        (InputKind::Velocity, Shape::vector(1)),
        (InputKind::Goal, Shape::vector(2)),
    ];
    for (system, histogram) in [("transfuser", Histogram::TRANSFUSER), ("late_fusion", Histogram::BASELINES)] {
        let frames = frames::load(&folder.path("kitti"), &FrameFormat::new(system, shapes)).unwrap();
        let frame = &frames[0];
        let image = image::open(kitti.join("rgb.png")).unwrap().into_rgb8();
        let layout = CameraLayout {
            width: image.width() as u16,
            height: image.height() as u16,
            format: PixelFormat::Rgb,
            scale: Scale::Full,
            map: Shape::map(256, 256, 3),
            first_channel: View::Front.first_channel(),
            frozen_after: 0,
        };
        let found = capture(layout, image.as_raw(), image.width() * 3);
        assert_eq!(widened(&found), codes(frame, InputKind::Image));

        let lidar = std::fs::read(kitti.join("lidar.bin")).unwrap();
        let mounting = Mounting::new(Axes::Velodyne, meters(1.73));
        let words = lidar.as_chunks::<4>().0.iter().map(|&bytes| u32::from_le_bytes(bytes)).collect::<Vec<_>>();
        let points = words.chunks_exact(4).map(|point| mounting.place([point[0], point[1], point[2]]));
        let (counts, statistics) = sweep(histogram, points);
        let expected = codes(frame, InputKind::Bev);
        assert_eq!((statistics.points, statistics.not_finite), (17238, 0));
        assert_eq!(widened(&counts), expected, "{system}");

        let speed = inputs::velocity(5.0_f32.to_bits()).unwrap();
        assert_eq!(widened(&[speed]), codes(frame, InputKind::Velocity));
        let goal = inputs::goal([1.5_f32, -25.0].map(f32::to_bits)).unwrap();
        assert_eq!(widened(&goal), codes(frame, InputKind::Goal));
    }
}

#[test]
fn speed_and_goal_have_the_codes_of_the_host() {
    let mut random = Random::new(7);
    for i in 0..20_000 {
        let value = match i % 4 {
            0 => random.signed_unit() * 200.0,
            1 => (random.below(1 << 17) as f32 - 65536.0) / 512.0,
            2 => random.signed_unit() * 1e5,
            _ => f32::from_bits(random.bits() as u32),
        };
        let frame =
            Frame { velocity: Some(value.into()), goal: Some([value.into(), -f64::from(value)]), ..Frame::default() };
        let (velocity, goal) = (inputs::velocity(value.to_bits()), inputs::goal([value, -value].map(f32::to_bits)));
        if !value.is_finite() {
            assert_eq!((velocity, goal), (Err(NotFinite), Err(NotFinite)));
            continue;
        }
        assert_eq!(widened(&[velocity.unwrap()]), codes(&frame, InputKind::Velocity), "{value:e} m/s");
        assert_eq!(widened(&goal.unwrap()), codes(&frame, InputKind::Goal), "{value:e} m");
    }
}

/// Three views and a heatmap in one map: every channel is written by its own source.
#[test]
fn three_cameras_and_a_goal_fill_the_map_of_lbc() {
    let bytes = std::fs::read(golden::path("inputs.safetensors")).unwrap();
    let file = SafeTensors::deserialize(&bytes).unwrap();
    let views = file.tensor("lbc_views").unwrap();
    let plane = 144 * 256;
    let views = &views.data()[..9 * plane];
    let target = file.tensor("target").unwrap();
    let target = [0, 1].map(|i| u32::from_le_bytes([0, 1, 2, 3].map(|k| target.data()[4 * i + k])));
    let mut input = vec![99; heatmap::MAP.elements() as usize];
    for view in View::LBC {
        let first = usize::from(view.first_channel());
        let bgra: Vec<u8> = (0..plane)
            .flat_map(|p| [views[(first + 2) * plane + p], views[(first + 1) * plane + p], views[first * plane + p], 0])
            .collect();
        let layout = CameraLayout {
            width: 256,
            height: 144,
            format: PixelFormat::Bgra,
            scale: Scale::Full,
            map: heatmap::MAP,
            first_channel: view.first_channel(),
            frozen_after: 0,
        };
        let mut memory = vec![0; layout.memory_words()];
        let mut camera = Camera::new(layout, &mut memory).unwrap();
        camera.push_image(&bgra, 256 * 4, &mut input).unwrap();
        assert_eq!(camera.finish(), Ok(FrameStatus::Live));
    }
    heatmap::draw(inputs::goal(target).unwrap(), &mut input).unwrap();
    // 0.5 m to the right and 20 m ahead: pixel (130.75, 146), clamped to the last row.
    for (p, pixel) in input.chunks_exact(10).enumerate() {
        for (channel, &code) in pixel[..9].iter().enumerate() {
            assert_eq!(i32::from(code) + 128, i32::from(views[channel * plane + p]), "pixel {p}, channel {channel}");
        }
        let (dx, dy) = (p as i32 % 256 - 131, p as i32 / 256 - 143);
        let is_in_bell = dx.abs() <= 5 && dy.abs() <= 5 && dx * dx + dy * dy < 50;
        assert_eq!(pixel[9] > -128, is_in_bell, "pixel {p}");
    }
    assert_eq!(input[(143 * 256 + 131) * 10 + 9], 127);
}
