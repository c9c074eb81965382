//! Hand-made drives on a straight road to the north, with scores worked out by hand.

use super::*;
use model_compiler::error::ErrorCode;
use std::fs;

/// A road of so many meters, a waypoint every meter.
fn road(length: u16) -> Vec<[f64; 2]> {
    (0..=length).map(|y| [0.0, f64::from(y)]).collect()
}

fn at(time_s: f64, position_m: [f64; 2]) -> EgoState {
    EgoState { time_s, position_m, speed_mps: 10.0, outside_lanes: false }
}

/// A drive up to `y` at 10 m/s, a state per second, on a road of 1000 m.
fn drive(y: u32) -> RouteLog {
    let ego = (0..=y / 10).map(|t| at(t.into(), [0.0, f64::from(10 * t) + 0.5])).collect();
    RouteLog { schema: SCHEMA, route: "straight".into(), waypoints: road(1000), ego, events: Vec::new() }
}

fn with_events(mut log: RouteLog, kinds: &[EventKind]) -> RouteLog {
    log.events = kinds.iter().map(|&kind| Event { time_s: 1.0, kind }).collect();
    log
}

fn assert_near(found: f64, expected: f64) {
    assert!((found - expected).abs() < 1e-12, "found {found}, expected {expected}");
}

#[test]
fn a_clean_drive_to_the_end_is_worth_a_hundred() {
    let score = RouteScore::of(&drive(1000));
    assert_eq!((score.driving_score, score.infraction_penalty), (100.0, 1.0));
    assert_eq!((score.route_completion_percent, score.ending), (100.0, Ending::Completed));
    // Complete at 1000.5 m: the state before, at 990.5 m, has exactly 99 % behind it.
    assert_eq!((score.duration_s, score.driven_m, score.length_m), (100.0, 1000.0, 1000.0));
}

#[test]
fn half_a_drive_is_worth_half() {
    let score = RouteScore::of(&drive(500));
    assert_eq!((score.driving_score, score.route_completion_percent), (50.0, 50.0));
    assert_eq!((score.ending, score.driven_m, score.duration_s), (Ending::LogEnds, 500.0, 50.0));
}

#[test]
fn every_event_has_its_factor_each_time() {
    use EventKind::{CollisionPedestrian, CollisionStatic, CollisionVehicle, RedLight, StopSign};
    for (kinds, penalty) in [
        (&[CollisionPedestrian][..], 0.5),
        (&[CollisionVehicle], 0.6),
        (&[CollisionStatic], 0.65),
        (&[RedLight], 0.7),
        (&[StopSign], 0.8),
        (&[CollisionVehicle, CollisionVehicle], 0.36),
        (&[CollisionPedestrian, CollisionVehicle, CollisionStatic, RedLight, StopSign], 0.1092),
    ] {
        let score = RouteScore::of(&with_events(drive(500), kinds));
        assert_near(score.infraction_penalty, penalty);
        assert_near(score.driving_score, 50.0 * penalty);
        assert_eq!(score.infractions.count(kinds[0]) as usize, kinds.iter().filter(|&&k| k == kinds[0]).count());
        assert_eq!(score.route_completion_percent, 50.0, "a penalty is no loss of the way");
    }
}

#[test]
fn the_way_outside_the_lanes_costs_its_part_once() {
    let mut log = drive(500);
    // 5 of 50 steps of 10 m: 10 %.
    log.ego[11..16].iter_mut().for_each(|state| state.outside_lanes = true);
    let score = RouteScore::of(&with_events(log.clone(), &[EventKind::RedLight]));
    assert_near(score.outside_lanes_percent, 10.0);
    assert_near(score.infraction_penalty, 0.9 * 0.7);
    assert_near(score.driving_score, 50.0 * 0.63);
    // All of it outside: nothing is left. The first state has no way behind it.
    log.ego.iter_mut().for_each(|state| state.outside_lanes = true);
    assert_eq!(RouteScore::of(&log).driving_score, 0.0);
    log.ego.truncate(1);
    assert_eq!(RouteScore::of(&log).infraction_penalty, 1.0);
}

#[test]
fn more_than_30_meters_from_the_route_end_it() {
    let mut log = drive(500);
    log.ego[20].position_m[0] = 30.0;
    assert_eq!(RouteScore::of(&log).ending, Ending::LogEnds, "exactly 30 m");
    log.ego[20].position_m[0] = -30.1;
    let score = RouteScore::of(&log);
    assert_eq!((score.ending, score.duration_s), (Ending::RouteDeviation, 20.0));
    assert_eq!(score.route_completion_percent, 20.0, "what came before counts");
}

