//! Scored drives as text.

use super::table;
use crate::metrics::{EventKind, RouteScore, Score};

/// A line per route and the averages below.
pub fn score(score: &Score) -> String {
    let header = [
        "route",
        "score",
        "completion %",
        "penalty",
        "pedestrians",
        "vehicles",
        "static",
        "red lights",
        "stop signs",
        "outside lanes %",
        "driven m",
        "time s",
        "ending",
    ];
    let row = |route: &RouteScore| {
        let figures = figures(route.driving_score, route.route_completion_percent, route.infraction_penalty);
        let counts = EventKind::ALL.iter().map(|&kind| route.infractions.count(kind).to_string());
        let way = [
            format!("{:.2}", route.outside_lanes_percent),
            format!("{:.1}", route.driven_m),
            format!("{:.1}", route.duration_s),
            route.ending.words().to_owned(),
        ];
        [route.route.clone()].into_iter().chain(figures).chain(counts).chain(way).collect()
    };
    let mean = &score.mean;
    let mean = figures(mean.driving_score, mean.route_completion_percent, mean.infraction_penalty);
    let mean = [format!("mean of {}", score.routes.len())].into_iter().chain(mean).collect();
    let rows = score.routes.iter().map(row).chain([mean]);
    let mut text = format!("{}\n", table(header.map(str::to_owned).to_vec(), &[0, 12], rows));
    for route in score.routes.iter().filter(|route| route.events_after_end > 0) {
        text += &format!("{}: {} events after the end do not count\n", route.route, route.events_after_end);
    }
    text
}

fn figures(driving_score: f64, completion_percent: f64, penalty: f64) -> [String; 3] {
    [format!("{driving_score:.2}"), format!("{completion_percent:.2}"), format!("{penalty:.4}")]
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::metrics::{Ending, Infractions};

    #[test]
    fn routes_stand_above_their_mean() {
        let route = |name: &str, driving_score: f64, events_after_end: usize| RouteScore {
            route: name.into(),
            driving_score,
            route_completion_percent: 2.0 * driving_score,
            infraction_penalty: 0.5,
            infractions: Infractions { collision_pedestrian: 1, ..Infractions::default() },
            outside_lanes_percent: 0.0,
            ending: Ending::Blocked,
            duration_s: 190.0,
            driven_m: 123.0,
            length_m: 300.0,
            events_after_end,
        };
        let text = score(&Score::of(vec![route("Town05 short 3", 10.0, 0), route("b", 40.0, 2)]));
        let lines: Vec<Vec<&str>> = text.lines().map(|line| line.split_whitespace().collect()).collect();
        let tail = ["0.5000", "1", "0", "0", "0", "0", "0.00", "123.0", "190.0", "blocked"];
        assert_eq!(lines[1], [&["Town05", "short", "3", "10.00", "20.00"][..], &tail].concat());
        assert_eq!(lines[2], [&["b", "40.00", "80.00"][..], &tail].concat());
        assert_eq!(lines[3], ["mean", "of", "2", "25.00", "50.00", "0.5000"]);
        assert_eq!(lines[4].join(" "), "b: 2 events after the end do not count");
    }
}
