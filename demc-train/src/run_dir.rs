//! The run directory: what it holds, who may use it, and its log.
//!
//! ```text
//! config.toml       the resolved configuration: `demc-train --config RUN/config.toml` repeats the run
//! layout.toml       the channel layout, where it is not a preset
//! run.json          versions, device, scenes of each split, statistics of the training scenes, checksum of train.init
//! metrics.jsonl     one object a line, see `metrics_log`
//! tensorboard/      the same and the pictures, for TensorBoard
//! latest, checkpoints/, best.safetensors
//! strips/           pictures of every validation and of the test split
//! test.json         scores of the test split
//! ```

use std::fs::{self, File};
use std::io::Write;
use std::path::{Path, PathBuf};

use anyhow::{Context, bail, ensure};
use demc_data::file::write_whole;
use demc_data::{ChannelLayout, Normalizer, Scene};
use serde::{Deserialize, Serialize};

use crate::checkpoint::Store;
use crate::config::Config;
use crate::data::Data;
use crate::initial::Origin;
use crate::metrics_log::Metrics;

/// The resolved configuration.
const CONFIG: &str = "config.toml";
/// What the run was made of.
const RUN: &str = "run.json";
/// Version of Burn, for the record; Burn itself does not tell.
const BURN: &str = "0.22.1";
/// The log.
const METRICS: &str = "metrics.jsonl";
/// The layout of a run that uses one of its own.
const LAYOUT: &str = "layout.toml";
/// Locked by the process that trains.
const LOCK: &str = "lock";
/// The files of a run that it is made of, copied into its checkpoints.
pub const OWN_FILES: [&str; 3] = [CONFIG, RUN, LAYOUT];
/// Ending of a hidden file that was being written.
const TEMPORARY: &str = ".tmp";
/// What shows that a directory holds a run.
const TRACES: [&str; 4] = [RUN, METRICS, "checkpoints", "latest"];

/// A run directory that fits the run at hand.
#[derive(Debug)]
pub struct RunDir {
    path: PathBuf,
    /// Held for as long as the run writes here.
    lock: Option<File>,
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
    /// Operations of the first start; empty in a run that began before there was a choice.
    #[serde(default)]
    operations: String,
    /// Trainable values of the network.
    parameters: u64,
    /// Patches of an epoch.
    patches: usize,
    /// Names of the scenes of each split.
    scenes: Scenes,
    /// Gamma and the statistics of the training scenes.
    normalizer: Normalizer,
    /// Which channels the planes were read from.
    layout: ChannelLayout,
    /// The trained network that it began with, if any.
    #[serde(default)]
    init: Option<Origin>,
}

impl Record {
    fn new(data: &Data, facts: Facts) -> Self {
        Record {
            demc: env!("CARGO_PKG_VERSION").to_string(),
            burn: BURN.to_string(),
            device: facts.device.to_string(),
            operations: facts.operations.to_string(),
            parameters: facts.parameters,
            patches: facts.patches,
            scenes: Scenes::of(data),
            normalizer: data.normalizer.clone(),
            layout: data.layout.clone(),
            init: facts.origin.cloned(),
        }
    }
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
    /// The operations that run there, and on which instructions.
    pub operations: &'a str,
    /// Trainable values of the network.
    pub parameters: u64,
    /// Patches of an epoch.
    pub patches: usize,
    /// The trained network that the run begins with, if any.
    pub origin: Option<&'a Origin>,
}

impl RunDir {
    /// Refuses a directory that holds a run unless `resume` is set and the run has the same configuration.
    ///
    /// Writes nothing: a refusal comes before the data is read. A configuration that is gone is looked for in the
    /// checkpoints.
    ///
    /// # Errors
    /// As said, with every key that differs; a saved configuration that cannot be read.
    pub fn claim(config: &Config, resume: bool) -> anyhow::Result<Self> {
        let path = config.run.dir.clone();
        let claimed = RunDir {
            path: path.clone(),
            lock: None,
        };
        let trace = OWN_FILES.iter().chain(&TRACES);
        let Some(trace) = trace.into_iter().find(|name| path.join(name).exists()) else {
            return Ok(claimed);
        };
        let saved = match path.join(CONFIG) {
            saved if saved.exists() => Some(saved),
            _ => {
                let checkpoint = Store::new(&path).newest_intact()?.intact;
                checkpoint.map(|dir| dir.join(CONFIG))
            }
        };
        if let Some(saved) = &saved {
            let there = Config::load(saved, &[])?;
            let differences = config.differences(&there);
            ensure!(
                differences.is_empty(),
                "{}: holds a run with another configuration: {}",
                path.display(),
                differences.join("; ")
            );
        }
        if !resume {
            bail!(
                "{}: holds a run already ({trace}); --resume continues it, --run-dir takes another directory",
                path.display()
            );
        }
        Ok(claimed)
    }

