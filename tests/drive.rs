//! The drive layer beside the original controllers and planner (golden files) and beside their formulas in f64.

use firmware::drive::{
    Command, Controller, Controls, Driver, Measurements, NetworkOutput, Planner, Point, Position, Reading, Real,
    RouteNode, Status, Step, System,
};
use firmware::waypoint::{self, Waypoint};
use serde_json::Value;
use std::collections::VecDeque;
use tests::agent::{Agent, Decision, Rules, next_node};
use tests::golden;
use tests::random::Random;

/// Of steer and throttle.
const TOLERANCE: f64 = 1e-4;

fn real(value: f64) -> Real {
    Real::from_num(value)
}

fn json(file: &str) -> Value {
    serde_json::from_slice(&std::fs::read(golden::path(file)).expect(file)).expect("JSON")
}

fn number(value: &Value) -> f64 {
    value.as_f64().unwrap_or_else(|| panic!("a number in place of {value}"))
}

fn pair(value: &Value) -> [f64; 2] {
    [number(&value[0]), number(&value[1])]
}

fn list(value: &Value) -> &[Value] {
    value.as_array().unwrap_or_else(|| panic!("a list in place of {value}"))
}

fn position([north, east]: [f64; 2]) -> Position {
    Position { north: real(north), east: real(east) }
}

/// The profile and the rules of a system of `control.json`.
fn system(name: &str) -> (System, Rules) {
    match name {
        "transfuser" => (System::TransFuser, Rules::TRANSFUSER),
        "aim" => (System::Aim, Rules::BASELINES),
        "geometric_fusion" => (System::GeometricFusion, Rules::BASELINES),
        _ => panic!("no profile of {name}"),
    }
}

/// Largest differences of steer and throttle over a sequence.
#[derive(Default)]
struct Worst {
    steer: f64,
    throttle: f64,
}

impl Worst {
    /// Compares one step; a different brake is accepted beside a threshold only.
    fn compare(&mut self, place: &str, found: Controls, expected: Decision) {
        let near = expected.margin <= TOLERANCE;
        assert!(near || (found.brake == Real::ONE) == expected.brake, "{place}: {found:?} instead of {expected:?}");
        self.steer = self.steer.max((found.steer.to_num::<f64>() - expected.steer).abs());
        if !near {
            self.throttle = self.throttle.max((found.throttle.to_num::<f64>() - expected.throttle).abs());
        }
        assert!(self.steer <= TOLERANCE && self.throttle <= TOLERANCE, "{place}: {found:?} instead of {expected:?}");
    }

    fn print(&self, name: &str) {
        println!("{name}: steer within {:.1e}, throttle within {:.1e}", self.steer, self.throttle);
    }
}

#[test]
fn controls_are_those_of_the_original_controllers() {
    let control = json("control.json");
    let systems = control["systems"].as_object().expect("systems");
    assert_eq!(systems.len(), 3);
    for (name, steps) in systems {
        let (system, rules) = system(name);
        let (mut controller, mut agent) = (Controller::new(system.profile().tuning), Agent::new(rules));
        let mut worst = Worst::default();
        assert_eq!(list(steps).len(), 240, "{name}");
        for (index, step) in list(steps).iter().enumerate() {
            let place = format!("{name}, step {index}");
            // The network's y axis points backward.
            let points = [0, 1].map(|k| pair(&step["waypoints"][k])).map(|[x, y]| [x, -y]);
            let speed = number(&step["speed"]);
            let own = agent.step(points, speed);
            let [steer, throttle] = ["steer", "throttle"].map(|key| number(&step[key]));
            let brake = step["brake"].as_bool().expect("brake");
            assert!((own.steer - steer).abs() < 1e-5 && (own.throttle - throttle).abs() < 1e-5, "{place}: {own:?}");
            assert_eq!(own.brake, brake, "{place}: {own:?}");

            let points = points.map(|[right, forward]| Point { right: real(right), forward: real(forward) });
            let found = controller.step(points, real(speed));
            worst.compare(&place, found, Decision { steer, throttle, brake, margin: own.margin });
        }
        worst.print(name);
    }
}

