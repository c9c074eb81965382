//! How well a car drove: the driving score of the CARLA leaderboard, from logs of whole routes.
//!
//! A closed loop writes a [`RouteLog`] per route: where the route goes, where the car was, what it hit or ran over.
//! From that alone a route gets
//! * **route completion** RC, 0..=100 %: length of the route up to the last waypoint passed ([`progress`])
//! * **infraction penalty** P, 0..=1: a factor per event ([`penalty`])
//! * **driving score** `DS = max(RC·P, 0)`
//! * an [`Ending`]: complete, or the rule that ended it ([`ending`]); what the log holds after that does not count
//!
//! The means of RC, P and DS over routes are plain averages: every route counts the same, however long it is, so the
//! mean DS is not the product of the other two.

use model_compiler::error::Result;
use progress::Progress;
use schemars::JsonSchema;
use serde::Serialize;
use std::path::PathBuf;

pub mod ending;
pub mod log;
pub mod penalty;
pub mod progress;

pub use ending::Ending;
pub use log::{EgoState, Event, EventKind, RouteLog};
pub use penalty::Infractions;

/// Version of the documents.
pub const SCHEMA: u32 = 1;

/// What one route was worth.
#[derive(Clone, Debug, PartialEq, Serialize, JsonSchema)]
pub struct RouteScore {
    /// Route.
    pub route: String,
    /// `max(RC·P, 0)`, 0..=100.
    pub driving_score: f64,
    /// RC: part of the route that was driven, percent.
    pub route_completion_percent: f64,
    /// P: product of the factors of all infractions.
    pub infraction_penalty: f64,
    /// The infractions that count.
    pub infractions: Infractions,
    /// Part of the way driven outside the lanes of the route, percent.
    pub outside_lanes_percent: f64,
    /// Why the route ended.
    pub ending: Ending,
    /// From the first state to the end, s.
    pub duration_s: f64,
    /// Way driven until the end, m.
    pub driven_m: f64,
    /// Length of the route, m.
    pub length_m: f64,
    /// Events after the end, which do not count.
    pub events_after_end: usize,
}

/// Averages over routes.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, JsonSchema)]
pub struct MeanScore {
    /// Mean DS, 0..=100.
    pub driving_score: f64,
    /// Mean RC, percent.
    pub route_completion_percent: f64,
    /// Mean P.
    pub infraction_penalty: f64,
}

/// The routes of an evaluation.
#[derive(Clone, Debug, PartialEq, Serialize, JsonSchema)]
pub struct Score {
    /// Version of this structure.
    pub schema: u32,
    /// Plain averages over the routes.
    pub mean: MeanScore,
    /// Every route, in order.
    pub routes: Vec<RouteScore>,
}

/// Reads and scores logs, one route each; a route that was driven several times counts as often.
///
/// # Errors
/// A log cannot be read or holds no drive along a route; see [`RouteLog::read`].
pub fn score(logs: &[PathBuf]) -> Result<Score> {
    let routes = logs.iter().map(|path| Ok(RouteScore::of(&RouteLog::read(path)?)));
    Ok(Score::of(routes.collect::<Result<_>>()?))
}

impl Score {
    /// Averages routes.
    pub fn of(routes: Vec<RouteScore>) -> Self {
        let mean = |value: fn(&RouteScore) -> f64| routes.iter().map(value).sum::<f64>() / routes.len().max(1) as f64;
        let mean = MeanScore {
            driving_score: mean(|route| route.driving_score),
            route_completion_percent: mean(|route| route.route_completion_percent),
            infraction_penalty: mean(|route| route.infraction_penalty),
        };
        Self { schema: SCHEMA, mean, routes }
    }
}

impl RouteScore {
    /// Follows the car along a log until the route ends.
    ///
    /// # Panics
    /// The log holds no state of the car or no waypoint; [`RouteLog::check`] refuses such a log.
    pub fn of(log: &RouteLog) -> Self {
        let mut progress = Progress::new(&log.waypoints);
        let mut rules = ending::Rules::new(progress.length_m());
        let (mut driven_m, mut outside_m) = (0.0, 0.0);
        let mut ending = Ending::LogEnds;
        let mut end_s = log.ego[0].time_s;
        for (index, state) in log.ego.iter().enumerate() {
            let step_m =
                index.checked_sub(1).map_or(0.0, |last| progress::distance(log.ego[last].position_m, state.position_m));
            driven_m += step_m;
            if state.outside_lanes {
                outside_m += step_m;
            }
            progress.advance(state.position_m);
            end_s = state.time_s;
            let off_route_m = progress.distance_from_route(state.position_m);
            if let Some(end) = rules.ending(state, step_m, off_route_m, progress.is_complete(state.position_m)) {
                ending = end;
                break;
            }
        }
        let route_completion_percent = if ending == Ending::Completed { 100.0 } else { progress.completion_percent() };
        let (counted, after): (Vec<&Event>, Vec<&Event>) = log.events.iter().partition(|event| event.time_s <= end_s);
        let infractions = Infractions::of(counted);
        let outside_lanes_percent = if driven_m > 0.0 { 100.0 * outside_m / driven_m } else { 0.0 };
        let infraction_penalty = infractions.penalty(outside_lanes_percent);
        Self {
            route: log.route.clone(),
            driving_score: (route_completion_percent * infraction_penalty).max(0.0),
            route_completion_percent,
            infraction_penalty,
            infractions,
            outside_lanes_percent,
            ending,
            duration_s: end_s - log.ego[0].time_s,
            driven_m,
            length_m: progress.length_m(),
            events_after_end: after.len(),
        }
    }
}

#[cfg(test)]
mod tests;
