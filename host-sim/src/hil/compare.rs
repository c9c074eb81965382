//! Where board and host first differ.

use super::expected::Expected;
use super::session::Answered;
use crate::answer::Answer;
use crate::drive::Decision;
use firmware::drive::{Fault, Output, Status};
use firmware::image::Image;

/// What is unequal.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Unequal {
    /// Step, byte of an output, or what else.
    pub place: String,
    /// On the board.
    pub found: String,
    /// On the host.
    pub expected: String,
}

impl Unequal {
    fn new(place: impl Into<String>, found: impl Into<String>, expected: impl Into<String>) -> Self {
        Self { place: place.into(), found: found.into(), expected: expected.into() }
    }
}

/// What a frame that stands alone must give.
#[derive(Clone, Copy, Debug)]
pub struct Reference<'r, 'a> {
    /// The image.
    pub image: &'r Image<'a>,
    /// What its network gives.
    pub expected: &'r Expected,
    /// What that tells a driver.
    pub answer: Option<&'r Answer>,
    /// What the actuators are told.
    pub output: Output,
}

impl Reference<'_, '_> {
    /// The first difference, in the order in which a frame is computed: steps, outputs, answer, status, controls.
    pub fn first_difference(&self, answered: &Answered) -> Option<Unequal> {
        self.steps(answered)
            .or_else(|| self.given_up(answered))
            .or_else(|| self.outputs(&answered.outputs))
            .or_else(|| self.decision(answered))
    }

    fn steps(&self, answered: &Answered) -> Option<Unequal> {
        for (position, (report, expected)) in (0_u16..).zip(answered.steps.iter().zip(&self.expected.step_crcs)) {
            let place = || format!("step {position} {}", self.operator(position));
            if report.step != position {
                return Some(Unequal::new(place(), format!("step {}", report.step), format!("step {position}")));
            }
            if report.crc != *expected {
                let [found, expected] = [report.crc, *expected].map(|crc| format!("CRC {crc:08x}"));
                return Some(Unequal::new(place(), found, expected));
            }
        }
        None
    }

    /// A network that did not run to its end has no outputs to look at.
    fn given_up(&self, answered: &Answered) -> Option<Unequal> {
        let status = answered.telemetry.status;
        let is_given_up = matches!(status, Status::Fault(Fault::NetworkOverrun | Fault::NetworkFailed));
        (is_given_up && status != self.output.status).then(|| unequal_status(status, self.output.status))
    }

    fn outputs(&self, found: &[Vec<u8>]) -> Option<Unequal> {
        for (output, (found, expected)) in (0_u8..).zip(found.iter().zip(&self.expected.outputs)) {
            let port = self.image.output(output)?;
            let writer = (0..self.image.step_count())
                .rev()
                .find(|position| self.image.step(*position).is_some_and(|step| step.output() == port.tensor));
            let writer = writer.map_or_else(String::new, |p| format!(" (step {p} {})", self.operator(p)));
            let place = format!("output `{}`{writer}", port.name);
            if found.len() != expected.len() {
                let [found, expected] = [found, expected].map(|bytes| format!("{} bytes", bytes.len()));
                return Some(Unequal::new(place, found, expected));
            }
            if let Some(byte) = found.iter().zip(expected).position(|(found, expected)| found != expected) {
                let [found, expected] = [found[byte], expected[byte]].map(|byte| format!("{byte:#04x}"));
                return Some(Unequal::new(format!("{place}, byte {byte}"), found, expected));
            }
        }
        None
    }

    fn decision(&self, answered: &Answered) -> Option<Unequal> {
        let telemetry = &answered.telemetry;
        let answer = Answer::of_board(&telemetry.answer);
        if answer.as_ref() != self.answer {
            return Some(Unequal::new("answer", format!("{answer:?}"), format!("{:?}", self.answer)));
        }
        if telemetry.status != self.output.status {
            return Some(unequal_status(telemetry.status, self.output.status));
        }
        let [found, expected] = [telemetry.controls, self.output.controls];
        (found != expected).then(|| Unequal::new("controls", format!("{found:?}"), format!("{expected:?}")))
    }

    fn operator(&self, position: u16) -> &'static str {
        self.image.step(position).map_or("?", |step| step.name())
    }
}

fn unequal_status(found: Status, expected: Status) -> Unequal {
    Unequal::new("status", found.to_string(), expected.to_string())
}

/// The first difference of a step of a drive: status, waypoints, controls, each bit for bit.
pub fn decisions(found: &Decision, expected: &Decision) -> Option<Unequal> {
    if found.status_code != expected.status_code {
        return Some(Unequal::new("status", &found.status, &expected.status));
    }
    if found.waypoints != expected.waypoints {
        return Some(Unequal::new("waypoints", format!("{:?}", found.waypoints), format!("{:?}", expected.waypoints)));
    }
    // Fixed point with 32 fraction bits: exact in f64.
    let controls = |decision: &Decision| [decision.steer, decision.throttle, decision.brake];
    let [f, e] = [controls(found), controls(expected)];
    let index = f.iter().zip(&e).position(|(found, expected)| found != expected)?;
    Some(Unequal::new(["steer", "throttle", "brake"][index], f[index].to_string(), e[index].to_string()))
}
