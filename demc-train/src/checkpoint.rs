//! Checkpoints: everything that a stopped run needs to go on bit for bit.
//!
//! ```text
//! RUN/latest                                              text: step-00000500
//! RUN/checkpoints/step-00000500/model.safetensors         a bundle, as `demc-infer` reads it
//! RUN/checkpoints/step-00000500/optimizer.safetensors     Adam's moments by weight
//! RUN/checkpoints/step-00000500/state.json                the state of the loop
//! ```
//!
//! A checkpoint is written under a temporary name and renamed; `latest` is moved on last.

use std::collections::HashMap;
use std::fs;
use std::io::Write;
use std::path::Path;

use anyhow::{Context, bail, ensure};
use burn::tensor::Device;
use demc_data::file::write_whole;
use demc_infer::bundle::locate::{CHECKPOINTS, LATEST, MODEL};
use demc_infer::bundle::{Bundle, Names, Precision};
use demc_model::Weight;
use safetensors::tensor::{Dtype, SafeTensors, TensorView};
use serde::{Deserialize, Serialize};

use crate::optimizer::Adam;

/// Version of a checkpoint's files; goes up when a meaning changes.
pub const FORMAT: u32 = 1;
/// Adam's moments.
const OPTIMIZER: &str = "optimizer.safetensors";
/// The state of the loop.
const STATE: &str = "state.json";
/// Ending of a checkpoint that is being written.
const UNFINISHED: &str = ".tmp";

/// The state of the training loop between two steps.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct State {
    /// [`FORMAT`].
    pub format: u32,
    /// Steps taken.
    pub step: u64,
    /// Best validation so far.
    pub best: Option<Best>,
    /// What the next line of `metrics.jsonl` has seen so far.
    pub since_log: Means,
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
            best: None,
            since_log: Means::default(),
            elapsed_s: 0.0,
        }
    }
}

/// A checkpoint in memory.
pub struct Checkpoint {
    /// The network, on the device it was loaded to, with statistics, layout and step.
    pub bundle: Bundle,
    /// The optimizer.
    pub adam: Adam,
    /// The loop.
    pub state: State,
}

/// Writes a checkpoint of the run in `run`, points `latest` at it and removes all but the newest `keep`.
///
/// # Errors
/// A file that cannot be written; the checkpoints before it are then untouched.
pub fn save(
    run: &Path,
    bundle: &Bundle,
    adam: &Adam,
    state: &State,
    keep: usize,
) -> anyhow::Result<()> {
    let name = format!("step-{:08}", state.step);
    let all = run.join(CHECKPOINTS);
    let (unfinished, finished) = (all.join(format!("{name}{UNFINISHED}")), all.join(&name));
    let written = write_files(&unfinished, bundle, adam, state).and_then(|()| {
        remove(&finished)?;
        fs::rename(&unfinished, &finished).with_context(|| finished.display().to_string())
    });
    if let Err(error) = written {
        // What was being written is worth nothing; the error is what counts.
        let _ = fs::remove_dir_all(&unfinished);
        return Err(error.context("writing a checkpoint"));
    }
    write_whole(&run.join(LATEST), |file| writeln!(file, "{name}"))?;
    prune(&all, &name, keep)
}

fn write_files(dir: &Path, bundle: &Bundle, adam: &Adam, state: &State) -> anyhow::Result<()> {
    remove(dir)?;
    fs::create_dir_all(dir).with_context(|| dir.display().to_string())?;
    bundle.save(&dir.join(MODEL), Names::Burn, Precision::F32)?;
    let moments = moments_bytes(&adam.state())?;
    write_whole(&dir.join(OPTIMIZER), |file| file.write_all(&moments))?;
    let state = serde_json::to_vec_pretty(state)?;
    write_whole(&dir.join(STATE), |file| file.write_all(&state))?;
    Ok(())
}

/// Reads the newest checkpoint of the run in `run` onto `device`; `None` where there is none.
///
/// # Errors
/// A checkpoint that is cut short, of another version, or not of one piece.
pub fn load_latest(
    run: &Path,
    adam_epsilon: f32,
    device: &Device,
) -> anyhow::Result<Option<Checkpoint>> {
    let latest = run.join(LATEST);
    if !latest.exists() {
        let all = run.join(CHECKPOINTS);
        let empty = fs::read_dir(&all).map_or(true, |mut entries| entries.next().is_none());
        ensure!(
            empty,
            "{}: missing, but there are checkpoints in {}; write the name of one into it",
            latest.display(),
            all.display()
        );
        return Ok(None);
    }
    let name = fs::read_to_string(&latest).with_context(|| latest.display().to_string())?;
    ensure!(!name.trim().is_empty(), "{}: empty", latest.display());
    let dir = run.join(CHECKPOINTS).join(name.trim());
    load(&dir, adam_epsilon, device)
        .with_context(|| format!("checkpoint {}", dir.display()))
        .map(Some)
}

