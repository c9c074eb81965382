//! The rules that end a route. None of them costs a factor: what is not driven is lost, no more.

use super::log::EgoState;
use schemars::JsonSchema;
use serde::Serialize;

/// Farther than this from the route it is lost, m.
pub const DEVIATION_M: f64 = 30.0;
/// Farther than this from the route the way driven counts as off route, m; …
pub const OFF_ROUTE_M: f64 = 15.0;
/// … of that a route bears this part of its length, percent.
pub const OFF_ROUTE_PERCENT: f64 = 30.0;
/// Slower than this a car stands, m/s; …
pub const STANDING_MPS: f64 = 0.1;
/// … and is blocked when it has stood for so long, s.
pub const BLOCKED_S: f64 = 180.0;
/// Time for a route: so much per meter of its length, s/m, …
pub const TIMEOUT_S_PER_M: f64 = 0.8;
/// … and so much to start, s.
pub const TIMEOUT_START_S: f64 = 5.0;

/// Why a route ended.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, JsonSchema)]
#[serde(rename_all = "snake_case")]
pub enum Ending {
    /// More than 99 % of the route was driven and its end was nearer than 10 m: RC is 100 %.
    Completed,
    /// More than 30 m from the route, or more than 30 % of its length driven more than 15 m from it.
    RouteDeviation,
    /// Slower than 0.1 m/s for 180 s.
    Blocked,
    /// More than 0.8 s per meter of the route, and 5 s.
    Timeout,
    /// No rule: the log ends on the way.
    LogEnds,
}

impl Ending {
    /// In words.
    pub const fn words(self) -> &'static str {
        match self {
            Self::Completed => "completed",
            Self::RouteDeviation => "route deviation",
            Self::Blocked => "blocked",
            Self::Timeout => "timeout",
            Self::LogEnds => "log ends",
        }
    }
}

/// The rules on their way along a route.
#[derive(Clone, Debug)]
pub struct Rules {
    length_m: f64,
    start_s: Option<f64>,
    off_route_m: f64,
    standing_since_s: Option<f64>,
}

impl Rules {
    /// Rules for a route of this length.
    pub fn new(length_m: f64) -> Self {
        Self { length_m, start_s: None, off_route_m: 0.0, standing_since_s: None }
    }

    /// The rule that ends the route at this state, if one does; states come in order. `step_m` is the way from the
    /// state before, `distance_m` the distance from the route, `complete` whether the end is reached, which comes
    /// before all rules.
    pub fn ending(&mut self, state: &EgoState, step_m: f64, distance_m: f64, complete: bool) -> Option<Ending> {
        let start_s = *self.start_s.get_or_insert(state.time_s);
        if distance_m > OFF_ROUTE_M {
            self.off_route_m += step_m;
        }
        if state.speed_mps.abs() < STANDING_MPS {
            self.standing_since_s.get_or_insert(state.time_s);
        } else {
            self.standing_since_s = None;
        }
        let deviates = distance_m > DEVIATION_M || self.off_route_m > OFF_ROUTE_PERCENT / 100.0 * self.length_m;
        let blocked = self.standing_since_s.is_some_and(|since| state.time_s - since >= BLOCKED_S);
        let late = state.time_s - start_s > TIMEOUT_S_PER_M * self.length_m + TIMEOUT_START_S;
        let rules = [
            (complete, Ending::Completed),
            (deviates, Ending::RouteDeviation),
            (blocked, Ending::Blocked),
            (late, Ending::Timeout),
        ];
        rules.into_iter().find_map(|(holds, ending)| holds.then_some(ending))
    }
}
