//! The tables `[train]` and `[run]`, with every default and where it comes from.

use std::path::PathBuf;

use demc_model::Loss;
use serde::{Deserialize, Serialize};

use crate::schedule::Decay;

/// Iterations (Sec. 4.2: "approximately 250K").
const STEPS: u64 = 250_000;
/// First learning rate (Sec. 4.2).
const LR_START: f64 = 1e-4;
/// Last learning rate (Sec. 4.2).
const LR_END: f64 = 5e-6;
/// Adam's epsilon (Kingma and Ba 2014).
const ADAM_EPSILON: f32 = 1e-8;
/// Ours: 1 in 50 of a run of some hundred steps, and no load on a long one.
const LOG_EVERY: u64 = 50;
/// Ours: about one epoch of the paper's run.
const VALIDATE_EVERY: u64 = 1000;
/// Ours: a stopped run loses at most as much as between two validations.
const CHECKPOINT_EVERY: u64 = 1000;
/// Ours: what anybody can bear to lose.
const CHECKPOINT_MINUTES: f64 = 15.0;
/// Ours: the last one may be the one that was being written.
const KEEP: usize = 2;

/// The `[train]` table.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct TrainConfig {
    /// Optimizer steps of the whole run.
    pub steps: u64,
    /// Learning rate of the first step.
    pub lr_start: f64,
    /// Learning rate towards which the run goes.
    pub lr_end: f64,
    /// The way from the one to the other.
    pub decay: Decay,
    /// Kernels whose outputs sum up more inputs than this learn at a rate that is smaller in proportion ([`crate::rate`]). 0: all alike, as in
    /// the paper.
    pub lr_fan_in: usize,
    /// Kernels of up to so many outputs step as Muon does ([`demc_model::ops::muon`]), all other weights as Adam does. 0: Adam alone, as in the paper.
    pub muon: usize,
    /// Steps at the beginning over which the learning rate climbs from nearly 0 to its course; 0: none, as in the paper.
    pub warmup: u64,
    /// Adam's epsilon.
    pub adam_epsilon: f32,
    /// What is minimised.
    pub loss: Loss,
    /// Epsilon of the loss (Eq. 5).
    pub loss_epsilon: f32,
    /// How many times `(1 - SSIM) / 2` is added to the loss ([`demc_model::loss::dissimilarity`]); 0: not at all, as in the paper.
    pub ssim: f32,
    /// How many times SMAPE ([`demc_model::loss::Loss::Smape`]) is added to the loss; 0: not at all, as in the paper. RelMSE does
    /// not mind a colour that is a little off, or dark, where an image is clean.
    pub smape: f32,
    /// Batches whose gradients are averaged in one step: a step sees `data.batch_size * grad_accumulation` patches.
    pub grad_accumulation: usize,
    /// Largest norm of the whole gradient; a longer one is shortened to it. 0: no limit, as in the paper.
    pub grad_clip: f32,
    /// Share of the moving average of the weights that a step keeps, from 0 to below 1. 0: no average, as in the paper. With
    /// one, validation, test and `demc-infer` use the averaged weights.
    pub ema: f64,
    /// Steps between two searches for dormant channels, which then begin anew ([`demc_model::dormant`]). 0: none, as in the paper.
    pub recycle: u64,
    /// What happens at a loss or gradient that is not finite.
    pub on_nan: OnNan,
    /// Weights to begin with: a run directory, a checkpoint or an exported file of the same `[model]` and `data.gamma`; they get
    /// used to another `data.demodulate`. Empty: drawn from `seed`.
    pub init: PathBuf,
    /// Seed of weights, validation scenes, shuffling and augmentation.
    pub seed: u64,
}

impl Default for TrainConfig {
    /// The paper's optimisation (Sec. 4.2).
    fn default() -> Self {
        TrainConfig {
            steps: STEPS,
            lr_start: LR_START,
            lr_end: LR_END,
            decay: Decay::Exponential,
            lr_fan_in: 0,
            muon: 0,
            warmup: 0,
            adam_epsilon: ADAM_EPSILON,
            loss: Loss::default(),
            loss_epsilon: demc_model::metrics::LOSS_EPSILON,
            ssim: 0.0,
            smape: 0.0,
            grad_accumulation: 1,
            grad_clip: 0.0,
            ema: 0.0,
            recycle: 0,
            on_nan: OnNan::default(),
            init: PathBuf::new(),
            seed: 1,
        }
    }
}

/// What happens at a loss or gradient that is not finite.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum OnNan {
    /// The run stops and names the scenes.
    #[default]
    Stop,
    /// The step is not taken, and counted.
    Skip,
}

/// The `[run]` table.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct RunConfig {
    /// Run directory; empty: `runs/` and the configuration file's name.
    pub dir: PathBuf,
    /// Steps between two lines of `metrics.jsonl`.
    pub log_every: u64,
    /// Steps between two validations.
    pub validate_every: u64,
    /// Steps between two checkpoints.
    pub checkpoint_every: u64,
    /// Minutes after which a checkpoint is due, whatever the steps; 0: steps alone count.
    pub checkpoint_minutes: f64,
    /// How many of the newest checkpoints stay; the best weights of validation stay beside them.
    pub keep: usize,
    /// Checkpoints whose step is a multiple of this stay for good; 0: none.
    pub keep_every: u64,
}

impl Default for RunConfig {
    fn default() -> Self {
        RunConfig {
            dir: PathBuf::new(),
            log_every: LOG_EVERY,
            validate_every: VALIDATE_EVERY,
            checkpoint_every: CHECKPOINT_EVERY,
            checkpoint_minutes: CHECKPOINT_MINUTES,
            keep: KEEP,
            keep_every: 0,
        }
    }
}
