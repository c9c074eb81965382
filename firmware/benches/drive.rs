//! Time of the drive layer: its parts, and a whole step of the driver without the network.
//!
//! `cargo bench -p firmware --bench drive` measures all; with `-- --test` each runs once.

use criterion::Criterion;
use firmware::drive::trigonometry::{atan2, sin_cos};
use firmware::drive::{
    Command, Controller, Driver, Measurements, NetworkOutput, Planner, Point, Position, Reading, Real, RouteNode, Step,
    System,
};
use firmware::waypoint::Waypoint;
use std::hint::black_box;
use std::time::Duration;

fn main() {
    let mut criterion = Criterion::default()
        .sample_size(50)
        .warm_up_time(Duration::from_millis(300))
        .measurement_time(Duration::from_secs(1))
        .configure_from_args();
    parts(&mut criterion);
    driver(&mut criterion);
    criterion.final_summary();
}

/// Nodes to the north, three meters apart: 17 of them lie within the look-ahead.
fn nodes() -> impl Iterator<Item = RouteNode> {
    let position = |k: i32| Position { north: Real::from(3 * k), east: Real::ZERO };
    (0..128).map(move |k| RouteNode { position: position(k), command: Command::LaneFollow })
}

fn parts(criterion: &mut Criterion) {
    let (right, forward, speed) = (Real::lit("0.3"), Real::lit("2.2"), Real::lit("4.1"));
    criterion.bench_function("sin_cos", |bench| bench.iter(|| sin_cos(black_box(speed))));
    criterion.bench_function("atan2", |bench| bench.iter(|| atan2(black_box(forward), black_box(right))));

    let mut planner = Planner::<128>::new(System::TransFuser.profile().horizon);
    for node in nodes() {
        planner.push(node).expect("128 nodes fit");
    }
    // Twenty meters beside the route nothing is reached, so every call walks the whole look-ahead.
    let own = Position { north: Real::ZERO, east: Real::from(20) };
    criterion.bench_function("planner", |bench| bench.iter(|| planner.advance(black_box(own))));

    let mut controller = Controller::new(System::TransFuser.profile().tuning);
    let points = [1, 2].map(|k| Point { right: right * k, forward: forward * k });
    criterion.bench_function("controller", |bench| bench.iter(|| controller.step(black_box(points), speed)));
}

fn driver(criterion: &mut Criterion) {
    let mut driver: Driver = Driver::new(System::LateFusion.profile());
    for node in nodes() {
        driver.route().push(node).expect("128 nodes fit");
    }
    let measurements = Measurements {
        camera: Reading::now(()),
        lidar: Reading::now(()),
        speed: Reading::now(Real::from(4)),
        position: Reading::now(Position { north: Real::ZERO, east: Real::from(20) }),
        compass: Reading::now(Real::lit("0.3")),
    };
    let waypoints = [Waypoint::default(); 4];
    criterion.bench_function("driver step", |bench| {
        bench.iter(|| match driver.step(black_box(&measurements)) {
            Step::Network(pending) => pending.finish(Ok(NetworkOutput::Waypoints(&waypoints)), 0),
            Step::Done(output) => output,
        });
    });
}
