//! Links only if no panic is reachable in what drives: parse, check, inference, self-test, waypoints, every sensor, the
//! driver of all systems, the computer that decodes what comes over a line, and the update of the image.
//!
//! The program is not meant to run. Each `twin-*` feature adds one panic of a usual kind at the end of a chain and must
//! not link: so it shows, too, that the optimizer did not see the end of the chain as unreachable.
#![no_std]
#![no_main]

mod computer;
mod update;

use core::hint::black_box;
use firmware::drive::{Driver, GpsPlane, Measurements, NetworkOutput, Output, Real, RouteNode, Status, Step, System};
use firmware::sensors::camera::{Camera, CameraLayout};
use firmware::sensors::correspondences::{Correspondences, Intrinsics};
use firmware::sensors::lidar::{Heading, Histogram, Motion, Mounting, Pose, Sweep};
use firmware::sensors::{heatmap, inputs};
use firmware::waypoint::Waypoint;
use fixed::types::I16F16;
use proof::infer;
use update::Flash;

/// What a boot loader would call. Nothing is known of the image, the arena and the inputs.
#[unsafe(no_mangle)]
pub extern "C" fn start() -> bool {
    let [mut fast, mut main] = [[0; 64]; 2];
    infer(black_box(&[]), [black_box(&mut fast), black_box(&mut main)], black_box(&[])).is_some()
        & sense(black_box(&Raw::default())).is_some()
        & drive(black_box(&Trip::default()))
        & computer::compute(black_box(&[]), [black_box(&mut fast), black_box(&mut main)])
        & update::receive(black_box(Flash::default()), black_box(&[])).is_some()
}

/// What sensors send, none of it trusted.
#[derive(Default)]
struct Raw<'a> {
    layout: Option<CameraLayout>,
    memory: [u16; 8],
    bytes: &'a [u8],
    stride: u32,
    points: &'a [[u32; 3]],
    poses: Option<(Mounting, [Pose; 2])>,
    intrinsics: Option<Intrinsics>,
    numbers: [u32; 3],
    split: I16F16,
    compass: Real,
}

fn sense(raw: &Raw<'_>) -> Option<()> {
    let (mut memory, mut map, mut other) = (raw.memory, [0; 64], [0; 64]);
    let mut camera = Camera::new(raw.layout?, black_box(&mut memory)).ok()?;
    let camera = black_box(&mut camera);
    black_box(camera.push(raw.stride, raw.numbers[0], raw.bytes, black_box(&mut map))).ok()?;
    black_box(camera.push_image(raw.bytes, raw.stride, black_box(&mut map))).ok()?;
    black_box(camera.finish()).ok()?;
    camera.clear();

    let (mounting, [capture, current]) = raw.poses?;
    let current = Pose { heading: Heading::from_compass(raw.compass), ..current };
    let motion = Motion::between(&capture, &current);
    let points = || raw.points.iter().map(|&bits| mounting.place(bits).map(|point| motion.apply(point)));
    let histogram = Histogram::new(raw.layout?.map, raw.split).ok()?;
    for histogram in [Histogram::TRANSFUSER, Histogram::BASELINES, histogram] {
        let mut sweep = Sweep::new(histogram);
        black_box(&mut sweep).start(black_box(&mut map)).ok()?;
        points().for_each(|point| sweep.push(point, black_box(&mut map)));
        black_box(sweep.finish());
    }
    let mut cells = Correspondences::new(raw.intrinsics?);
    black_box(&mut cells).start(black_box(&mut map), black_box(&mut other)).ok()?;
    points().for_each(|point| cells.push(point, black_box(&mut map), black_box(&mut other)));
    black_box(cells.finish());

    let [a, b, c] = raw.numbers;
    heatmap::draw(inputs::goal([a, b]).ok()?, black_box(&mut map)).ok()?;
    black_box((inputs::velocity(c).ok()?, inputs::command(c as u8).ok()?));
    if cfg!(feature = "twin-division") {
        black_box(100 / map[0]);
    }
    Some(())
}

/// What a driver is given, none of it trusted.
#[derive(Default)]
struct Trip<'a> {
    measurements: Option<Measurements>,
    gps: [i64; 2],
    nodes: &'a [RouteNode],
    waypoints: &'a [Waypoint],
    points: &'a [[i32; 2]],
    controls: [i16; 3],
}

fn drive(trip: &Trip<'_>) -> bool {
    let systems =
        [System::TransFuser, System::Aim, System::LateFusion, System::GeometricFusion, System::Cilrs, System::Lbc];
    systems.into_iter().all(|system| drive_by(trip, system).is_some())
}

fn drive_by(trip: &Trip<'_>, system: System) -> Option<()> {
    let mut driver: Driver = Driver::new(black_box(system.profile()));
    let [latitude, longitude] = trip.gps;
    black_box(GpsPlane::CARLA.position(latitude, longitude));
    for node in trip.nodes {
        driver.route().push(*node).ok()?;
    }
    driver.skip();
    for answer in [
        NetworkOutput::Waypoints(trip.waypoints),
        NetworkOutput::ImagePoints(trip.points),
        NetworkOutput::Controls(trip.controls),
    ] {
        // As after any number of steps.
        let driver = black_box(&mut driver);
        let Output { controls, status } = match driver.step(trip.measurements.as_ref()?) {
            Step::Network(pending) => pending.finish(Ok(answer), black_box(0)),
            Step::Done(output) => output,
        };
        black_box(controls);
        if cfg!(feature = "twin-unwrap") && status == Status::Driving {
            black_box(trip.waypoints.first().unwrap());
        }
    }
    Some(())
}