fn load(dir: &Path, adam_epsilon: f32, device: &Device) -> anyhow::Result<Checkpoint> {
    let path = dir.join(STATE);
    let text = fs::read_to_string(&path).with_context(|| path.display().to_string())?;
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
    let state: State =
        serde_json::from_value(version).with_context(|| path.display().to_string())?;
    let bundle = Bundle::load(&dir.join(MODEL), device)?;
    let step = bundle.meta.step;
    ensure!(
        step == state.step,
        "{MODEL} is of step {step}, {STATE} of step {}",
        state.step
    );
    let path = dir.join(OPTIMIZER);
    let bytes = fs::read(&path).with_context(|| path.display().to_string())?;
    let moments = moments_from(&bytes).with_context(|| path.display().to_string())?;
    let expected = bundle
        .model
        .weights()
        .iter()
        .filter(|weight| weight.is_trainable())
        .count();
    ensure!(
        moments.len() == 2 * expected || step == 0,
        "{}: moments of another network",
        path.display()
    );
    let adam = Adam::restore(
        adam_epsilon,
        state.step,
        moments,
        &device.clone().without_autodiff(),
    )
    .map_err(|name| anyhow::anyhow!("{}: moment {name} has no partner", path.display()))?;
    Ok(Checkpoint {
        bundle,
        adam,
        state,
    })
}

fn moments_bytes(moments: &[Weight]) -> anyhow::Result<Vec<u8>> {
    let bytes: Vec<Vec<u8>> = moments
        .iter()
        .map(|moment| {
            moment
                .data
                .iter()
                .flat_map(|value| value.to_le_bytes())
                .collect()
        })
        .collect();
    let views = moments.iter().zip(&bytes).map(|(moment, bytes)| {
        let view = TensorView::new(Dtype::F32, moment.shape.clone(), bytes)?;
        Ok((moment.name.as_str(), view))
    });
    let views = views.collect::<Result<Vec<_>, safetensors::SafeTensorError>>()?;
    Ok(safetensors::serialize(
        views,
        None::<HashMap<String, String>>,
    )?)
}

fn moments_from(bytes: &[u8]) -> anyhow::Result<Vec<Weight>> {
    let file = SafeTensors::deserialize(bytes)?;
    let moments = file.tensors().into_iter().map(|(name, view)| {
        ensure!(
            view.dtype() == Dtype::F32,
            "moment {name} is {:?}, expected F32",
            view.dtype()
        );
        let words = view.data().chunks_exact(4);
        let data = words
            .map(|word| f32::from_le_bytes([word[0], word[1], word[2], word[3]]))
            .collect();
        Ok(Weight {
            name,
            shape: view.shape().to_vec(),
            data,
        })
    });
    moments.collect()
}

/// Removes all checkpoints but `name` and the newest others, `keep` in all, and what unfinished ones left behind. What is
/// not named like a checkpoint is not ours.
fn prune(all: &Path, name: &str, keep: usize) -> anyhow::Result<()> {
    let entries = fs::read_dir(all).with_context(|| all.display().to_string())?;
    let mut old = Vec::new();
    for entry in entries {
        let entry = entry
            .with_context(|| all.display().to_string())?
            .file_name();
        let entry = entry.to_string_lossy().into_owned();
        let finished = entry.strip_suffix(UNFINISHED).unwrap_or(&entry);
        let step = finished.strip_prefix("step-").unwrap_or_default();
        if step.len() >= 8 && step.bytes().all(|b| b.is_ascii_digit()) && entry != name {
            old.push((finished == entry, entry));
        }
    }
    // Unfinished ones first, then by step.
    old.sort();
    let finished = old.iter().filter(|(finished, _)| *finished).count();
    let removed = old.len() - finished.min(keep - 1);
    old[..removed]
        .iter()
        .try_for_each(|(_, entry)| remove(&all.join(entry)))
}

fn remove(dir: &Path) -> anyhow::Result<()> {
    match dir.exists() {
        true => fs::remove_dir_all(dir).with_context(|| dir.display().to_string()),
        false => Ok(()),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn only_old_checkpoints_are_pruned() {
        let dir = tempfile::tempdir().unwrap();
        let all = dir.path();
        for name in [
            "step-00000001",
            "step-00000002",
            "step-00000003.tmp",
            "step-00000009",
            "keep-me",
        ] {
            fs::create_dir(all.join(name)).unwrap();
        }
        fs::write(all.join("notes.txt"), "mine").unwrap();
        prune(all, "step-00000002", 2).unwrap();
        let mut left: Vec<_> = fs::read_dir(all)
            .unwrap()
            .map(|entry| entry.unwrap().file_name().into_string().unwrap())
            .collect();
        left.sort();
        assert_eq!(
            left,
            ["keep-me", "notes.txt", "step-00000002", "step-00000009"]
        );
    }

    #[test]
    fn lost_latest_is_an_error_and_no_run_is_none() {
        let dir = tempfile::tempdir().unwrap();
        let load = || load_latest(dir.path(), 1e-8, &Device::flex().autodiff());
        assert!(load().unwrap().is_none());
        fs::create_dir_all(dir.path().join("checkpoints/step-00000001")).unwrap();
        let error = load().err().unwrap().to_string();
        assert!(error.contains("latest: missing"), "{error}");
    }
}
