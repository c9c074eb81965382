//! The two clocks of a measurement: the one on the wall, and the one that stands still while the thread does.

use std::time::{Duration, Instant};

/// A stretch of time on both clocks.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Elapsed {
    /// Time that passed.
    pub wall: Duration,
    /// Time that this thread had a processor; `None` where the system does not tell.
    pub cpu: Option<Duration>,
}

impl Elapsed {
    /// The time of the thread, where the system tells it.
    pub fn busy(&self) -> Duration {
        self.cpu.unwrap_or(self.wall)
    }
}

/// Both clocks, started.
#[derive(Clone, Copy, Debug)]
pub struct Stopwatch {
    wall: Instant,
    cpu: Option<Duration>,
}

impl Stopwatch {
    /// Starts.
    pub fn start() -> Self {
        Self { wall: Instant::now(), cpu: thread_time() }
    }

    /// Time since the start.
    pub fn elapsed(&self) -> Elapsed {
        let cpu = thread_time().zip(self.cpu).map(|(now, start)| now.saturating_sub(start));
        Elapsed { wall: self.wall.elapsed(), cpu }
    }
}

/// Time that this thread has had a processor so far.
#[cfg(unix)]
fn thread_time() -> Option<Duration> {
    rustix::time::clock_gettime(rustix::time::ClockId::ThreadCPUTime).try_into().ok()
}

#[cfg(not(unix))]
fn thread_time() -> Option<Duration> {
    None
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    #[cfg(unix)]
    fn a_sleeping_thread_uses_no_processor() {
        let watch = Stopwatch::start();
        std::thread::sleep(Duration::from_millis(50));
        let elapsed = watch.elapsed();
        assert!(elapsed.wall >= Duration::from_millis(50), "{elapsed:?}");
        assert!(elapsed.busy() < elapsed.wall, "{elapsed:?}");
    }
}
