//! The driver step by step: what it asks for, what it answers, and that nothing makes it panic.

extern crate std;
use super::*;
use crate::drive::{RouteNode, System};
use proptest::prelude::*;
use std::vec::Vec;

const SYSTEMS: [System; 6] =
    [System::TransFuser, System::Aim, System::LateFusion, System::GeometricFusion, System::Cilrs, System::Lbc];

fn driver(system: System) -> Driver<4> {
    let mut driver = Driver::new(system.profile());
    let position = Position { north: Real::from(40), east: Real::from(3) };
    driver.route().push(RouteNode { position, command: Command::Straight }).unwrap();
    driver
}

/// All there, 3 m/s to the north.
fn healthy() -> Measurements {
    Measurements {
        camera: Reading::now(()),
        lidar: Reading::now(()),
        speed: Reading::now(Real::from(3)),
        position: Reading::now(Position::default()),
        compass: Reading::now(Real::ZERO),
    }
}

/// Two meters between waypoints, a little to the right.
fn waypoints() -> [Waypoint; 4] {
    [1, 2, 3, 4].map(|k| Waypoint { right: I16F16::from_num(0.1) * k, forward: I16F16::from_num(2) * k })
}

/// One step, and whether the network was asked.
fn step(driver: &mut Driver<4>, measurements: &Measurements) -> (Output, bool) {
    match driver.step(measurements) {
        Step::Network(pending) => (pending.finish(Ok(NetworkOutput::Waypoints(&waypoints())), 0), true),
        Step::Done(output) => (output, false),
    }
}

/// Steps 0 to `count` − 1 without a fault.
fn warm(system: System, count: usize) -> Driver<4> {
    let mut driver = driver(system);
    for _ in 0..count {
        step(&mut driver, &healthy());
    }
    driver
}

/// Status of the next step.
fn status(driver: &mut Driver<4>, measurements: &Measurements) -> Status {
    step(driver, measurements).0.status
}

#[test]
fn the_first_step_gives_zero_controls_and_asks_no_network() {
    for system in SYSTEMS {
        let (output, asked) = step(&mut driver(system), &healthy());
        assert_eq!(output, Output { controls: Controls::ZERO, status: Status::Filling }, "{system:?}");
        assert!(!asked, "{system:?}");
    }
}

#[test]
fn transfuser_drives_on_with_the_same_waypoints_on_odd_steps() {
    let mut driver = driver(System::TransFuser);
    let mut reference = Controller::new(System::TransFuser.profile().tuning);
    let [first, second, ..] = waypoints().map(Point::from);
    for count in 0..40 {
        let (output, asked) = step(&mut driver, &healthy());
        assert_eq!(asked, count > 0 && (count <= 4 || count % 2 == 0), "step {count}");
        if count > 0 {
            let controls = reference.step([first, second], Real::from(3));
            assert_eq!(output, Output { controls, status: Status::Driving }, "step {count}");
        }
    }
    assert_eq!(driver.counters().network_runs, 4 + 17);
}

#[test]
fn inputs_of_the_network_are_goal_velocity_and_command() {
    let mut driver = warm(System::TransFuser, 1);
    let Step::Network(pending) = driver.step(&healthy()) else { panic!("step 1 runs the network") };
    let inputs = *pending.inputs();
    assert_eq!(inputs.goal, [I16F16::from_num(3), I16F16::from_num(-40)]);
    assert_eq!((inputs.velocity, inputs.command), (I8F8::from_num(3), Command::Straight));
    assert_eq!(inputs.goal_bytes(), [0, 0, 3, 0, 0, 0, 216, 255]);
    assert_eq!((inputs.velocity_bytes(), inputs.command_bytes()), ([0, 3], [3]));
    pending.finish(Ok(NetworkOutput::Waypoints(&waypoints())), 0);
}

