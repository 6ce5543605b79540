//! The time of a run: over its sessions, and since its last checkpoint.

use std::time::{Duration, Instant};

/// The duration of a run over its sessions, and the time since the last checkpoint.
pub struct SessionClock {
    started: Instant,
    /// Seconds of earlier sessions.
    before: f64,
    saved: Instant,
    interval: Duration,
}

impl SessionClock {
    /// A session after `before` seconds of earlier ones, with a checkpoint due after `interval`.
    pub fn new(before: f64, interval: Duration) -> Self {
        let now = Instant::now();
        SessionClock {
            started: now,
            before,
            saved: now,
            interval,
        }
    }

    /// Seconds of all sessions.
    pub fn elapsed(&self) -> f64 {
        self.before + self.started.elapsed().as_secs_f64()
    }

    /// Starts the interval anew.
    pub fn checkpoint_saved(&mut self) {
        self.saved = Instant::now();
    }

    /// Whether `run.checkpoint_minutes` have passed.
    pub fn checkpoint_is_due(&self) -> bool {
        self.saved.elapsed() >= self.interval
    }
}
