//! Checkpoints: everything that an exact resume of a run needs.
//!
//! ```text
//! RUN/latest                        text: step-00000500
//! RUN/checkpoints/step-00000500/
//!     model.safetensors             bundle of the network in training
//!     average.safetensors           bundle of the averaged network, with train.ema_decay
//!     optimizer.safetensors         state of the optimizer
//!     state.json                    state of the training loop
//!     best.safetensors              best weights so far, a hard link if possible
//!     config.toml, run.json, ...    copies of the run's files
//!     SHA256SUMS                    checksums of all of them
//! ```
//!
//! A checkpoint alone restores a run directory that lost everything else, except its log.

pub mod store;

use std::fs;
use std::io::Write;
use std::path::Path;
use std::time::{Duration, Instant};

use anyhow::{Context, bail, ensure};
use burn::tensor::Device;
use demc_infer::bundle::locate::{AVERAGE, BEST, MODEL};
use demc_infer::bundle::{Bundle, Names, Precision, tensors};
use demc_model::Denoiser;
use demc_program::file::write_whole;
use serde::{Deserialize, Serialize};

use crate::config::Config;
use crate::run::run_record::{OWN_FILES, is_usable};
use crate::run::warnings::WarningState;
use crate::step::optimizer::Optimizer;
use store::CheckpointStore;

/// Version of a checkpoint's files; raised when a meaning changes.
pub const FORMAT: u32 = 2;
const OPTIMIZER: &str = "optimizer.safetensors";
const STATE: &str = "state.json";

/// The state of the training loop between two steps.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct TrainingProgress {
    /// [`FORMAT`].
    pub format: u32,
    /// Steps of the run so far, skipped ones included.
    pub step: u64,
    /// Steps skipped because loss or gradient were not finite.
    pub skipped: u64,
    /// Best validation so far.
    pub best: Option<BestValidation>,
    /// Sums for the next line of `metrics.jsonl`.
    pub since_log: MetricSums,
    /// State of the warnings.
    pub watch: WarningState,
    /// Seconds of training, without the time between sessions.
    pub elapsed_s: f64,
}

/// The best validation of a run.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct BestValidation {
    /// Its step.
    pub step: u64,
    /// Its mean RelMSE.
    pub relmse: f64,
}

/// Sums of metrics that are logged as means.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct MetricSums {
    /// Steps in the sums.
    pub steps: u64,
    /// Sum of the losses.
    pub loss: f64,
    /// Sum of the gradient norms.
    pub grad_norm: f64,
}

impl TrainingProgress {
    /// The state before the first step.
    pub fn start() -> Self {
        TrainingProgress {
            format: FORMAT,
            step: 0,
            skipped: 0,
            best: None,
            since_log: MetricSums::default(),
            watch: WarningState::default(),
            elapsed_s: 0.0,
        }
    }

    /// One sentence on which weights a run of `steps` steps keeps, and why.
    pub fn kept_weights(&self, steps: u64) -> String {
        match self.best {
            Some(BestValidation { step, relmse }) => format!(
                "kept weights: those of step {step} of {steps}, with the best validation RelMSE {relmse:.4}"
            ),
            None => format!("kept weights: those of the last step {steps}, no scene is held out"),
        }
    }
}

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

/// A checkpoint in memory.
pub struct Checkpoint {
    /// The network in training, with statistics, layout and step.
    pub bundle: Bundle,
    /// The averaged network, without autodiff.
    pub average: Option<Denoiser>,
    /// The optimizer.
    pub optimizer: Optimizer,
    /// The training loop.
    pub state: TrainingProgress,
}

