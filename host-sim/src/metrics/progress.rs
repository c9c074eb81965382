//! How far the car got along its route, and how far off it was.

/// Waypoints ahead that may be passed at once: one that is off the line (a change of lanes) holds nobody up, and a
/// route that comes back near itself is not cut short.
const WINDOW: usize = 2;
/// A route is complete beyond this part of its length, percent, …
const COMPLETE_PERCENT: f64 = 99.0;
/// … and nearer than this to its end, m.
const COMPLETE_WITHIN_M: f64 = 10.0;

/// Progress along a route.
///
/// A waypoint is passed when the car is beyond the line through it across the direction of the route there (towards the
/// next waypoint). Waypoints are passed in order, each once.
#[derive(Clone, Debug)]
pub struct Progress<'a> {
    waypoints: &'a [[f64; 2]],
    /// Length of the route up to each waypoint, m.
    lengths: Vec<f64>,
    /// The last waypoint passed.
    passed: usize,
}

impl<'a> Progress<'a> {
    /// The start of a route of at least two waypoints.
    pub fn new(waypoints: &'a [[f64; 2]]) -> Self {
        let mut length = 0.0;
        let steps = waypoints.windows(2).map(|pair| {
            length += distance(pair[0], pair[1]);
            length
        });
        Self { waypoints, lengths: std::iter::once(0.0).chain(steps).collect(), passed: 0 }
    }

    /// Length of the route, m.
    pub fn length_m(&self) -> f64 {
        self.lengths.last().copied().unwrap_or(0.0)
    }

    /// Passes what lies behind the car.
    pub fn advance(&mut self, position: [f64; 2]) {
        let next = |passed: usize| passed + 1..(passed + 1 + WINDOW).min(self.waypoints.len());
        while let Some(farthest) = next(self.passed).rev().find(|&waypoint| self.is_behind(waypoint, position)) {
            self.passed = farthest;
        }
    }

    /// Part of the route's length up to the last waypoint passed, percent.
    pub fn completion_percent(&self) -> f64 {
        100.0 * self.lengths[self.passed] / self.length_m()
    }

    /// Whether all but a last bit is driven and the end is near; then the whole route counts.
    pub fn is_complete(&self, position: [f64; 2]) -> bool {
        let near_end = self.waypoints.last().is_some_and(|&end| distance(position, end) < COMPLETE_WITHIN_M);
        near_end && self.completion_percent() > COMPLETE_PERCENT
    }

    /// Distance to the nearest point of the route, m.
    pub fn distance_from_route(&self, position: [f64; 2]) -> f64 {
        let distances = self.waypoints.windows(2).map(|pair| distance_to_segment(position, pair[0], pair[1]));
        distances.fold(f64::INFINITY, f64::min)
    }

    fn is_behind(&self, waypoint: usize, position: [f64; 2]) -> bool {
        let here = self.waypoints[waypoint];
        let (from, to) = match self.waypoints.get(waypoint + 1) {
            Some(&next) => (here, next),
            None => (self.waypoints[waypoint - 1], here),
        };
        dot(difference(position, here), difference(to, from)) > 0.0
    }
}

/// Distance of two points.
pub fn distance(a: [f64; 2], b: [f64; 2]) -> f64 {
    let [x, y] = difference(a, b);
    x.hypot(y)
}

fn distance_to_segment(point: [f64; 2], from: [f64; 2], to: [f64; 2]) -> f64 {
    let (along, offset) = (difference(to, from), difference(point, from));
    let squared = dot(along, along);
    let part = if squared > 0.0 { (dot(offset, along) / squared).clamp(0.0, 1.0) } else { 0.0 };
    distance(point, [from[0] + part * along[0], from[1] + part * along[1]])
}

fn difference(a: [f64; 2], b: [f64; 2]) -> [f64; 2] {
    [a[0] - b[0], a[1] - b[1]]
}

fn dot(a: [f64; 2], b: [f64; 2]) -> f64 {
    a[0] * b[0] + a[1] * b[1]
}

