//! The run directory: its files and its lock.
//!
//! ```text
//! config.toml       the resolved configuration, which repeats the run
//! layout.toml       the channel layout, if it is not a preset
//! run.json          versions, device, scenes of each split, statistics, checksum of train.init
//! metrics.jsonl     one object per line, see `metrics_log`
//! tensorboard/      metrics and pictures for TensorBoard
//! latest, checkpoints/, best.safetensors
//! strips/           pictures of every validation and of the test split
//! test.json         scores of the test split
//! ```

use std::fs::{self, File};
use std::io::Write;
use std::path::{Path, PathBuf};

use anyhow::{Context, bail, ensure};
use demc_data::file::{remove_abandoned, write_whole};
use demc_data::{ChannelLayout, Normalizer, Scene};
use demc_infer::bundle::locate::{BEST, LATEST};
use serde::{Deserialize, Serialize};

use crate::config::Config;
use crate::record::metrics_log::MetricsLog;
use crate::run::checkpoint::store::CheckpointStore;
use crate::run::data::RunData;
use crate::run::initial::InitialWeights;

const CONFIG: &str = "config.toml";
/// The record of versions, device and data.
const RUN: &str = "run.json";
/// The manifest that pins the version of Burn; Burn itself exports none.
const MANIFEST: &str = include_str!("../../../Cargo.toml");
const METRICS: &str = "metrics.jsonl";
/// The channel layout, if it is not a preset.
const LAYOUT: &str = "layout.toml";
/// Locked by the training process.
const LOCK: &str = "lock";
/// Files that describe the run, copied into its checkpoints.
pub const OWN_FILES: [&str; 3] = [CONFIG, RUN, LAYOUT];
/// Scores of the test split.
pub const SCORES: &str = "test.json";
/// Files that show that a directory contains a run.
const TRACES: [&str; 4] = [RUN, METRICS, "checkpoints", LATEST];

/// The files in `dir` that a run replaces if they exist.
pub fn replaced_files(dir: &Path) -> Vec<PathBuf> {
    let mut names = vec![METRICS, LATEST, BEST, SCORES, "strips/test.png"];
    if !dir.join(CONFIG).exists() {
        names.push(LAYOUT);
    }
    names.into_iter().map(|name| dir.join(name)).collect()
}

/// The directory of a run.
#[derive(Debug)]
pub struct RunDir {
    path: PathBuf,
    /// Held while the run writes.
    lock: Option<File>,
}

#[derive(Debug, Serialize, Deserialize)]
struct RunRecord {
    demc: String,
    burn: String,
    /// Device of the first start.
    device: String,
    /// Implementation of the operations on the first start.
    #[serde(default)]
    operations: String,
    /// Number of trainable parameters.
    parameters: u64,
    patches: usize,
    /// Names of the scenes of each split.
    scenes: SceneNames,
    /// Gamma and the statistics of the training scenes.
    normalizer: Normalizer,
    /// Channels of the files.
    layout: ChannelLayout,
    /// The weights of `train.init`, if any.
    #[serde(default)]
    init: Option<InitialWeights>,
}

impl RunRecord {
    fn new(data: &RunData, facts: RunFacts) -> Self {
        RunRecord {
            demc: env!("CARGO_PKG_VERSION").to_string(),
            burn: burn_version(),
            device: facts.device.to_string(),
            operations: facts.operations.to_string(),
            parameters: facts.parameters,
            patches: facts.patches,
            scenes: SceneNames::of(data),
            normalizer: data.normalizer.clone(),
            layout: data.layout.clone(),
            init: facts.initial.cloned(),
        }
    }
}

#[derive(Debug, PartialEq, Serialize, Deserialize)]
struct SceneNames {
    train: Vec<String>,
    validation: Vec<String>,
    test: Vec<String>,
}

impl SceneNames {
    fn of(data: &RunData) -> Self {
        let names = |scenes: &[Scene]| scenes.iter().map(|scene| scene.name.clone()).collect();
        SceneNames {
            train: names(&data.train),
            validation: names(&data.validation),
            test: names(&data.test),
        }
    }
}

/// What `run.json` records besides the data.
#[derive(Clone, Copy, Debug)]
pub struct RunFacts<'a> {
    /// Name of the device.
    pub device: &'a str,
    /// Implementation of the operations.
    pub operations: &'a str,
    /// Number of trainable parameters.
    pub parameters: u64,
    /// Patches per epoch.
    pub patches: usize,
    /// The weights of `train.init`, if the run is new and has any.
    pub initial: Option<&'a InitialWeights>,
}