/// Writes a checkpoint of the run in `run`: the network in training and the averaged one, without
/// autodiff.
///
/// # Errors
/// A file that cannot be written. Earlier checkpoints stay; the last intact one is named.
pub fn save(
    run: &Path,
    bundle: &Bundle,
    average: Option<&Bundle>,
    optimizer: &Optimizer,
    state: &TrainingProgress,
    keep: usize,
) -> anyhow::Result<()> {
    let bytes = |bundle: &Bundle| bundle.to_bytes(Names::Burn, Precision::F32);
    let mut files = vec![
        (MODEL, bytes(bundle)?),
        (OPTIMIZER, tensors::to_bytes(&optimizer.state())?),
        (STATE, serde_json::to_vec_pretty(state)?),
    ];
    if let Some(average) = average {
        files.push((AVERAGE, bytes(average)?));
    }
    for name in OWN_FILES {
        if let Ok(bytes) = fs::read(run.join(name)) {
            files.push((name, bytes));
        }
    }
    let best = run.join(BEST);
    let linked = state.best.map(|_| (BEST, &*best));
    CheckpointStore::new(run).write(state.step, &files, linked, keep)
}

/// Reads a checkpoint onto `device`.
///
/// # Errors
/// A file that is missing, of another version, or inconsistent with the others.
pub fn load(dir: &Path, config: &Config, device: &Device) -> anyhow::Result<Checkpoint> {
    let state = read_state(&dir.join(STATE))?;
    let bundle = Bundle::load(&dir.join(MODEL), device)?;
    let step = bundle.meta.step;
    ensure!(
        step == state.step,
        "{}: expected step {}, as in {STATE}, found {step}",
        dir.join(MODEL).display(),
        state.step
    );
    let plain = device.clone().without_autodiff();
    let average_file = dir.join(AVERAGE);
    let average = if average_file.exists() {
        Some(Bundle::load(&average_file, &plain)?.model)
    } else {
        None
    };
    let path = dir.join(OPTIMIZER);
    let bytes = fs::read(&path).with_context(|| path.display().to_string())?;
    let moments = tensors::from_bytes(&bytes)
        .map_err(|error| anyhow::anyhow!("{}: {error}", path.display()))?;
    let taken = state.step - state.skipped;
    let optimizer = Optimizer::restore(config, taken, moments, &plain)
        .map_err(|name| anyhow::anyhow!("{}: moment {name} has no partner", path.display()))?;
    ensure!(
        optimizer.is_complete() || taken == 0,
        "{}: state of another network or optimizer",
        path.display()
    );
    Ok(Checkpoint {
        bundle,
        average,
        optimizer,
        state,
    })
}

fn read_state(path: &Path) -> anyhow::Result<TrainingProgress> {
    let text = fs::read_to_string(path).with_context(|| path.display().to_string())?;
    let version: serde_json::Value =
        serde_json::from_str(&text).with_context(|| path.display().to_string())?;
    let format = version.get("format").and_then(serde_json::Value::as_u64);
    if format != Some(FORMAT.into()) {
        let found = format.map_or("none".to_string(), |format| format.to_string());
        bail!(
            "{}: format {found}; this build reads format {FORMAT}",
            path.display()
        );
    }
    serde_json::from_value(version).with_context(|| path.display().to_string())
}

/// Restores the run in `run` to the checkpoint `dir`: its best weights, and the run's files if they
/// are missing or damaged. Returns a note for each restored file.
///
/// # Errors
/// A file that cannot be read or written.
pub fn restore_run(run: &Path, dir: &Path) -> anyhow::Result<Vec<String>> {
    let mut notes = Vec::new();
    for name in OWN_FILES.into_iter().chain([BEST]) {
        let (current, saved) = (run.join(name), dir.join(name));
        if !saved.exists() {
            continue;
        }
        let bytes = fs::read(&saved).with_context(|| saved.display().to_string())?;
        let state = match fs::read(&current) {
            Ok(found) if found == bytes || is_usable(name, &found) => continue,
            // Best weights may be of a later step, which the run repeats.
            Ok(_) if name == BEST => None,
            Ok(_) => Some("damaged"),
            Err(_) => Some("missing"),
        };
        notes.extend(state.map(|state| {
            format!(
                "{} was {state}: restored from {}",
                current.display(),
                dir.display()
            )
        }));
        write_whole(&current, |file| file.write_all(&bytes))?;
    }
    Ok(notes)
}