#[test]
fn more_than_30_percent_of_the_length_beyond_15_meters_end_it() {
    let mut log = drive(500);
    // 31 steps of 10 m beyond 15 m (the first is a little longer): more than 300 m at the 30th.
    log.ego[10..41].iter_mut().for_each(|state| state.position_m[0] = 15.1);
    let score = RouteScore::of(&log);
    assert_eq!((score.ending, score.duration_s), (Ending::RouteDeviation, 39.0));
    log.ego[10..41].iter_mut().for_each(|state| state.position_m[0] = 15.0);
    assert_eq!(RouteScore::of(&log).ending, Ending::LogEnds, "exactly 15 m");
}

#[test]
fn standing_for_180_seconds_ends_it() {
    let stand = |seconds: u32, speed_mps: f64| {
        let mut log = drive(100);
        let last = *log.ego.last().unwrap();
        log.ego.extend((1..=seconds).map(|t| EgoState { time_s: last.time_s + f64::from(t), speed_mps, ..last }));
        RouteScore::of(&log)
    };
    // The first standing state is at 11 s.
    assert_eq!((stand(181, 0.09).ending, stand(181, 0.09).duration_s), (Ending::Blocked, 191.0));
    assert_eq!(stand(500, -0.05).duration_s, 191.0, "nothing counts after the end");
    assert_eq!(stand(180, 0.0).ending, Ending::LogEnds);
    assert_eq!(stand(500, 0.1).ending, Ending::LogEnds, "slow is not standing");
    // A move in between starts the clock again.
    let mut log = drive(100);
    let last = *log.ego.last().unwrap();
    let speed = |t: u32| if t == 100 { 0.2 } else { 0.0 };
    log.ego.extend((1..=270).map(|t| EgoState { time_s: 10.0 + f64::from(t), speed_mps: speed(t), ..last }));
    assert_eq!(RouteScore::of(&log).ending, Ending::LogEnds);
}

#[test]
fn a_route_has_08_seconds_per_meter_and_5() {
    // 100 m: 85 s.
    let wait = |time_s: f64| {
        let ego = vec![at(7.0, [0.0, 0.0]), at(8.0, [0.0, 40.5]), at(7.0 + time_s, [0.0, 50.5])];
        RouteScore::of(&RouteLog { waypoints: road(100), ego, ..drive(0) })
    };
    assert_eq!((wait(85.0).ending, wait(85.0).duration_s), (Ending::LogEnds, 85.0));
    assert_eq!((wait(85.5).ending, wait(85.5).route_completion_percent), (Ending::Timeout, 50.0));
}

#[test]
fn the_end_comes_before_the_rules() {
    let ego = vec![at(0.0, [0.0, 0.0]), at(1000.0, [0.0, 99.5])];
    let log = RouteLog { waypoints: road(100), ego, ..drive(0) };
    let score = RouteScore::of(&log);
    assert_eq!(score.ending, Ending::Timeout, "exactly 99 % is not beyond");
    let log = RouteLog { ego: vec![at(0.0, [0.0, 0.0]), at(1000.0, [0.0, 100.5])], ..log };
    assert_eq!(RouteScore::of(&log).ending, Ending::Completed);
}

#[test]
fn events_after_the_end_do_not_count() {
    let mut log = drive(500);
    log.ego[20].position_m[0] = 31.0;
    let event = |time_s| Event { time_s, kind: EventKind::RedLight };
    log.events = vec![event(20.0), event(20.5), event(45.0)];
    let score = RouteScore::of(&log);
    assert_eq!((score.infractions.red_light, score.events_after_end), (1, 2));
}

#[test]
fn means_are_plain_averages() {
    let long = RouteScore::of(&with_events(drive(500), &[EventKind::CollisionPedestrian]));
    let ego = vec![at(0.0, [0.0, 0.0]), at(1.0, [0.0, 10.5])];
    let short = RouteScore::of(&RouteLog { waypoints: road(10), ego, ..drive(0) });
    assert_eq!((long.driving_score, short.driving_score), (25.0, 100.0));
    let mean = Score::of(vec![long, short]).mean;
    assert_eq!(mean, MeanScore { driving_score: 62.5, route_completion_percent: 75.0, infraction_penalty: 0.75 });
}

