//! The table `[run]`.

use std::path::PathBuf;
use std::time::Duration;

use serde::{Deserialize, Serialize};

use super::problems::{MAX_STEPS, TableProblems};

/// Ours: ten lines in a run of 500 steps, 5,000 in the paper's.
const LOG_EVERY: u64 = 50;
/// Ours: about one epoch of the paper's run.
const VALIDATE_EVERY: u64 = 1000;
/// Ours: as often as validations.
const CHECKPOINT_EVERY: u64 = 1000;
/// Ours: the most that a crash may cost.
const CHECKPOINT_MINUTES: f64 = 15.0;
/// A year: a larger number is a typing error.
const MAX_MINUTES: f64 = 525_600.0;
/// Ours: if one checkpoint is damaged, the other is intact.
const KEEP: usize = 2;
const MINUTE: f64 = 60.0;

/// The `[run]` table.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct RunConfig {
    /// Run directory. Absent: `runs/` and the name of the configuration file.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub dir: Option<PathBuf>,
    /// Steps between two lines of `metrics.jsonl`.
    pub log_every: u64,
    /// Steps between two validations.
    pub validate_every: u64,
    /// Steps between two checkpoints.
    pub checkpoint_every: u64,
    /// Minutes after which a checkpoint is also due.
    pub checkpoint_minutes: f64,
    /// Number of newest checkpoints kept. The best weights are kept apart from them.
    pub keep: usize,
}

impl Default for RunConfig {
    fn default() -> Self {
        RunConfig {
            dir: None,
            log_every: LOG_EVERY,
            validate_every: VALIDATE_EVERY,
            checkpoint_every: CHECKPOINT_EVERY,
            checkpoint_minutes: CHECKPOINT_MINUTES,
            keep: KEEP,
        }
    }
}

impl RunConfig {
    /// Every value out of range, one line each.
    pub fn validate(&self) -> Vec<String> {
        let mut problems = TableProblems::of("run");
        for (key, value) in [
            ("log_every", self.log_every),
            ("validate_every", self.validate_every),
            ("checkpoint_every", self.checkpoint_every),
            ("keep", self.keep as u64),
        ] {
            problems.require_count(key, value, MAX_STEPS);
        }
        let minutes = self.checkpoint_minutes;
        problems.require(
            minutes > 0.0 && minutes <= MAX_MINUTES,
            "checkpoint_minutes",
            &minutes,
            "above 0 and at most 525600 (a year)",
        );
        if let Some(dir) = &self.dir {
            let holds = !dir.as_os_str().is_empty();
            problems.require(holds, "dir", dir, "a path, or absent for the default");
        }
        problems.into_lines()
    }

    /// The time after which a checkpoint is due.
    pub fn checkpoint_interval(&self) -> Duration {
        Duration::from_secs_f64(self.checkpoint_minutes * MINUTE)
    }
}
