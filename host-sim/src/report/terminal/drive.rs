//! A replayed log as text.

use super::table;
use crate::drive::{Decision, Difference, DriveReport, DriveStep};
use crate::report::figures::figure;

/// A line per step, the summary below.
pub fn drive(report: &DriveReport) -> String {
    let compared = report.reference.is_some();
    let mut header = vec!["step", "time s", "speed m/s", "status", "steer", "throttle", "brake"];
    if compared {
        header.extend(["f32: steer", "throttle", "brake", "waypoints apart mm"]);
    }
    let rows = report.steps.iter().map(|step| row(step, compared));
    let table = table(header.into_iter().map(str::to_owned).collect(), &[0, 3], rows);
    format!(
        "{} (sha256 {}…)\n\n{table}\n\n{}",
        report.model.name,
        report.model.sha256.get(..16).unwrap_or_default(),
        summary(report)
    )
}

fn row(step: &DriveStep, compared: bool) -> Vec<String> {
    let mut cells = vec![
        step.name.clone(),
        format!("{:.2}", step.time_s),
        figure(step.speed_mps, 2),
        match &step.float {
            Some(float) if float.status != step.int8.status => format!("{}; f32 {}", step.int8.status, float.status),
            _ => step.int8.status.clone(),
        },
    ];
    cells.extend(controls(Some(&step.int8)));
    if compared {
        cells.extend(controls(step.float.as_ref()));
        cells.push(figure(step.waypoint_distance_m.map(|meters| 1000.0 * meters), 0));
    }
    cells
}

fn controls(decision: Option<&Decision>) -> [String; 3] {
    let figures: [fn(&Decision) -> f64; 3] = [|d| d.steer, |d| d.throttle, |d| d.brake];
    figures.map(|value| figure(decision.map(value), 3))
}

fn summary(report: &DriveReport) -> String {
    let summary = &report.summary;
    let mut text = format!("{} steps, {} driven, {} in the safe state\n", summary.steps, summary.driven, summary.safe);
    if let Some(difference) = &summary.difference {
        let Difference { mean_steer, max_steer, mean_throttle, max_throttle, brake_agreement_percent, .. } = difference;
        text += &format!(
            "int8 beside f32 in {} steps: steer {mean_steer:.4} apart (at most {max_steer:.4}), throttle \
             {mean_throttle:.4} (at most {max_throttle:.4}), brakes agree in {brake_agreement_percent:.1} %\n",
            difference.steps
        );
        if let (Some(mean), Some(max)) = (difference.mean_waypoint_distance_m, difference.max_waypoint_distance_m) {
            text += &format!("waypoints {:.0} mm apart (at most {:.0} mm in a step)\n", 1000.0 * mean, 1000.0 * max);
        }
    }
    text
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::drive::{SCHEMA, Summary};
    use crate::run::ModelInfo;

    #[test]
    fn steps_stand_above_their_summary() {
        let decision = |status: &str, steer: f64| Decision {
            status: status.into(),
            status_code: u8::from(status != "driving"),
            steer,
            throttle: 0.75,
            brake: 0.0,
            waypoints: None,
        };
        let step = |name: &str, int8, float| DriveStep {
            name: name.into(),
            time_s: 0.05,
            speed_mps: Some(3.0),
            goal_m: None,
            command: None,
            int8,
            float: Some(float),
            waypoint_distance_m: Some(0.0125),
        };
        let steps = vec![
            step("a", decision("driving", -0.25), decision("driving", -0.5)),
            step("b", decision("lidar missing", 0.0), decision("driving", 0.5)),
        ];
        let model = ModelInfo { name: "mini".into(), sha256: "ab".repeat(32) };
        let summary = Summary::of(&steps);
        let text = drive(&DriveReport { schema: SCHEMA, reference: Some(model.clone()), model, summary, steps });
        let lines: Vec<String> =
            text.lines().map(|line| line.split_whitespace().collect::<Vec<_>>().join(" ")).collect();
        assert_eq!(lines[3], "a 0.05 3.00 driving −0.250 0.750 0.000 −0.500 0.750 0.000 12");
        assert_eq!(lines[4], "b 0.05 3.00 lidar missing; f32 driving 0.000 0.750 0.000 0.500 0.750 0.000 12");
        assert_eq!(lines[6], "2 steps, 1 driven, 0 in the safe state");
        assert!(lines[7].contains("in 1 steps: steer 0.2500 apart (at most 0.2500)"), "{}", lines[7]);
        assert_eq!(lines[8], "waypoints 12 mm apart (at most 12 mm in a step)");
    }
}