impl RunDir {
    /// The directory of a run, if it is free or contains the same run and `resume` is set. Writes
    /// nothing.
    ///
    /// If the saved configuration is missing, that of the newest intact checkpoint is used.
    ///
    /// # Errors
    /// A directory with a run that is not to be resumed, or with another run: each differing key is
    /// named.
    pub fn claim(config: &Config, resume: bool) -> anyhow::Result<Self> {
        let path = config.run_dir().to_path_buf();
        let dir = RunDir {
            path: path.clone(),
            lock: None,
        };
        let trace = OWN_FILES.iter().chain(&TRACES);
        let Some(trace) = trace.into_iter().find(|name| path.join(name).exists()) else {
            return Ok(dir);
        };
        let saved = match path.join(CONFIG) {
            saved if saved.exists() => Some(saved),
            _ => {
                let checkpoint = CheckpointStore::new(&path).newest_intact()?.intact;
                checkpoint.map(|dir| dir.join(CONFIG))
            }
        };
        if let Some(saved) = &saved {
            let saved = Config::load(saved, &[])?;
            let differences = config.differences(&saved);
            ensure!(
                differences.is_empty(),
                "{}: contains a run with another configuration: {}",
                path.display(),
                differences.join("; ")
            );
        }
        if !resume {
            bail!(
                "{}: already contains a run ({trace}); --resume resumes it, --run-dir names another directory",
                path.display()
            );
        }
        Ok(dir)
    }

    /// Locks the directory, if it exists, against other training processes. Removes incomplete files
    /// of killed ones.
    ///
    /// # Errors
    /// A directory that another process has locked.
    pub fn lock_if_present(&mut self) -> anyhow::Result<()> {
        if self.path.is_dir() {
            self.lock()?;
            for dir in [self.path.clone(), self.path.join("strips")] {
                remove_abandoned(&dir, None);
            }
        }
        Ok(())
    }

    /// The directory.
    pub fn path(&self) -> &Path {
        &self.path
    }

    /// Creates and locks the directory. Writes configuration and record of a new run; compares the
    /// record of a resumed one. Returns a note if its versions or device changed.
    ///
    /// # Errors
    /// A directory that cannot be written or is in use; other scenes, statistics or layout than at
    /// the start of the run.
    pub fn open(
        &mut self,
        config: &Config,
        data: &RunData,
        facts: RunFacts,
    ) -> anyhow::Result<Option<String>> {
        let made = fs::create_dir_all(&self.path);
        made.with_context(|| format!("cannot create {}", self.path.display()))?;
        if self.lock.is_none() {
            self.lock()?;
        }
        if !self.path.join(CONFIG).exists() {
            let mut saved = config.clone();
            if config.data.layout.ends_with(".toml") {
                self.write(LAYOUT, toml::to_string(&data.layout)?.as_bytes())?;
                saved.data.layout = self.path.join(LAYOUT).to_string_lossy().into_owned();
            }
            self.write(CONFIG, saved.to_toml().as_bytes())?;
        }
        let record = self.path.join(RUN);
        if !record.exists() {
            let written = RunRecord::new(data, facts);
            self.write(RUN, &serde_json::to_vec_pretty(&written)?)?;
            return Ok(None);
        }
        let text = fs::read_to_string(&record).with_context(|| record.display().to_string())?;
        let first: RunRecord =
            serde_json::from_str(&text).with_context(|| record.display().to_string())?;
        let now = RunRecord::new(data, facts);
        for (what, same) in [
            ("scenes", first.scenes == now.scenes),
            ("statistics", first.normalizer == now.normalizer),
            ("channel layout", first.layout == now.layout),
        ] {
            ensure!(
                same,
                "{}: the run started with different {what}",
                record.display()
            );
        }
        let versions = |record: &RunRecord| {
            format!(
                "demc {}, Burn {}, {}, {}",
                record.demc, record.burn, record.device, record.operations
            )
        };
        let (then, now) = (versions(&first), versions(&now));
        Ok((then != now)
            .then(|| format!("this run started on {then}; on {now} its bits may differ")))
    }

    fn lock(&mut self) -> anyhow::Result<()> {
        let path = self.path.join(LOCK);
        let file = File::create(&path).with_context(|| path.display().to_string())?;
        if file.try_lock().is_err() {
            bail!(
                "{}: in use by another training process",
                self.path.display()
            );
        }
        self.lock = Some(file);
        Ok(())
    }

    /// The log, without the lines after `step`, which a resumed run repeats.
    ///
    /// # Errors
    /// A log that cannot be read or written.
    pub fn metrics(&self, step: u64) -> anyhow::Result<MetricsLog> {
        MetricsLog::open(&self.path.join(METRICS), step)
    }

    /// Writes a file of the run, complete or not at all.
    ///
    /// # Errors
    /// A file that cannot be written.
    pub fn write(&self, name: &str, bytes: &[u8]) -> anyhow::Result<()> {
        Ok(write_whole(&self.path.join(name), |file| {
            file.write_all(bytes)
        })?)
    }
}

fn burn_version() -> String {
    let manifest: toml::Table = MANIFEST.parse().expect("the manifest that Cargo read");
    let pinned = manifest["workspace"]["dependencies"]["burn"]["version"].as_str();
    let pinned = pinned.and_then(|version| version.strip_prefix('='));
    pinned.expect("Burn is pinned").to_string()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_recorded_version_of_burn_is_a_version() {
        let version = burn_version();
        let numbers = version.split('.').map(str::parse::<u32>);
        assert_eq!(numbers.filter(Result::is_ok).count(), 3, "{version}");
    }
}