#[test]
fn next_node_command_and_goal_are_those_of_the_original_planner() {
    let golden = json("planner.json");
    let nodes: Vec<([f64; 2], u8)> = list(&golden["route"])
        .iter()
        .zip(list(&golden["commands"]))
        .map(|(place, command)| (pair(place), number(command) as u8))
        .collect();
    let mut planner = Planner::<24>::new(System::TransFuser.profile().horizon);
    let mut driver = Driver::<24>::new(System::LateFusion.profile());
    for &(place, command) in &nodes {
        let node =
            RouteNode { position: position(place), command: Command::from_code(command).expect("a command in 1..=6") };
        planner.push(node).expect("24 nodes fit");
        driver.route().push(node).expect("24 nodes fit");
    }
    let mut agent: VecDeque<_> = nodes.iter().map(|&(place, command)| (place, (place, command))).collect();
    let mut worst: f64 = 0.0;
    assert_eq!(list(&golden["steps"]).len(), 700);
    for (index, step) in list(&golden["steps"]).iter().enumerate() {
        let (own, compass) = (pair(&step["position"]), number(&step["compass"]));
        let expected = (pair(&step["next_node"]), number(&step["command"]) as u8);
        assert_eq!(next_node(&mut agent, own, 4.0, 50.0), expected, "step {index}");

        let node = planner.advance(position(own)).expect("a route");
        assert_eq!((node.position, node.command.code()), (position(expected.0), expected.1), "step {index}");
        assert_eq!(planner.nodes().len(), number(&step["nodes_left"]) as usize, "step {index}");

        let goal = Point::seen_from(position(own), real(compass), node.position);
        let target = pair(&step["target_point"]);
        let mut check = |found: [f64; 2]| {
            worst = worst.max((found[0] - target[0]).abs()).max((found[1] - target[1]).abs());
            assert!(worst <= 1e-3, "step {index}: {found:?} instead of {target:?}");
        };
        check([goal.right.to_num(), -goal.forward.to_num::<f64>()]);
        let measurements = Measurements {
            camera: Reading::now(()),
            lidar: Reading::now(()),
            speed: Reading::now(Real::ZERO),
            position: Reading::now(position(own)),
            compass: Reading::now(real(compass)),
        };
        if let Step::Network(pending) = driver.step(&measurements) {
            check(pending.inputs().goal.map(|x| x.to_num()));
            assert_eq!(pending.inputs().command, node.command, "step {index}");
            pending.finish(Ok(NetworkOutput::Waypoints(&[Waypoint::default(); 4])), 0);
        } else {
            assert_eq!(index, 0, "the network runs every step but the first");
        }
    }
    println!("goals within {:.1e} m", worst);
}

/// Waypoints of a vehicle that stands, rolls, drives or turns, as the network emits them: Q16 codes, y backward.
fn waypoint_codes(random: &mut Random, speed: f64) -> Vec<[i32; 2]> {
    let mut unit = || f64::from(random.signed_unit());
    let stride = (0.5 * speed + 0.4 * unit()).max(0.02 * unit());
    let angle = 0.4 * unit();
    let point = |k: i32| {
        let [right, forward] = [
            f64::from(k) * stride * (angle * f64::from(k)).sin(),
            f64::from(k) * stride * (angle * f64::from(k)).cos(),
        ];
        [right, -forward].map(|x| (x * 65536.0).round() as i32)
    };
    (1..=4).map(point).collect()
}

/// A driver of a system on a route straight to the north, past step 0.
fn started(system: System) -> Driver<2> {
    let mut driver = Driver::new(system.profile());
    driver
        .route()
        .push(RouteNode { position: position([1e4, 0.0]), command: Command::LaneFollow })
        .expect("one node fits");
    assert!(matches!(driver.step(&measured(0.0)), Step::Done(_)));
    driver
}

fn measured(speed: f64) -> Measurements {
    Measurements {
        camera: Reading::now(()),
        lidar: Reading::now(()),
        speed: Reading::now(real(speed)),
        position: Reading::now(Position::default()),
        compass: Reading::now(Real::ZERO),
    }
}

/// Speeds that start, drive, stop, and stand, m/s.
fn speed(random: &mut Random, index: usize) -> f64 {
    let course = (7.0 * (index as f64 / 60.0).sin()).max(0.0);
    (course + 0.02 * f64::from(random.signed_unit())).max(-0.01)
}

#[test]
fn waypoint_systems_drive_as_the_formulas_say() {
    let systems = [
        (System::TransFuser, Rules::TRANSFUSER),
        (System::Aim, Rules::BASELINES),
        (System::LateFusion, Rules::BASELINES),
        (System::GeometricFusion, Rules::BASELINES),
    ];
    for (seed, (system, rules)) in (1..).zip(systems) {
        let mut random = Random::new(seed);
        let (mut driver, mut agent, mut worst) = (started(system), Agent::new(rules), Worst::default());
        let mut points = [[0.0; 2]; 2];
        for index in 1..1000 {
            let place = format!("{system:?}, seed {seed}, step {index}");
            let speed = speed(&mut random, index);
            let output = match driver.step(&measured(speed)) {
                Step::Network(pending) => {
                    let codes = waypoint_codes(&mut random, speed);
                    points = [0, 1].map(|k: usize| [codes[k][0], -codes[k][1]].map(|x| f64::from(x) / 65536.0));
                    let bytes: Vec<u8> = codes.iter().flatten().flat_map(|code| code.to_le_bytes()).collect();
                    let waypoints = waypoint::read(&bytes).expect("four waypoints");
                    pending.finish(Ok(NetworkOutput::Waypoints(&waypoints)), 0)
                }
                Step::Done(output) => output,
            };
            assert_eq!(output.status, Status::Driving, "{place}");
            worst.compare(&place, output.controls, agent.step(points, speed));
        }
        worst.print(&format!("{system:?}"));
    }
}

