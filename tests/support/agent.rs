//! The published agents' controller and route planner in f64, written from their formulas: what the fixed-point drive
//! layer must come close to.

use std::collections::VecDeque;

/// Which system's constants and rules the controller has.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Rules {
    /// Wanted speeds below it brake, m/s.
    pub brake_speed: f64,
    /// Speed below which the angle is 0, m/s.
    pub standstill: Option<f64>,
}

impl Rules {
    /// TransFuser.
    pub const TRANSFUSER: Self = Self { brake_speed: 0.1, standstill: Some(0.01) };
    /// AIM, Late Fusion, Geometric Fusion, LBC.
    pub const BASELINES: Self = Self { brake_speed: 0.4, standstill: None };
}

/// Steer, throttle and brake of one step, and how far the step was from braking differently.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Decision {
    /// −1 to 1.
    pub steer: f64,
    /// 0 to 0.75.
    pub throttle: f64,
    /// Pressed or not.
    pub brake: bool,
    /// Distance to the nearer threshold: m/s of the wanted speed, or of the ratio of speeds.
    pub margin: f64,
}

struct Pid {
    gains: [f64; 3],
    errors: VecDeque<f64>,
}

impl Pid {
    fn new(gains: [f64; 3]) -> Self {
        Self { gains, errors: vec![0.0; 40].into() }
    }

    fn step(&mut self, error: f64) -> f64 {
        let change = error - self.errors[39];
        self.errors.pop_front();
        self.errors.push_back(error);
        let mean = self.errors.iter().sum::<f64>() / 40.0;
        let [proportional, integral, derivative] = self.gains;
        proportional * error + integral * mean + derivative * change
    }
}

/// The controller.
pub struct Agent {
    rules: Rules,
    turn: Pid,
    speed: Pid,
}

impl Agent {
    /// Starts from a fresh state.
    pub fn new(rules: Rules) -> Self {
        Self { rules, turn: Pid::new([1.25, 0.75, 0.3]), speed: Pid::new([5.0, 0.5, 1.0]) }
    }

    /// One step from the first two waypoints, `[right, forward]` in meters, and the speed in m/s.
    pub fn step(&mut self, [first, second]: [[f64; 2]; 2], speed: f64) -> Decision {
        let wanted = 2.0 * (first[0] - second[0]).hypot(first[1] - second[1]);
        let brake = wanted < self.rules.brake_speed || speed / wanted > 1.1;
        let aim = [(first[0] + second[0]) / 2.0, (first[1] + second[1]) / 2.0];
        let mut angle = (90.0 - aim[1].atan2(aim[0]).to_degrees()) / 90.0;
        if self.rules.standstill.is_some_and(|limit| speed < limit) {
            angle = 0.0;
        }
        let steer = self.turn.step(angle).clamp(-1.0, 1.0);
        let throttle = self.speed.step((wanted - speed).clamp(0.0, 0.25)).clamp(0.0, 0.75);
        let margin = (wanted - self.rules.brake_speed).abs().min((speed / wanted - 1.1).abs());
        Decision { steer, throttle: if brake { 0.0 } else { throttle }, brake, margin }
    }
}

/// The ground, `[right, forward]` in meters, that a point −1..1 of LBC's front view shows; `None` at the horizon and above.
pub fn ground([x, y]: [f64; 2]) -> Option<[f64; 2]> {
    let (right, down) = (128.0 * x, 72.0 * y);
    let depth = 128.0 * 1.3 / down;
    (down > 0.0).then(|| [right * depth / 140.8, depth - 0.4])
}

/// The node to head for among `route`, of which the passed nodes are dropped; `[north, east]` in meters.
///
/// # Panics
/// The route is empty.
pub fn next_node<T: Copy>(route: &mut VecDeque<([f64; 2], T)>, own: [f64; 2], reach: f64, look_ahead: f64) -> T {
    let distance = |a: [f64; 2], b: [f64; 2]| (a[0] - b[0]).hypot(a[1] - b[1]);
    let (mut passed, mut farthest, mut travel) = (0, f64::NEG_INFINITY, 0.0);
    for index in 1..route.len() {
        if travel > look_ahead {
            break;
        }
        travel += distance(route[index - 1].0, route[index].0);
        let away = distance(route[index].0, own);
        if away <= reach && away > farthest {
            (passed, farthest) = (index, away);
        }
    }
    for _ in 0..passed.min(route.len().saturating_sub(2)) {
        route.pop_front();
    }
    route.get(1).unwrap_or(&route[0]).1
}
