//! Checkpoints: everything that a stopped run needs to go on bit for bit.
//!
//! ```text
//! RUN/latest                                              text: step-00000500
//! RUN/checkpoints/step-00000500/model.safetensors         a bundle of the network in training
//! RUN/checkpoints/step-00000500/average.safetensors       a bundle of the averaged network, with train.ema
//! RUN/checkpoints/step-00000500/optimizer.safetensors     the optimizer's moments by weight
//! RUN/checkpoints/step-00000500/state.json                the state of the loop
//! RUN/checkpoints/step-00000500/best.safetensors          the best weights so far (a link, where the file system has links)
//! RUN/checkpoints/step-00000500/config.toml, run.json, ... copies of the run's own files
//! RUN/checkpoints/step-00000500/SHA256SUMS                of all of them
//! ```
//!
//! So a checkpoint alone brings back a run directory that lost everything else but its log.

mod store;

use std::fs;
use std::io::Write;
use std::path::Path;

use anyhow::{Context, bail, ensure};
use burn::tensor::Device;
use demc_data::file::write_whole;
use demc_infer::bundle::locate::{AVERAGE, BEST, MODEL};
use demc_infer::bundle::{Bundle, Names, Precision, tensors};
use demc_model::Denoiser;
use serde::{Deserialize, Serialize};

use crate::config::TrainConfig;
use crate::optimizer::Optimizer;
use crate::run_dir::OWN_FILES;
use crate::watch::Watch;
pub use store::{Found, Keep, Store, sha256_of};

/// Version of a checkpoint's files; goes up when a meaning changes.
pub const FORMAT: u32 = 2;
/// The optimizer's moments.
const OPTIMIZER: &str = "optimizer.safetensors";
/// The state of the loop.
const STATE: &str = "state.json";

/// The state of the training loop between two steps.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct State {
    /// [`FORMAT`].
    pub format: u32,
    /// Steps of the run so far, skipped ones included.
    pub step: u64,
    /// Steps that were not taken, because loss or gradient were not finite.
    pub skipped: u64,
    /// Best validation so far.
    pub best: Option<Best>,
    /// What the next line of `metrics.jsonl` has seen so far.
    pub since_log: Means,
    /// What the warnings have seen so far.
    pub watch: Watch,
    /// Seconds that the run has taken, stops left out.
    pub elapsed_s: f64,
}

/// The best validation of a run.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct Best {
    /// Its step.
    pub step: u64,
    /// Its mean RelMSE.
    pub relmse: f64,
}

/// Sums of what is reported as means.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct Means {
    /// Steps in the sums.
    pub steps: u64,
    /// Sum of the losses.
    pub loss: f64,
    /// Sum of the gradient norms.
    pub grad_norm: f64,
}

impl State {
    /// Before the first step.
    pub fn start() -> Self {
        State {
            format: FORMAT,
            step: 0,
            skipped: 0,
            best: None,
            since_log: Means::default(),
            watch: Watch::default(),
            elapsed_s: 0.0,
        }
    }
}

/// A checkpoint in memory.
pub struct Checkpoint {
    /// The network, on the device it was loaded to, with statistics, layout and step.
    pub bundle: Bundle,
    /// The averaged network, on the plain device.
    pub average: Option<Denoiser>,
    /// The optimizer.
    pub optimizer: Optimizer,
    /// The loop.
    pub state: State,
}

/// Writes a checkpoint of the run in `run`: the network in training and the averaged one, both on a plain device.
///
/// # Errors
/// A file that cannot be written; the checkpoints before it are then untouched, and the last is named.
pub fn save(
    run: &Path,
    bundle: &Bundle,
    average: Option<&Bundle>,
    optimizer: &Optimizer,
    state: &State,
    keep: Keep,
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
    Store::new(run).write(state.step, &files, linked, keep)
}

/// Reads a checkpoint onto `device`.
///
/// # Errors
/// A file that is not there, of another version, or does not fit the others.
pub fn load(dir: &Path, config: &TrainConfig, device: &Device) -> anyhow::Result<Checkpoint> {
    let state = read_state(&dir.join(STATE))?;
    let bundle = Bundle::load(&dir.join(MODEL), device)?;
    let step = bundle.meta.step;
    ensure!(
        step == state.step,
        "{}: of step {step}, {STATE} of step {}",
        dir.join(MODEL).display(),
        state.step
    );
    let plain = device.clone().without_autodiff();
    let average = dir.join(AVERAGE);
    let average = match average.exists() {
        true => Some(Bundle::load(&average, &plain)?.model),
        false => None,
    };
    let path = dir.join(OPTIMIZER);
    let bytes = fs::read(&path).with_context(|| path.display().to_string())?;
    let moments = tensors::from_bytes(&bytes)
        .map_err(|error| anyhow::anyhow!("{}: {error}", path.display()))?;
    let taken = state.step - state.skipped;
    let optimizer = Optimizer::restore(config, taken, moments, &plain)
        .map_err(|name| anyhow::anyhow!("{}: moment {name} has no partner", path.display()))?;
    ensure!(
        optimizer.fits(&bundle.model.weights()) || taken == 0,
        "{}: moments of another network",
        path.display()
    );
    Ok(Checkpoint {
        bundle,
        average,
        optimizer,
        state,
    })
}

fn read_state(path: &Path) -> anyhow::Result<State> {
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

/// Brings the run in `run` to where the checkpoint `dir` left it: its best weights, and the run's own files where they are
/// gone. Returns what was brought back.
///
/// # Errors
/// A file that cannot be read or written.
pub fn restore_run(run: &Path, dir: &Path) -> anyhow::Result<Vec<String>> {
    let mut notes = Vec::new();
    for name in OWN_FILES.into_iter().chain([BEST]) {
        let (there, kept) = (run.join(name), dir.join(name));
        if !kept.exists() {
            continue;
        }
        let bytes = fs::read(&kept).with_context(|| kept.display().to_string())?;
        match fs::read(&there) {
            // Best weights may be of a later step, which will be taken again.
            Ok(found) if name != BEST || found == bytes => continue,
            Ok(_) => {}
            Err(_) => notes.push(format!(
                "{} was gone: brought back from {}",
                there.display(),
                dir.display()
            )),
        }
        write_whole(&there, |file| file.write_all(&bytes))?;
    }
    Ok(notes)
}
