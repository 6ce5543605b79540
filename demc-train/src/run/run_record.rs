//! The files that describe a run, and the content of one of them, `run.json`: versions, device, scenes
//! and statistics at the start of the run.

use std::collections::{BTreeMap, BTreeSet};
use std::path::Path;

use anyhow::ensure;
use demc_data::{ChannelLayout, Normalizer, Scene};
use demc_program::message::short_list;
use serde::{Deserialize, Serialize};

use crate::config::Config;
use crate::run::data::TrainingData;
use crate::run::initial::InitialWeights;

/// The manifest that pins the version of Burn; Burn itself exports none.
const MANIFEST: &str = include_str!("../../../Cargo.toml");

/// The resolved configuration.
pub const CONFIG: &str = "config.toml";
/// The record of versions, device and data.
pub const RUN: &str = "run.json";
/// The channel layout, if it is not a preset.
pub const LAYOUT: &str = "layout.toml";
/// The files of a run directory that describe the run. Its checkpoints have copies of them.
pub const OWN_FILES: [&str; 3] = [CONFIG, RUN, LAYOUT];

/// Whether the bytes of one of [`OWN_FILES`] in a run directory can be used. The record of a run
/// never changes, so that of a checkpoint is preferred.
pub fn is_usable(name: &str, bytes: &[u8]) -> bool {
    let Ok(text) = str::from_utf8(bytes) else {
        return false;
    };
    match name {
        CONFIG => Config::parse(Path::new(CONFIG), text, &[]).is_ok(),
        LAYOUT => toml::from_str::<ChannelLayout>(text).is_ok(),
        _ => false,
    }
}

/// The content of `run.json`.
#[derive(Debug, Serialize, Deserialize)]
pub struct RunRecord {
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
    /// SHA-256 of each scene's file by the scene's name; empty in older runs.
    #[serde(default)]
    checksums: BTreeMap<String, String>,
    /// Gamma and the statistics of the training scenes.
    normalizer: Normalizer,
    /// Channels of the files.
    layout: ChannelLayout,
    /// The weights of `train.init`, if any.
    #[serde(default)]
    init: Option<InitialWeights>,
}

#[derive(Debug, PartialEq, Serialize, Deserialize)]
struct SceneNames {
    train: Vec<String>,
    validation: Vec<String>,
    test: Vec<String>,
}

impl SceneNames {
    fn of(data: &TrainingData) -> Self {
        let names = |scenes: &[Scene]| scenes.iter().map(|scene| scene.name.clone()).collect();
        SceneNames {
            train: names(&data.train),
            validation: names(&data.validation),
            test: names(&data.test),
        }
    }

    /// Each scene with its split.
    fn entries(&self) -> BTreeSet<(&str, &str)> {
        let splits = [
            (&self.train, "training"),
            (&self.validation, "validation"),
            (&self.test, "test"),
        ];
        let entries = splits.iter().flat_map(|(names, split)| {
            let names = names.iter();
            names.map(|name| (name.as_str(), *split))
        });
        entries.collect()
    }
}

/// What `run.json` records besides the data.
#[derive(Clone, Copy, Debug)]
pub struct RecordedSetup<'a> {
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

impl RunRecord {
    /// The record of a run that starts now.
    pub fn new(data: &TrainingData, facts: RecordedSetup) -> Self {
        RunRecord {
            demc: env!("CARGO_PKG_VERSION").to_string(),
            burn: burn_version(),
            device: facts.device.to_string(),
            operations: facts.operations.to_string(),
            parameters: facts.parameters,
            patches: facts.patches,
            scenes: SceneNames::of(data),
            checksums: data.checksums.clone(),
            normalizer: data.normalizer.clone(),
            layout: data.layout.clone(),
            init: facts.initial.cloned(),
        }
    }

    /// Compares the scenes with those of the start. Errors name the scenes that differ and `path`,
    /// the file of this record.
    ///
    /// # Errors
    /// Other scenes or splits; a scene whose file changed.
    pub fn check_scenes(&self, path: &Path, data: &TrainingData) -> anyhow::Result<()> {
        let now = SceneNames::of(data);
        let (then, now_entries) = (self.scenes.entries(), now.entries());
        let mut moved: Vec<&str> = then
            .symmetric_difference(&now_entries)
            .map(|(name, _)| *name)
            .collect();
        moved.dedup();
        ensure!(
            moved.is_empty(),
            "{}: the run started with different scenes or splits: {}; restore the data set, or start a new run",
            path.display(),
            short_list(&moved)
        );
        self.check_files(path, &data.checksums)
    }

    /// Compares the files of scenes, by their checksums, with those of the start.
    ///
    /// # Errors
    /// Each scene whose file changed, or that is new or gone.
    pub fn check_files(
        &self,
        path: &Path,
        checksums: &BTreeMap<String, String>,
    ) -> anyhow::Result<()> {
        let names: BTreeSet<&String> = checksums.keys().chain(self.checksums.keys()).collect();
        let changed: Vec<&str> = names
            .into_iter()
            .filter(|name| checksums.get(*name) != self.checksums.get(*name))
            .map(String::as_str)
            .collect();
        ensure!(
            changed.is_empty() || self.checksums.is_empty(),
            "{}: files of scenes changed since the run started: {}; restore them, or start a new run",
            path.display(),
            short_list(&changed)
        );
        Ok(())
    }

    /// Compares everything about the data with the start.
    ///
    /// # Errors
    /// As [`check_scenes`](Self::check_scenes); other statistics or another layout.
    pub fn check_data(&self, path: &Path, data: &TrainingData) -> anyhow::Result<()> {
        self.check_scenes(path, data)?;
        for (what, same) in [
            // The order decides over the batches.
            ("order of scenes", self.scenes == SceneNames::of(data)),
            ("statistics", self.normalizer == data.normalizer),
            ("channel layout", self.layout == data.layout),
        ] {
            ensure!(
                same,
                "{}: the run started with a different {what}",
                path.display()
            );
        }
        Ok(())
    }

    /// Compares the patches of an epoch with those of the start.
    ///
    /// # Errors
    /// Another number.
    pub fn check_patches(&self, path: &Path, now: &RunRecord) -> anyhow::Result<()> {
        ensure!(
            self.patches == now.patches,
            "{}: the run started with {} patches per epoch instead of {}; restore `repeat` in the manifest, or \
             start a new run",
            path.display(),
            self.patches,
            now.patches
        );
        Ok(())
    }

    /// A note if `now` has other versions or another device.
    pub fn version_note(&self, now: &RunRecord) -> Option<String> {
        let versions = |record: &RunRecord| {
            format!(
                "demc {}, Burn {}, {}, {}",
                record.demc, record.burn, record.device, record.operations
            )
        };
        let (then, now) = (versions(self), versions(now));
        (then != now).then(|| format!("this run started on {then}; on {now} its bits may differ"))
    }
}

fn burn_version() -> String {
    let manifest: toml::Table = MANIFEST.parse().expect("the manifest that Cargo read");
    let pinned = manifest["workspace"]["dependencies"]["burn"]["version"]
        .as_str()
        .and_then(|version| version.strip_prefix('='));
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
