//! No rows, points or sizes make the sensor layer panic, or write what it refused.
#![no_main]

use firmware::sensors::camera::{Camera, CameraLayout, PixelFormat, Scale, YuvRange};
use firmware::sensors::correspondences::{Correspondences, ELEMENTS, Intrinsics};
use firmware::sensors::lidar::{Axes, Heading, Histogram, Motion, Mounting, Pose, Sweep};
use firmware::sensors::{heatmap, inputs};
use firmware::tensor::Shape;
use libfuzzer_sys::arbitrary::{Arbitrary, Result, Unstructured};
use libfuzzer_sys::fuzz_target;

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
/// Larger inputs are left out: each run is to take microseconds.
const MAX_ELEMENTS: u64 = 1 << 16;

fuzz_target!(|bytes: &[u8]| {
    let mut data = Unstructured::new(bytes);
    // The bytes may end anywhere.
    let _ = camera(&mut data);
    let _ = lidar(&mut data);
});

fn camera(data: &mut Unstructured<'_>) -> Result<()> {
    let layout = CameraLayout {
        width: u16::arbitrary(data)?,
        height: u16::arbitrary(data)?,
        format: *data.choose(&FORMATS)?,
        scale: *data.choose(&SCALES)?,
        map: Shape::map(u16::arbitrary(data)?, u16::arbitrary(data)?, u16::arbitrary(data)?),
        first_channel: u16::arbitrary(data)?,
        frozen_after: u16::arbitrary(data)?,
    };
    if layout.map.elements() > MAX_ELEMENTS || layout.memory_words() > 1 << 20 {
        return Ok(());
    }
    let mut memory = vec![u16::MAX; layout.memory_words()];
    let Ok(mut camera) = Camera::new(layout, &mut memory) else { return Ok(()) };
    let mut input = vec![99; layout.map.elements() as usize];
    for _ in 0..data.int_in_range(0..=40)? {
        let before = input.clone();
        match data.int_in_range(0..=15)? {
            0 => drop(camera.finish()),
            1 => {
                let image = vec![1; data.int_in_range(0..=5000)?];
                // Whole rows before the image's end are written.
                let _ = camera.push_image(&image, u32::arbitrary(data)?, &mut input);
            }
            _ => {
                let (row, offset) = (data.int_in_range(0..=layout.rows())?, u32::arbitrary(data)?);
                let piece = vec![2; data.int_in_range(0..=1000)?];
                let is_refused = camera.push(row, offset, &piece, &mut input).is_err();
                assert!(!is_refused || before == input, "wrote a refused piece");
            }
        }
    }
    Ok(())
}

fn lidar(data: &mut Unstructured<'_>) -> Result<()> {
    let fixed = |data: &mut Unstructured<'_>| Ok(fixed::types::I16F16::from_bits(i32::arbitrary(data)?));
    let mounting = Mounting::new(*data.choose(&[Axes::Carla, Axes::Velodyne])?, fixed(data)?);
    let heading = Heading::new(i32::arbitrary(data)?, i32::arbitrary(data)?).unwrap_or(Heading::NORTH);
    let capture = Pose { north: fixed(data)?, east: fixed(data)?, heading };
    let motion = Motion::between(&capture, &Pose { north: fixed(data)?, east: fixed(data)?, heading: Heading::NORTH });
    let shape = Shape::map(1 << data.int_in_range(0..=7)?, 1 << data.int_in_range(0..=7)?, 2);
    let histogram = Histogram::new(shape, fixed(data)?).expect("powers of two");
    let mut counts = vec![99; shape.elements() as usize];
    let mut sweep = Sweep::new(histogram);
    sweep.start(&mut counts).expect("its own size");
    let intrinsics = Intrinsics {
        focal_x: fixed(data)?,
        focal_y: fixed(data)?,
        center: [fixed(data)?, fixed(data)?],
        cell_bits: u8::arbitrary(data)?,
        height: fixed(data)?,
    };
    let (mut bev, mut cam) = ([99; ELEMENTS], [99; ELEMENTS]);
    let mut lists = Correspondences::new(intrinsics);
    lists.start(&mut bev, &mut cam).expect("their own sizes");
    let mut map = vec![0; heatmap::MAP.elements() as usize];
    while let Ok(bits) = <[u32; 3]>::arbitrary(data) {
        let point = mounting.place(bits).map(|point| motion.apply(point));
        sweep.push(point, &mut counts);
        lists.push(point, &mut bev, &mut cam);
        let [right, y, speed] = bits;
        let _ = inputs::velocity(speed);
        if let Ok(goal) = inputs::goal([right, y]) {
            heatmap::draw(goal, &mut map).expect("its own size");
        }
        if data.is_empty() {
            break;
        }
    }
    let statistics = sweep.finish();
    lists.finish();
    assert!(statistics.not_finite + statistics.out_of_range + statistics.saturated <= statistics.points);
    assert!(counts.iter().all(|count| (0..=5).contains(count)));
    assert!(bev.iter().chain(&cam).all(|cell| (0..8).contains(cell)));
    Ok(())
}