#[test]
fn cilrs_drives_by_its_own_outputs() {
    let mut driver = warm(System::Cilrs, 1);
    let Step::Network(pending) = driver.step(&healthy()) else { panic!("step 1 runs the network") };
    let Output { controls, status } = pending.finish(Ok(NetworkOutput::Controls([1 << 14, 1 << 14, 1 << 12])), 0);
    // Throttle 0.375 beats brake 0.125.
    assert_eq!(controls, Controls { throttle: Real::lit("0.375"), ..Controls::ZERO });
    assert_eq!(status, Status::Driving);
}

#[test]
fn lbc_drives_by_the_ground_under_its_image_points() {
    let mut driver = warm(System::Lbc, 1);
    let Step::Network(pending) = driver.step(&healthy()) else { panic!("step 1 runs the network") };
    // On the center line, 51.36 and 36 pixels below the horizon: 1.38 m between their ground points.
    let output = pending.finish(Ok(NetworkOutput::ImagePoints(&[[8160, 7840], [8160, 6864], [0, 0], [0, 0]])), 0);
    assert_eq!(output.status, Status::Driving);
    assert!(output.controls.steer.abs() < Real::from_num(0.001), "{output:?}");
    // 2.76 m/s are wanted, 3 m/s driven: too fast for the throttle, within the tenth that does not brake.
    assert_eq!((output.controls.throttle, output.controls.brake), (Real::ZERO, Real::ZERO));
}

#[test]
fn every_sensor_fault_has_its_status() {
    let far = Position { north: Real::from(-32_001), east: Real::ZERO };
    let old = |ms| Reading::Value { value: (), age_ms: ms };
    let cases = [
        (Measurements { camera: Reading::Missing, ..healthy() }, Fault::Missing(Sensor::Camera)),
        (Measurements { camera: old(101), ..healthy() }, Fault::Stale(Sensor::Camera)),
        (Measurements { camera: Reading::Frozen, ..healthy() }, Fault::Frozen(Sensor::Camera)),
        (Measurements { lidar: old(500), ..healthy() }, Fault::Stale(Sensor::Lidar)),
        (Measurements { lidar: Reading::Missing, ..healthy() }, Fault::Missing(Sensor::Lidar)),
        (Measurements { speed: Reading::NotANumber, ..healthy() }, Fault::Invalid(Sensor::Speed)),
        (Measurements { speed: Reading::now(Real::from(-101)), ..healthy() }, Fault::Invalid(Sensor::Speed)),
        (Measurements { position: Reading::now(far), ..healthy() }, Fault::Invalid(Sensor::Position)),
        (Measurements { position: Reading::Missing, ..healthy() }, Fault::Missing(Sensor::Position)),
        (Measurements { compass: Reading::Missing, ..healthy() }, Fault::Missing(Sensor::Compass)),
    ];
    for (measurements, fault) in cases {
        let mut driver = warm(System::LateFusion, 5);
        assert_eq!(status(&mut driver, &measurements), Status::Fault(fault));
    }
    let fresh_enough = Measurements { camera: old(100), lidar: old(100), ..healthy() };
    assert_eq!(status(&mut warm(System::LateFusion, 5), &fresh_enough), Status::Driving);
}

#[test]
fn sensors_that_a_system_does_not_use_may_be_missing() {
    let no_lidar = Measurements { lidar: Reading::Missing, ..healthy() };
    assert_eq!(status(&mut warm(System::Aim, 5), &no_lidar), Status::Driving);
    let camera_only = Measurements { compass: Reading::NotANumber, ..no_lidar };
    let mut driver = warm(System::Cilrs, 5);
    assert!(matches!(driver.step(&camera_only), Step::Network(_)));
}

#[test]
fn only_transfuser_has_a_heading_for_a_compass_that_is_not_a_number() {
    let blind = Measurements { compass: Reading::NotANumber, ..healthy() };
    let mut driver = warm(System::TransFuser, 6);
    let Step::Network(pending) = driver.step(&blind) else { panic!("step 6 runs the network") };
    assert_eq!(pending.inputs().goal, [I16F16::from_num(3), I16F16::from_num(-40)], "as under heading 0");
    pending.finish(Ok(NetworkOutput::Waypoints(&waypoints())), 0);
    assert_eq!(driver.counters().substituted_headings, 1);
    for system in [System::Aim, System::LateFusion, System::GeometricFusion, System::Lbc] {
        assert_eq!(status(&mut warm(system, 5), &blind), Status::Fault(Fault::Invalid(Sensor::Compass)), "{system:?}");
    }
}