    /// Locks the directory if it is there: from now on no other process trains in it.
    ///
    /// # Errors
    /// Another process does.
    pub fn lock_if_there(&mut self) -> anyhow::Result<()> {
        if self.path.is_dir() {
            self.lock()?;
            self.sweep();
        }
        Ok(())
    }

    /// Removes what a process that was killed left half written. What cannot be removed does no harm.
    fn sweep(&self) {
        for dir in [self.path.clone(), self.path.join("strips")] {
            for entry in fs::read_dir(dir).into_iter().flatten().flatten() {
                let name = entry.file_name();
                let name = name.to_string_lossy();
                if name.starts_with('.') && name.ends_with(TEMPORARY) {
                    let _ = fs::remove_file(entry.path());
                }
            }
        }
    }

    /// The directory.
    pub fn path(&self) -> &Path {
        &self.path
    }

    /// Makes and locks the directory, and writes configuration and record of a new run or compares the record of one that
    /// goes on. Returns what the user should know about the latter.
    ///
    /// # Errors
    /// A directory that cannot be written or that another process trains in; scenes, statistics or a layout other than
    /// those that the run began with.
    pub fn open(
        &mut self,
        config: &Config,
        data: &Data,
        facts: Facts,
    ) -> anyhow::Result<Option<String>> {
        let made = fs::create_dir_all(&self.path);
        made.with_context(|| format!("cannot make {}", self.path.display()))?;
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
            let written = Record::new(data, facts);
            self.write(RUN, &serde_json::to_vec_pretty(&written)?)?;
            return Ok(None);
        }
        let text = fs::read_to_string(&record).with_context(|| record.display().to_string())?;
        let began: Record =
            serde_json::from_str(&text).with_context(|| record.display().to_string())?;
        let now = Record::new(data, facts);
        for (what, same) in [
            ("scenes", began.scenes == now.scenes),
            ("statistics", began.normalizer == now.normalizer),
            ("channel layout", began.layout == now.layout),
        ] {
            ensure!(
                same,
                "{}: the run began with other {what}",
                record.display()
            );
        }
        let versions = |record: &Record| {
            format!(
                "demc {}, Burn {}, {}, {}",
                record.demc, record.burn, record.device, record.operations
            )
        };
        let (then, now) = (versions(&began), versions(&now));
        Ok(
            (then != now)
                .then(|| format!("this run began on {then}; on {now} the bits may differ")),
        )
    }

    fn lock(&mut self) -> anyhow::Result<()> {
        let path = self.path.join(LOCK);
        let file = File::create(&path).with_context(|| path.display().to_string())?;
        if file.try_lock().is_err() {
            bail!(
                "{}: another process trains in this directory",
                self.path.display()
            );
        }
        self.lock = Some(file);
        Ok(())
    }

    /// The log, with the lines after `step` cut off: a resumed run writes them again.
    ///
    /// # Errors
    /// A log that cannot be read or written.
    pub fn metrics(&self, step: u64) -> anyhow::Result<Metrics> {
        Metrics::open(&self.path.join(METRICS), step)
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

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn recorded_version_of_burn_is_the_pinned_one() {
        let manifest = concat!(env!("CARGO_MANIFEST_DIR"), "/../Cargo.toml");
        let manifest: toml::Table = fs::read_to_string(manifest).unwrap().parse().unwrap();
        let burn = &manifest["workspace"]["dependencies"]["burn"]["version"];
        assert_eq!(burn.as_str(), Some(format!("={BURN}").as_str()));
    }
}
