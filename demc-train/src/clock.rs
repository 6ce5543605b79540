//! The clock of a session: what it adds to the run's time, and when a checkpoint is due by it.

use std::time::{Duration, Instant};

use crate::config::RunConfig;

/// Seconds of a minute.
const MINUTE: f64 = 60.0;

/// The clock of a session.
pub struct Clock {
    started: Instant,
    before: f64,
    saved: Instant,
}

impl Clock {
    /// A session that begins now, in a run that has taken `before` seconds.
    pub fn new(before: f64) -> Self {
        let now = Instant::now();
        Clock {
            started: now,
            before,
            saved: now,
        }
    }

    /// Seconds of the run so far.
    pub fn elapsed(&self) -> f64 {
        self.before + self.started.elapsed().as_secs_f64()
    }

    /// A checkpoint was written.
    pub fn saved(&mut self) {
        self.saved = Instant::now();
    }

    /// Whether a checkpoint is due by `run.checkpoint_minutes`.
    pub fn is_due(&self, run: &RunConfig) -> bool {
        let limit = Duration::from_secs_f64(run.checkpoint_minutes * MINUTE);
        !limit.is_zero() && self.saved.elapsed() >= limit
    }
}