#[test]
fn lbc_drives_as_the_formulas_say() {
    let seed = 5;
    let mut random = Random::new(seed);
    let (mut driver, mut agent, mut worst) = (started(System::Lbc), Agent::new(Rules::BASELINES), Worst::default());
    for index in 1..1000 {
        let speed = speed(&mut random, index);
        // Below the horizon, which is row 71.5.
        let (nearer, farther) = (100 + random.below(44), 74 + random.below(50));
        let codes = [nearer, farther, 80, 76].map(|row| {
            let column = 128.0 + 40.0 * f64::from(random.signed_unit());
            [(64.0 * column) as i32, (64 * row + random.below(64)) as i32]
        });
        let points = [0, 1].map(|k: usize| {
            let [x, y] = [f64::from(codes[k][0]) / 64.0 / 255.0 * 256.0, f64::from(codes[k][1]) / 64.0 / 143.0 * 144.0];
            let depth = 128.0 * 1.3 / (y - 72.0);
            [(x - 128.0) * depth / 140.8, depth - 0.4]
        });
        let Step::Network(pending) = driver.step(&measured(speed)) else { panic!("the network runs every step") };
        let output = pending.finish(Ok(NetworkOutput::ImagePoints(&codes)), 0);
        assert_eq!(output.status, Status::Driving, "seed {seed}, step {index}: {points:?}");
        worst.compare(&format!("seed {seed}, step {index}"), output.controls, agent.step(points, speed));
    }
    worst.print("LBC");
}

#[test]
fn cilrs_drives_as_the_formulas_say() {
    let seed = 6;
    let mut random = Random::new(seed);
    let mut driver = started(System::Cilrs);
    for index in 1..1000 {
        let codes = [(); 3].map(|()| random.below(1 << 15) as i16);
        let [s0, s1, s2] = codes.map(|code| f64::from(code) / 32768.0);
        let brake = if s2 < 0.05 || 0.75 * s1 > s2 { 0.0 } else { s2 };
        let Step::Network(pending) = driver.step(&measured(3.0)) else { panic!("the network runs every step") };
        let Controls { steer, throttle, brake: found } = pending.finish(Ok(NetworkOutput::Controls(codes)), 0).controls;
        let found: [f64; 3] = [steer, throttle, found].map(|x| x.to_num());
        let expected = [2.0 * s0 - 1.0, 0.75 * s1, brake];
        let close = found.iter().zip(expected).all(|(f, e)| (f - e).abs() < 1e-9);
        assert!(close, "seed {seed}, step {index}: {found:?} instead of {expected:?}");
    }
}

#[test]
fn random_routes_are_followed_as_the_formulas_say() {
    for seed in 1..=200 {
        let mut random = Random::new(seed);
        let mut unit = || f64::from(random.signed_unit());
        let (mut place, mut heading) = ([0.0, 0.0], 0.0_f64);
        let mut nodes = Vec::new();
        for index in 0..30 {
            heading += unit();
            let length = 2.0 + 20.0 * unit().abs().powi(3);
            place = [place[0] + length * heading.cos(), place[1] + length * heading.sin()];
            nodes.push((place, index));
        }
        let horizon = System::Lbc.profile().horizon;
        let mut planner = Planner::<32>::new(horizon);
        for &(place, _) in &nodes {
            planner
                .push(RouteNode { position: position(place), command: Command::LaneFollow })
                .expect("thirty nodes fit");
        }
        let mut agent: VecDeque<_> = nodes.iter().copied().collect();
        for step in 0..300 {
            let at = nodes[step / 10].0;
            let own = [at[0] + 3.0 * unit(), at[1] + 3.0 * unit()];
            let expected = next_node(&mut agent, own, 7.5, 25.0);
            let found = planner.advance(position(own)).expect("a route").position;
            assert_eq!(found, position(nodes[expected as usize].0), "seed {seed}, step {step}");
        }
    }
}