#[test]
fn bad_logs_are_refused_with_the_field() {
    let good = drive(20);
    assert_eq!(good.check(), Ok(()));
    type Damage = fn(&mut RouteLog);
    let cases: [(&str, Damage); 9] = [
        ("schema: found version 2, expected 1", |log| log.schema = 2),
        ("waypoints: found 0 waypoints, expected two at different places", |log| log.waypoints.clear()),
        ("waypoints: found 3 waypoints, expected two at different places", |log| log.waypoints = vec![[1.0, 2.0]; 3]),
        ("waypoints[4]: its coordinates are not finite", |log| log.waypoints[4][1] = f64::NAN),
        ("ego: the log holds no state", |log| log.ego.clear()),
        ("ego[1]: its time, position or speed", |log| log.ego[1].speed_mps = f64::INFINITY),
        ("ego[2]: time is 1 s after 1 s", |log| log.ego[2].time_s = 1.0),
        ("events[0]: it is at 2.5 s, the drive from 0 s to 2 s", |log| {
            log.events = vec![Event { time_s: 2.5, kind: EventKind::StopSign }];
        }),
        ("events[0]: it is at NaN s", |log| {
            log.events = vec![Event { time_s: f64::NAN, kind: EventKind::StopSign }];
        }),
    ];
    for (expected, damage) in cases {
        let mut log = good.clone();
        damage(&mut log);
        let error = log.check().unwrap_err();
        assert!(error.to_string().starts_with(expected), "{error}");
        assert_eq!(error.code, ErrorCode::Malformed);
        assert_eq!(error.help, "`host-sim schema route-log` prints the format");
    }
}

#[test]
fn logs_come_from_files_and_errors_name_them() {
    let folder = tempfile::tempdir().unwrap();
    let path = |name: &str| folder.path().join(name);
    fs::write(path("a.json"), serde_json::to_vec(&drive(500)).unwrap()).unwrap();
    let text = r#"{"schema": 1, "route": "b", "waypoints": [[0, 0], [0, 10]],
        "ego": [{"time_s": 0, "position_m": [0, 0], "speed_mps": 5},
                {"time_s": 2, "position_m": [0, 10.5], "speed_mps": 5}],
        "events": [{"time_s": 1, "kind": "stop_sign"}]}"#;
    fs::write(path("b.json"), text).unwrap();
    let score = score(&[path("a.json"), path("b.json")]).unwrap();
    assert_eq!(score.routes[0], RouteScore::of(&drive(500)));
    assert_eq!(score.routes[1].infractions.stop_sign, 1);
    assert_near(score.mean.driving_score, 65.0);
    fs::write(path("kind.json"), text.replace("stop_sign", "parking")).unwrap();
    fs::write(path("field.json"), text.replace("events", "infractions")).unwrap();
    fs::write(path("early.json"), text.replace(r#""time_s": 1,"#, r#""time_s": -1,"#)).unwrap();
    for (name, expected) in [
        ("kind.json", "unknown variant `parking`"),
        ("field.json", "unknown field `infractions`"),
        ("early.json", "events[0]: it is at -1 s"),
        ("none.json", "No such file"),
    ] {
        let error = super::score(&[path(name)]).unwrap_err().to_string();
        assert!(error.contains(name) && error.contains(expected), "{error}");
    }
    // The same on the command line.
    let command = |arguments: &[&str]| {
        let arguments = ["host-sim", "score"].into_iter().chain(arguments.iter().copied());
        let arguments = arguments.map(|word| if word.contains(".json") { path(word).into() } else { word.into() });
        let (mut out, mut err) = (Vec::new(), Vec::new());
        let status = crate::cli::main(arguments, crate::cli::Console { out: &mut out, err: &mut err });
        (status, String::from_utf8(out).unwrap(), String::from_utf8(err).unwrap())
    };
    let (status, table, _) = command(&["a.json", "b.json"]);
    assert!(status == 0 && table.contains("straight") && table.contains("mean of 2"), "{table}");
    let (status, document, _) = command(&["a.json", "b.json", "--json"]);
    let document: serde_json::Value = serde_json::from_str(&document).unwrap();
    assert_eq!((status, &document["mean"]["driving_score"]), (0, &score.mean.driving_score.into()));
    assert_eq!((&document["schema"], &document["routes"][0]["ending"]), (&1.into(), &"log_ends".into()));
    let (status, _, error) = command(&["a.json", "early.json"]);
    assert!(status == 2 && error.contains("early.json: events[0]"), "{error}");
    assert_eq!(command(&[]).0, 2);
}