#[test]
fn without_a_route_the_vehicle_stays() {
    let mut driver = Driver::<4>::new(System::TransFuser.profile());
    for _ in 0..5 {
        let (output, asked) = step(&mut driver, &healthy());
        assert_eq!(output, Output { controls: Controls::stop(Real::ZERO), status: Status::Fault(Fault::NoRoute) });
        assert!(!asked);
    }
    assert_eq!(driver.counters().no_route, 5);
}

#[test]
fn the_safe_state_holds_the_steering_and_ends_after_ten_good_steps_on_one_of_the_network() {
    let mut driver = warm(System::TransFuser, 21);
    let (before, _) = step(&mut driver, &healthy());
    let blind = Measurements { camera: Reading::Missing, ..healthy() };
    let stop = Controls::stop(before.controls.steer);
    let (output, _) = step(&mut driver, &blind);
    assert_eq!(output, Output { controls: stop, status: Status::Fault(Fault::Missing(Sensor::Camera)) });
    // The fault was on step 22. Ten good steps end with 32; 33 is odd, and its sweep is not the network's.
    for count in 23..=33 {
        let (output, asked) = step(&mut driver, &healthy());
        assert_eq!(output, Output { controls: stop, status: Status::Recovering }, "step {count}");
        assert_eq!(asked, count % 2 == 0, "step {count}");
    }
    let controls = Controller::new(System::TransFuser.profile().tuning)
        .step([0, 1].map(|k| Point::from(waypoints()[k])), Real::from(3));
    let (output, _) = step(&mut driver, &healthy());
    assert_eq!(output, Output { controls, status: Status::Driving }, "as a fresh controller");
    assert_eq!((driver.counters().safe_steps, driver.counters().missing), (12, 1));
}

#[test]
fn a_fault_during_recovery_starts_it_anew() {
    let mut driver = warm(System::Aim, 5);
    let blind = Measurements { camera: Reading::Missing, ..healthy() };
    status(&mut driver, &blind);
    for _ in 0..9 {
        assert_eq!(status(&mut driver, &healthy()), Status::Recovering);
    }
    status(&mut driver, &blind);
    let states: Vec<Status> = (0..11).map(|_| status(&mut driver, &healthy())).collect();
    assert_eq!(states.iter().filter(|&&s| s == Status::Recovering).count(), 10);
    assert_eq!(states.last(), Some(&Status::Driving));
}

#[test]
fn a_network_that_gives_nothing_stops_the_vehicle() {
    for (error, fault) in [(NetworkError::Overrun, Fault::NetworkOverrun), (NetworkError::Failed, Fault::NetworkFailed)]
    {
        let mut driver = warm(System::Aim, 5);
        let Step::Network(pending) = driver.step(&healthy()) else { panic!("the network runs every step") };
        assert_eq!(pending.finish(Err(error), 0).status, Status::Fault(fault));
    }
}

#[test]
fn a_step_that_was_not_finished_is_an_overrun() {
    let mut driver = warm(System::Aim, 5);
    let Step::Network(pending) = driver.step(&healthy()) else { panic!("the network runs every step") };
    drop(pending);
    assert_eq!(status(&mut driver, &healthy()), Status::Fault(Fault::NetworkOverrun));
    assert_eq!(status(&mut driver, &healthy()), Status::Recovering);
    assert_eq!(driver.counters().overruns, 1);
}

#[test]
fn an_answer_that_comes_too_late_stops_the_vehicle() {
    for (elapsed_ms, expected) in [(50, Status::Driving), (51, Status::Fault(Fault::NetworkOverrun))] {
        let mut driver = warm(System::Aim, 5);
        let Step::Network(pending) = driver.step(&healthy()) else { panic!("the network runs every step") };
        let output = pending.finish(Ok(NetworkOutput::Waypoints(&waypoints())), elapsed_ms);
        assert_eq!(output.status, expected, "{elapsed_ms} ms");
    }
}

