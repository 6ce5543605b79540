//! The run directory: what it holds, who may use it, and its log.
//!
//! ```text
//! config.toml       the resolved configuration: `demc-train --config RUN/config.toml` repeats the run
//! run.json          versions, device, scenes of each split, statistics of the training scenes
//! metrics.jsonl     one object a line: step, epoch, loss, lr, grad_norm, elapsed_s; on validation valid_relmse, valid_ssim
//! latest, checkpoints/, best.safetensors
//! strips/           pictures of every validation and of the test split
//! test.json         scores of the test split
//! ```

use std::fs::{self, File, OpenOptions};
use std::io::Write;
use std::path::{Path, PathBuf};

use anyhow::{Context, bail, ensure};
use demc_data::file::write_whole;
use demc_data::{Normalizer, Scene};
use serde::{Deserialize, Serialize};

use crate::config::Config;
use crate::data::Data;

/// The resolved configuration.
const CONFIG: &str = "config.toml";
/// What the run was made of.
const RUN: &str = "run.json";
/// Version of Burn, for the record; Burn itself does not tell.
const BURN: &str = "0.22.1";
/// The log.
const METRICS: &str = "metrics.jsonl";

/// A run directory that fits the run at hand.
#[derive(Debug)]
pub struct RunDir {
    path: PathBuf,
}

/// What `run.json` holds.
#[derive(Debug, Serialize, Deserialize)]
struct Record {
    /// Version of this program.
    demc: String,
    /// Version of Burn.
    burn: String,
    /// Device of the first start.
    device: String,
    /// Trainable values of the network.
    parameters: usize,
    /// Patches of an epoch.
    patches: usize,
    /// Names of the scenes of each split.
    scenes: Scenes,
    /// Gamma and the statistics of the training scenes.
    normalizer: Normalizer,
}

#[derive(Debug, PartialEq, Serialize, Deserialize)]
struct Scenes {
    train: Vec<String>,
    validation: Vec<String>,
    test: Vec<String>,
}

impl Scenes {
    fn of(data: &Data) -> Self {
        let names = |scenes: &[Scene]| scenes.iter().map(|scene| scene.name.clone()).collect();
        Scenes {
            train: names(&data.train),
            validation: names(&data.validation),
            test: names(&data.test),
        }
    }
}

/// Facts of a run for `run.json`.
#[derive(Clone, Copy, Debug)]
pub struct Facts<'a> {
    /// Name of the device.
    pub device: &'a str,
    /// Trainable values of the network.
    pub parameters: usize,
    /// Patches of an epoch.
    pub patches: usize,
}

impl RunDir {
    /// Refuses a directory that holds a run unless `resume` is set and the run has the same configuration.
    ///
    /// Writes nothing: a refusal comes before the data is read.
    ///
    /// # Errors
    /// As said, with every key that differs; a saved configuration that cannot be read.
    pub fn claim(config: &Config, resume: bool) -> anyhow::Result<Self> {
        let path = config.run.dir.clone();
        let saved = path.join(CONFIG);
        if saved.exists() {
            let there = Config::load(&saved, &[])?;
            let differences = config.differences(&there);
            ensure!(
                differences.is_empty(),
                "{}: holds a run with another configuration: {}",
                path.display(),
                differences.join("; ")
            );
            if !resume {
                bail!(
                    "{}: holds a run already; --resume continues it, --run-dir takes another directory",
                    path.display()
                );
            }
        }
        Ok(RunDir { path })
    }

    /// The directory.
    pub fn path(&self) -> &Path {
        &self.path
    }

    /// Writes configuration and record of a new run, or compares the record of one that goes on.
    ///
    /// # Errors
    /// A directory that cannot be written; scenes or statistics other than those that the run began with.
    pub fn open(&self, config: &Config, data: &Data, facts: Facts) -> anyhow::Result<()> {
        fs::create_dir_all(&self.path).with_context(|| self.path.display().to_string())?;
        let record = self.path.join(RUN);
        if record.exists() {
            let text = fs::read_to_string(&record).with_context(|| record.display().to_string())?;
            let began: Record =
                serde_json::from_str(&text).with_context(|| record.display().to_string())?;
            let same = began.normalizer == data.normalizer && began.scenes == Scenes::of(data);
            ensure!(
                same,
                "{}: the data is not what this run began with (scenes or statistics)",
                record.display()
            );
            return Ok(());
        }
        let written = Record {
            demc: env!("CARGO_PKG_VERSION").to_string(),
            burn: BURN.to_string(),
            device: facts.device.to_string(),
            parameters: facts.parameters,
            patches: facts.patches,
            scenes: Scenes::of(data),
            normalizer: data.normalizer.clone(),
        };
        let json = serde_json::to_vec_pretty(&written)?;
        write_whole(&record, |file| file.write_all(&json))?;
        write_whole(&self.path.join(CONFIG), |file| {
            file.write_all(config.to_toml().as_bytes())
        })?;
        Ok(())
    }

