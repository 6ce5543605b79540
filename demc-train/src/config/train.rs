//! The table `[train]`.

use std::path::PathBuf;

use serde::{Deserialize, Serialize};

use super::problems::{MAX_STEPS, TableProblems};

/// Iterations (Sec. 4.2: "approximately 250K").
const STEPS: u64 = 250_000;
/// Upper bound of batches per step: a larger number is a typing error.
const MAX_BATCHES: u64 = 65_536;

/// The `[train]` table.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct TrainConfig {
    /// Optimizer steps of the whole run.
    pub steps: u64,
    /// Seed of weights, validation scenes, shuffling and augmentation.
    pub seed: u64,
    /// Batches per step, whose gradients are averaged: a step trains on `data.batch_size *
    /// grad_accumulation` patches.
    pub grad_accumulation: usize,
    /// Decay of the moving average of the weights, above 0 and below 1. With one, validation, test
    /// and `demc-infer` use the averaged weights. Absent: no average, as in the paper.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub ema_decay: Option<f64>,
    /// Initial weights: a run directory, a checkpoint or an exported file with the same `[model]`, or of
    /// the U-Net in it, and the same `data.gamma`. Absent: random initialisation from `seed`.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub init: Option<PathBuf>,
    /// Reaction to a non-finite loss or gradient.
    pub on_nan: OnNan,
}

impl Default for TrainConfig {
    /// The paper's training (Sec. 4.2).
    fn default() -> Self {
        TrainConfig {
            steps: STEPS,
            seed: 1,
            grad_accumulation: 1,
            ema_decay: None,
            init: None,
            on_nan: OnNan::default(),
        }
    }
}

/// Reaction to a non-finite loss or gradient.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum OnNan {
    /// The run stops and names the patches.
    #[default]
    Stop,
    /// The step is skipped and counted.
    Skip,
}

impl TrainConfig {
    /// Every value out of range, one line each.
    pub fn validate(&self) -> Vec<String> {
        let mut problems = TableProblems::of("train");
        problems.require_count("steps", self.steps, MAX_STEPS);
        problems.require_count(
            "grad_accumulation",
            self.grad_accumulation as u64,
            MAX_BATCHES,
        );
        problems.require(
            self.seed <= i64::MAX as u64,
            "seed",
            &self.seed,
            "at most 9223372036854775807, TOML's largest integer",
        );
        if let Some(decay) = self.ema_decay {
            let holds = decay > 0.0 && decay < 1.0;
            let allowed = "above 0 and below 1, or absent for no average";
            problems.require(holds, "ema_decay", &decay, allowed);
        }
        if let Some(init) = &self.init {
            let holds = !init.as_os_str().is_empty();
            let allowed = "a path, or absent for random initialisation";
            problems.require(holds, "init", init, allowed);
        }
        problems.into_lines()
    }
}