#[test]
fn a_skipped_tick_keeps_the_network_on_even_steps() {
    // Steps 0 to 6; then tick 7 (odd) or ticks 7 and 8 pass without one.
    for skipped in [1, 2] {
        let mut driver = warm(System::TransFuser, 7);
        (0..skipped).for_each(|_| driver.skip());
        for count in 7 + skipped..30 {
            let (output, asked) = step(&mut driver, &healthy());
            assert_eq!(asked, count % 2 == 0, "{skipped} skipped, step {count}");
            // Without the network's turn on tick 8 there is nothing to drive by on step 9.
            let expected = if (skipped, count) == (2, 9) { Status::Recovering } else { Status::Driving };
            assert_eq!(output.status, expected, "{skipped} skipped, step {count}");
        }
        assert_eq!(driver.counters().skipped, skipped);
    }
}

#[test]
fn outputs_that_are_no_plan_stop_the_vehicle() {
    let far = [Waypoint { right: I16F16::from_num(128.5), forward: I16F16::ZERO }; 4];
    let outputs = [
        (System::Aim, NetworkOutput::Waypoints(&[])),
        (System::Aim, NetworkOutput::Waypoints(&far[..1])),
        (System::Aim, NetworkOutput::Waypoints(&far)),
        (System::Aim, NetworkOutput::Controls([0; 3])),
        (System::Cilrs, NetworkOutput::ImagePoints(&[[0; 2]; 4])),
        (System::Lbc, NetworkOutput::ImagePoints(&[[0; 2]; 1])),
        (System::Lbc, NetworkOutput::ImagePoints(&[[8160, 4000]; 4])),
    ];
    for (system, output) in outputs {
        let mut driver = driver(system);
        step(&mut driver, &healthy());
        let Step::Network(pending) = driver.step(&healthy()) else { panic!("the network runs every step") };
        assert_eq!(pending.finish(Ok(output), 0).status, Status::Fault(Fault::InvalidOutput), "{system:?}, {output:?}");
    }
}

/// The first step that drives has nothing to remember either.
#[test]
fn controls_of_one_answer_are_those_of_the_first_driven_step() {
    let points = [[8160, 7000], [9000, 6000]];
    let answers = [
        (System::TransFuser, NetworkOutput::Waypoints(&waypoints())),
        (System::Aim, NetworkOutput::Waypoints(&waypoints()[..2])),
        (System::Cilrs, NetworkOutput::Controls([20_000, 9_000, 1_000])),
        (System::Lbc, NetworkOutput::ImagePoints(&points)),
    ];
    for (system, answer) in answers {
        let mut driver = driver(system);
        step(&mut driver, &healthy());
        let Step::Network(pending) = driver.step(&healthy()) else { panic!("the network runs") };
        let driven = pending.finish(Ok(answer), 0);
        assert_eq!(driven.status, Status::Driving, "{system:?}");
        assert_eq!(system.profile().controls(answer, Real::from(3)), Ok(driven.controls), "{system:?}");
    }
    let aim = System::Aim.profile();
    let answer = NetworkOutput::Waypoints(&waypoints()[..1]);
    assert_eq!(aim.controls(answer, Real::ONE), Err(Fault::InvalidOutput));
    let answer = NetworkOutput::Controls([0; 3]);
    assert_eq!(aim.controls(answer, Real::from(101)), Err(Fault::Invalid(Sensor::Speed)));
}

#[test]
fn every_status_has_a_code_of_its_own() {
    let sensors = [Sensor::Camera, Sensor::Lidar, Sensor::Speed, Sensor::Position, Sensor::Compass];
    let faults =
        sensors.into_iter().flat_map(|s| [Fault::Missing(s), Fault::Stale(s), Fault::Invalid(s), Fault::Frozen(s)]);
    let others = [Fault::NoRoute, Fault::NetworkOverrun, Fault::NetworkFailed, Fault::InvalidOutput];
    let plain = [Status::Driving, Status::Filling, Status::Recovering];
    let all: Vec<Status> = plain.into_iter().chain(faults.chain(others).map(Status::Fault)).collect();
    let mut codes: Vec<u8> = all.iter().map(|status| status.code()).collect();
    codes.sort_unstable();
    codes.dedup();
    assert_eq!(codes.len(), all.len());
}