    /// The log, with the lines after `step` cut off: a resumed run writes them again.
    ///
    /// # Errors
    /// A log that cannot be read or written.
    pub fn metrics(&self, step: u64) -> anyhow::Result<Metrics> {
        let path = self.path.join(METRICS);
        let text = if path.exists() {
            fs::read_to_string(&path)
        } else {
            Ok(String::new())
        };
        let text = text.with_context(|| path.display().to_string())?;
        let kept: String = text
            .split_inclusive('\n')
            .take_while(|line| is_line_until(line, step))
            .collect();
        if kept.len() != text.len() {
            write_whole(&path, |file| file.write_all(kept.as_bytes()))?;
        }
        let file = OpenOptions::new().create(true).append(true).open(&path);
        Ok(Metrics {
            file: file.with_context(|| path.display().to_string())?,
            path,
        })
    }

    /// Writes a file of the run, whole or not at all.
    ///
    /// # Errors
    /// A file that cannot be written.
    pub fn write(&self, name: &str, bytes: &[u8]) -> anyhow::Result<()> {
        Ok(write_whole(&self.path.join(name), |file| {
            file.write_all(bytes)
        })?)
    }
}

/// Whether `text` is a whole line of a step up to `step`.
fn is_line_until(text: &str, step: u64) -> bool {
    let line = text
        .strip_suffix('\n')
        .and_then(|line| serde_json::from_str::<serde_json::Value>(line).ok());
    line.and_then(|line| line.get("step")?.as_u64())
        .is_some_and(|at| at <= step)
}

/// `metrics.jsonl`, open for more.
#[derive(Debug)]
pub struct Metrics {
    file: File,
    path: PathBuf,
}

/// One line of `metrics.jsonl`. Nothing depends on the clock but `elapsed_s`.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct Line {
    /// Steps taken.
    pub step: u64,
    /// Passes over the training patches.
    pub epoch: f64,
    /// Mean training loss (Eq. 5) since the line before.
    pub loss: f64,
    /// Learning rate of the last step.
    pub lr: f64,
    /// Mean norm of the gradient since the line before, before clipping.
    pub grad_norm: f64,
    /// Mean RelMSE of the validation scenes.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub valid_relmse: Option<f64>,
    /// Mean SSIM of the validation scenes.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub valid_ssim: Option<f64>,
    /// Seconds since the start, stops left out.
    pub elapsed_s: f64,
}

impl Metrics {
    /// Appends a line.
    ///
    /// # Errors
    /// A file that cannot be written.
    pub fn append(&mut self, line: &Line) -> anyhow::Result<()> {
        let mut text = serde_json::to_string(line)?;
        text.push('\n');
        self.file
            .write_all(text.as_bytes())
            .with_context(|| self.path.display().to_string())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn line(step: u64) -> Line {
        let [epoch, loss, lr, grad_norm, elapsed_s] = [0.5, 0.1 + 0.2, 1e-4, 2.0, 3.0];
        Line {
            step,
            epoch,
            loss,
            lr,
            grad_norm,
            valid_relmse: None,
            valid_ssim: None,
            elapsed_s,
        }
    }

    #[test]
    fn log_is_cut_to_the_checkpoint_and_a_torn_line_goes() {
        let dir = tempfile::tempdir().unwrap();
        let run = RunDir {
            path: dir.path().into(),
        };
        let mut metrics = run.metrics(0).unwrap();
        for step in [10, 20, 30] {
            metrics.append(&line(step)).unwrap();
        }
        let path = dir.path().join(METRICS);
        let whole = fs::read_to_string(&path).unwrap();
        fs::write(&path, format!("{whole}{{\"step\": 2")).unwrap();
        run.metrics(20).unwrap();
        let cut = fs::read_to_string(&path).unwrap();
        assert_eq!(cut.lines().count(), 2);
        assert!(whole.starts_with(&cut));
    }

    #[test]
    fn recorded_version_of_burn_is_the_pinned_one() {
        let manifest = concat!(env!("CARGO_MANIFEST_DIR"), "/../Cargo.toml");
        let manifest: toml::Table = fs::read_to_string(manifest).unwrap().parse().unwrap();
        let burn = &manifest["workspace"]["dependencies"]["burn"]["version"];
        assert_eq!(burn.as_str(), Some(format!("={BURN}").as_str()));
    }

    #[test]
    fn lines_without_validation_have_no_such_keys() {
        let json = serde_json::to_string(&line(1)).unwrap();
        assert!(
            json.starts_with("{\"step\":1,\"epoch\":0.5,\"loss\":0.30000000000000004,"),
            "{json}"
        );
        assert!(!json.contains("valid_"));
    }
}
