//! When the network runs: the vehicle is controlled in 20 steps per second.

/// Milliseconds from step to step.
pub const STEP_MS: u16 = 50;

/// On which steps the network runs.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub enum Cadence {
    /// On every step.
    EveryStep,
    /// On even steps, when the LiDAR has swept the front, and on the first ones up to step 4; in between the waypoints
    /// of the step before are driven on.
    EvenSteps,
}

/// What a step is for.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Turn {
    /// Step 0: buffers fill, nothing is controlled.
    Fill,
    /// The network runs.
    Network,
    /// The waypoints of the step before are driven on.
    Reuse,
}

/// Counts the steps.
#[derive(Clone, Debug)]
pub struct Schedule {
    cadence: Cadence,
    step: u32,
}

impl Schedule {
    /// Starts before step 0.
    pub const fn new(cadence: Cadence) -> Self {
        Self { cadence, step: 0 }
    }

    /// What the next step is for.
    pub fn advance(&mut self) -> Turn {
        let turn = match (self.step, self.cadence) {
            (0, _) => Turn::Fill,
            (_, Cadence::EveryStep) | (1..=4, _) => Turn::Network,
            (step, Cadence::EvenSteps) if step & 1 == 0 => Turn::Network,
            _ => Turn::Reuse,
        };
        // After seven years the count goes on at an even number that is no start.
        self.step = self.step.checked_add(1).unwrap_or(6);
        turn
    }
}

#[cfg(test)]
mod tests {
    extern crate std;
    use super::*;
    use std::vec::Vec;

    fn turns(mut schedule: Schedule, count: usize) -> Vec<Turn> {
        (0..count).map(|_| schedule.advance()).collect()
    }

    #[test]
    fn step_0_fills_and_every_step_after_it_runs_the_network() {
        assert_eq!(
            turns(Schedule::new(Cadence::EveryStep), 4),
            [Turn::Fill, Turn::Network, Turn::Network, Turn::Network]
        );
    }

    #[test]
    fn even_steps_run_the_network_and_odd_ones_do_from_5_on_not() {
        let turns = turns(Schedule::new(Cadence::EvenSteps), 40);
        for (step, turn) in turns.into_iter().enumerate().skip(1) {
            let expected = if step <= 4 || step % 2 == 0 { Turn::Network } else { Turn::Reuse };
            assert_eq!(turn, expected, "step {step}");
        }
    }

    #[test]
    fn the_count_never_starts_over() {
        let schedule = Schedule { cadence: Cadence::EvenSteps, step: u32::MAX - 1 };
        assert_eq!(turns(schedule, 4), [Turn::Network, Turn::Reuse, Turn::Network, Turn::Reuse]);
    }
}
