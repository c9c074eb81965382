//! Time of the sensor layer: camera rows in every format, LiDAR points, the heatmap.
//!
//! `cargo bench -p firmware --bench sensors` measures all, with `-- camera` some of them, and with `-- --test` runs
//! each once. Throughput counts rows of the crop for cameras, points for LiDAR, and heatmaps.

use criterion::{BenchmarkId, Criterion, Throughput};
use firmware::image::known_answer::Generator;
use firmware::sensors::camera::{Camera, CameraLayout, PixelFormat, Scale, YuvRange};
use firmware::sensors::correspondences::{Correspondences, ELEMENTS, Intrinsics};
use firmware::sensors::heatmap;
use firmware::sensors::lidar::{Histogram, Motion, Mounting, Sweep};
use firmware::tensor::Shape;
use std::hint::black_box;
use std::time::Duration;

/// Points of a sweep.
const POINTS: u64 = 20_000;
const CROP: u16 = 256;

fn main() {
    let mut criterion = Criterion::default()
        .sample_size(20)
        .warm_up_time(Duration::from_millis(300))
        .measurement_time(Duration::from_secs(2))
        .configure_from_args();
    camera(&mut criterion);
    lidar(&mut criterion);
    heatmap(&mut criterion);
    criterion.final_summary();
}

fn camera(criterion: &mut Criterion) {
    let mut group = criterion.benchmark_group("camera");
    let formats = [
        ("rgb", PixelFormat::Rgb, Scale::Full),
        ("bgr", PixelFormat::Bgr, Scale::Full),
        ("rgba", PixelFormat::Rgba, Scale::Full),
        ("bgra", PixelFormat::Bgra, Scale::Full),
        ("grey", PixelFormat::Grey, Scale::Full),
        ("yuyv", PixelFormat::Yuyv(YuvRange::Limited), Scale::Full),
        ("nv12", PixelFormat::Nv12(YuvRange::Limited), Scale::Full),
        ("bgra half", PixelFormat::Bgra, Scale::Half),
        ("nv12 half", PixelFormat::Nv12(YuvRange::Limited), Scale::Half),
    ];
    for (name, format, scale) in formats {
        for (map, first_channel) in [(Shape::map(CROP, CROP, 3), 0), (Shape::map(CROP, CROP, 10), 3)] {
            let layout = CameraLayout { width: 800, height: 600, format, scale, map, first_channel, frozen_after: 10 };
            // 800 pixels of at most four bytes, and as many rows as a plane of chroma adds.
            let stride = 800 * 4;
            let image: Vec<u8> = (0..900 * u64::from(stride)).map(|i| ((i * 167) >> 3) as u8).collect();
            let mut memory = vec![0; layout.memory_words()];
            let mut camera = Camera::new(layout, &mut memory).expect("a possible layout");
            let mut input = vec![0; map.elements() as usize];
            group.throughput(Throughput::Elements(CROP.into()));
            let id = BenchmarkId::new(name, format!("{} channels", map.channels));
            group.bench_function(id, |bencher| {
                bencher.iter(|| {
                    camera.push_image(black_box(&image), stride, &mut input).expect("a whole image");
                    camera.finish().expect("no row is missing")
                });
            });
        }
    }
    group.finish();
}

/// Points over the area of the histogram, and some outside.
fn cloud() -> Vec<[u32; 3]> {
    let mut random = Generator::new(1);
    let mut coordinate = |low: f32, high: f32| {
        let unit = (random.draw() >> 40) as f32 / (1 << 24) as f32;
        (low + (high - low) * unit).to_bits()
    };
    (0..POINTS).map(|_| [coordinate(-35.0, 35.0), coordinate(-2.0, 34.0), coordinate(-3.0, 3.0)]).collect()
}

fn lidar(criterion: &mut Criterion) {
    let points = cloud();
    let mut group = criterion.benchmark_group("lidar");
    group.throughput(Throughput::Elements(POINTS));
    let mut counts = vec![0; Histogram::TRANSFUSER.shape().elements() as usize];
    for (name, is_moved) in [("histogram", false), ("histogram with motion", true)] {
        group.bench_function(name, |bencher| {
            bencher.iter(|| {
                let mut sweep = Sweep::new(Histogram::TRANSFUSER);
                sweep.start(&mut counts).expect("the histogram's size");
                let motion = black_box(Motion::NONE);
                for &bits in black_box(&points) {
                    let point = Mounting::TRAINED.place(bits);
                    let point = if is_moved { point.map(|point| motion.apply(point)) } else { point };
                    sweep.push(point, &mut counts);
                }
                sweep.finish()
            });
        });
    }
    let (mut bev, mut camera) = ([0; ELEMENTS], [0; ELEMENTS]);
    group.bench_function("correspondences", |bencher| {
        bencher.iter(|| {
            let mut lists = Correspondences::new(Intrinsics::PUBLISHED);
            lists.start(&mut bev, &mut camera).expect("the inputs' sizes");
            for &bits in black_box(&points) {
                lists.push(Mounting::TRAINED.place(bits), &mut bev, &mut camera);
            }
            lists.finish()
        });
    });
    group.finish();
}

fn heatmap(criterion: &mut Criterion) {
    let mut input = vec![0; heatmap::MAP.elements() as usize];
    let mut group = criterion.benchmark_group("heatmap");
    group.throughput(Throughput::Elements(1));
    group.bench_function("draw", |bencher| {
        bencher.iter(|| heatmap::draw(black_box([32_768, -1_310_720]), &mut input));
    });
    group.finish();
}