fn any_real() -> impl Strategy<Value = Real> {
    let ends = [Real::MIN, Real::MAX, Real::ZERO, Real::DELTA, -Real::DELTA];
    prop_oneof![
        (any::<i64>(), 0..64_u32).prop_map(|(bits, shift)| Real::from_bits(bits >> shift)),
        proptest::sample::select(ends.to_vec()),
    ]
}

fn any_reading<T: core::fmt::Debug + Clone>(value: impl Strategy<Value = T>) -> impl Strategy<Value = Reading<T>> {
    (value, 0..400_u16, 0..8_u8).prop_map(|(value, age_ms, kind)| match kind {
        0 => Reading::Missing,
        1 => Reading::NotANumber,
        2 => Reading::Value { value, age_ms },
        3 => Reading::Frozen,
        _ => Reading::now(value),
    })
}

fn any_position() -> impl Strategy<Value = Position> {
    (any_real(), any_real()).prop_map(|(north, east)| Position { north, east })
}

prop_compose! {
    fn any_measurements()(
        camera in any_reading(Just(())), lidar in any_reading(Just(())), speed in any_reading(any_real()),
        position in any_reading(any_position()), compass in any_reading(any_real()),
    ) -> Measurements {
        Measurements { camera, lidar, speed, position, compass }
    }
}

proptest! {
    #[test]
    fn whatever_comes_the_controls_stay_within_their_ranges(
        system in 0..6_usize,
        nodes in proptest::collection::vec((any_position(), 1..=6_u8), 0..5),
        steps in proptest::collection::vec((any_measurements(), any::<[[i32; 2]; 4]>(), 0..32_u32, 0..9_u8), 1..80),
    ) {
        let mut driver = Driver::<4>::new(SYSTEMS[system].profile());
        for (position, code) in nodes {
            let full = driver.route().nodes().len() == 4;
            let node = RouteNode { position, command: Command::from_code(code).unwrap() };
            prop_assert_eq!(driver.route().push(node).is_err(), full);
        }
        for (measurements, codes, shift, kind) in &steps {
            // Half the steps are healthy, so that the controller is reached.
            let measurements = if kind % 2 == 0 { healthy() } else { *measurements };
            let output = match driver.step(&measurements) {
                Step::Done(output) => output,
                Step::Network(pending) => {
                    let codes = codes.map(|pair| pair.map(|code| code >> shift));
                    let points = codes.map(|[right, forward]| Waypoint {
                        right: I16F16::from_bits(right),
                        forward: I16F16::from_bits(forward),
                    });
                    let own = match SYSTEMS[system] {
                        System::Cilrs => NetworkOutput::Controls([0, 1, 2].map(|k: usize| codes[k][0] as i16)),
                        System::Lbc => NetworkOutput::ImagePoints(&codes),
                        _ => NetworkOutput::Waypoints(&points),
                    };
                    match kind {
                        1 => pending.finish(Err(NetworkError::Overrun), 0),
                        3 => continue,
                        5 => pending.finish(Ok(NetworkOutput::Waypoints(&points[..1])), 0),
                        _ => pending.finish(Ok(own), 0),
                    }
                }
            };
            let Controls { steer, throttle, brake } = output.controls;
            prop_assert!((-Real::ONE..=Real::ONE).contains(&steer), "steer {}", steer);
            prop_assert!((Real::ZERO..=Real::lit("0.75")).contains(&throttle), "throttle {}", throttle);
            prop_assert!((Real::ZERO..=Real::ONE).contains(&brake), "brake {}", brake);
            if matches!(output.status, Status::Fault(_) | Status::Recovering) {
                prop_assert_eq!((throttle, brake), (Real::ZERO, Real::ONE));
            }
        }
        let counters = driver.counters();
        prop_assert_eq!(counters.steps as usize, steps.len());
        prop_assert!(counters.network_runs < counters.steps.max(1));
    }
}