#[cfg(test)]
mod tests {
    use super::*;

    /// 100 m north, 50 m east, 100 m south; a waypoint every meter.
    fn horseshoe() -> Vec<[f64; 2]> {
        let north = (0..100).map(|y| [0.0, f64::from(y)]);
        let east = (0..50).map(|x| [f64::from(x), 100.0]);
        let south = (0..=100).map(|y| [50.0, f64::from(100 - y)]);
        north.chain(east).chain(south).collect()
    }

    fn completion(waypoints: &[[f64; 2]], drive: &[[f64; 2]]) -> f64 {
        let mut progress = Progress::new(waypoints);
        drive.iter().for_each(|&position| progress.advance(position));
        progress.completion_percent()
    }

    #[test]
    fn completion_is_the_length_up_to_the_last_waypoint_passed() {
        let route = horseshoe();
        assert_eq!(Progress::new(&route).length_m(), 250.0);
        assert_eq!(completion(&route, &[[0.0, 0.0]]), 0.0);
        // On the line through a waypoint it is not yet passed; beside the road it is.
        assert_eq!(completion(&route, &[[0.0, 25.0]]), 9.6);
        assert_eq!(completion(&route, &[[0.0, 25.5]]), 10.0);
        assert_eq!(completion(&route, &[[4.0, 25.5]]), 10.0);
        // Far samples pass all waypoints between, and going back takes nothing away.
        assert_eq!(completion(&route, &[[0.0, 25.5], [0.0, 75.5], [0.0, 30.0]]), 30.0);
        assert_eq!(completion(&route, &[[0.0, 99.5], [25.5, 100.0], [49.5, 100.0], [50.0, 0.5], [50.0, -0.5]]), 100.0);
    }

    #[test]
    fn another_part_of_the_route_is_not_reached_before_its_turn() {
        // Beside the last leg, but the corner has not been turned.
        assert_eq!(completion(&horseshoe(), &[[40.0, 25.5]]), 10.0);
        // Straight on at the corner: the leg to the east, corner included, is not driven.
        assert_eq!(completion(&horseshoe(), &[[0.0, 99.5], [0.0, 140.0]]), 39.6);
    }

    #[test]
    fn a_waypoint_beside_the_line_holds_nobody_up() {
        let route = [[0.0, 0.0], [0.0, 1.0], [3.0, 1.0], [3.0, 2.0], [3.0, 3.0]];
        // The waypoint at [0, 1] points east, where the car on the left lane never goes.
        let mut progress = Progress::new(&route);
        progress.advance([-0.5, 2.5]);
        assert_eq!(progress.completion_percent(), 100.0 * 5.0 / 6.0);
    }

    #[test]
    fn a_route_is_complete_beyond_99_percent_and_within_10_meters() {
        let route: Vec<[f64; 2]> = (0..=2000).map(|y| [0.0, f64::from(y)]).collect();
        let complete = |y: f64, seen_from: [f64; 2]| {
            let mut progress = Progress::new(&route);
            progress.advance([0.0, y]);
            progress.is_complete(seen_from)
        };
        assert!(complete(1990.5, [0.0, 1990.5]), "99.5 %, 9.5 m");
        assert!(!complete(1989.5, [0.0, 1989.5]), "99.45 %, but 10.5 m");
        assert!(!complete(1979.5, [0.0, 1995.0]), "5 m, but 98.95 %");
        assert!(!complete(1980.5, [0.0, 1995.0]), "5 m, but exactly 99 %");
    }

    #[test]
    fn the_distance_is_that_to_the_nearest_point_of_the_line() {
        let route = [[0.0, 0.0], [0.0, 10.0], [10.0, 10.0]];
        let progress = Progress::new(&route);
        assert_eq!(progress.distance_from_route([-3.0, 5.0]), 3.0, "between waypoints");
        assert_eq!(progress.distance_from_route([13.0, 14.0]), 5.0, "beyond the end");
        assert_eq!(progress.distance_from_route([6.0, 9.0]), 1.0);
    }
}
