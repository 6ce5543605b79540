//! The configuration of a run: one TOML file with the tables `[model]`, `[data]`, `[loss]`,
//! `[optimizer]`, `[train]` and `[run]`.
//!
//! An unknown key, a wrong type or a value out of range stops the run before it starts; all of them
//! are named at once. `--set table.key=value` edits the file's tree before it is parsed. Paths are
//! relative to the current directory. The resolved configuration, saved with the run, holds
//! absolute paths.

mod learning_rate;
mod optimizer;
mod problems;
mod run;
mod source;
mod train;

use std::collections::{BTreeMap, BTreeSet};
use std::io;
use std::path::{Path, PathBuf};

use demc_data::{Augment, DataConfig, InputKind};
use demc_infer::{BundleMeta, Bundled};
use demc_model::kernel_head::GAMMA;
use demc_model::{Head, LossConfig, ModelConfig, Variant};
use demc_program::checksum::sha256;
use demc_program::file::{MAX_CONFIGURATION, read_text};
use demc_program::message::printable;
use serde::{Deserialize, Serialize};
use thiserror::Error;
use toml::Value;

pub use learning_rate::LearningRate;
pub use optimizer::{OptimizerConfig, OptimizerKind};
pub use run::RunConfig;
pub(crate) use source::one_line;
pub use train::{OnNan, TrainConfig};

/// Number of hexadecimal digits of [`Config::hash`].
pub const HASH_DIGITS: usize = 16;

/// The configuration of a run, one field per table.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct Config {
    /// The network.
    pub model: ModelConfig,
    /// The data set and its patches.
    pub data: DataConfig,
    /// The loss, a weighted sum.
    pub loss: LossConfig,
    /// The optimizer and its learning rate.
    pub optimizer: OptimizerConfig,
    /// Length, seed and start of the training.
    pub train: TrainConfig,
    /// The run directory and the intervals of records and checkpoints.
    pub run: RunConfig,
}

/// Why a configuration cannot be used.
#[derive(Debug, Error)]
#[allow(missing_docs, reason = "the messages explain the fields")]
pub enum ConfigError {
    /// The file cannot be read.
    #[error("{}", path.display())]
    Read {
        path: PathBuf,
        source: std::io::Error,
    },
    /// The file is not TOML, holds unknown keys, or a value has the wrong type.
    #[error("{0}")]
    Source(String),
    /// All values out of range.
    #[error("{}: {}", path.display(), problems.join("; "))]
    Values {
        path: PathBuf,
        problems: Vec<String>,
    },
}

impl Config {
    /// Reads, edits and checks a configuration. The result has absolute paths and a run directory.
    ///
    /// `sets` are edits `table.key=value`, with the value in TOML notation or as a bare string. An
    /// empty value removes the key.
    ///
    /// # Errors
    /// See [`ConfigError`]. Every unknown key and every value out of range is named.
    pub fn load(path: &Path, sets: &[String]) -> Result<Self, ConfigError> {
        let read_error = |source| ConfigError::Read {
            path: path.into(),
            source,
        };
        let text = read_text(path, MAX_CONFIGURATION).map_err(read_error)?;
        let mut config = Self::parse(path, &text, sets)?;
        let default_dir = || Path::new("runs").join(path.file_stem().unwrap_or_default());
        config.run.dir.get_or_insert_with(default_dir);
        config.make_absolute().map_err(read_error)?;
        for (key, file) in config.paths() {
            utf8(key, file)?;
        }
        Ok(config)
    }

    /// Edits and checks the text of a configuration. Paths stay as they are; errors name `path`.
    ///
    /// # Errors
    /// As [`load`](Self::load).
    pub fn parse(path: &Path, text: &str, sets: &[String]) -> Result<Self, ConfigError> {
        let config = source::parse::<Config>(path, text, sets, &Self::keys());
        // Keys may contain line breaks and terminal control codes.
        let mut config = config.map_err(|error| ConfigError::Source(printable(&error)))?;
        let problems = config.validate();
        let (from_sets, problems) = source::blame(problems, sets);
        if !from_sets.is_empty() {
            let mut all = from_sets;
            if !problems.is_empty() {
                all.push(format!("{}: {}", path.display(), problems.join("; ")));
            }
            return Err(ConfigError::Source(printable(&all.join("; "))));
        }
        if !problems.is_empty() {
            return Err(ConfigError::Values {
                path: path.into(),
                problems,
            });
        }
        config.optimizer.resolve();
        Ok(config)
    }

    /// Every key as `table.key`, optional ones included.
    pub fn keys() -> BTreeSet<String> {
        let tables = [
            ("model", source::fields::<ModelConfig>()),
            ("data", source::fields::<DataConfig>()),
            ("loss", source::fields::<LossConfig>()),
            ("optimizer", source::fields::<OptimizerConfig>()),
            ("train", source::fields::<TrainConfig>()),
            ("run", source::fields::<RunConfig>()),
        ];
        let keys = tables
            .iter()
            .flat_map(|(table, fields)| fields.iter().map(move |key| format!("{table}.{key}")));
        keys.collect()
    }

    /// Every key that has a value, as `table.key`; optional keys are absent without one.
    pub fn values(&self) -> BTreeMap<String, Value> {
        let tables = toml::Table::try_from(self).expect("a configuration is plain data");
        let mut values = BTreeMap::new();
        for (table, keys) in tables {
            if let Value::Table(keys) = keys {
                let named = keys.into_iter();
                values.extend(named.map(|(key, value)| (format!("{table}.{key}"), value)));
            }
        }
        values
    }

    /// The paths by key.
    fn paths(&self) -> impl Iterator<Item = (&'static str, &Path)> {
        let optional = [("run.dir", &self.run.dir), ("train.init", &self.train.init)].into_iter();
        let set = optional.filter_map(|(key, path)| Some((key, path.as_deref()?)));
        set.chain([("data.root", self.data.root.as_path())])
    }

    fn make_absolute(&mut self) -> io::Result<()> {
        self.data.root = std::path::absolute(&self.data.root)?;
        for path in [&mut self.run.dir, &mut self.train.init]
            .into_iter()
            .flatten()
            .filter(|path| Bundled::named(path).is_none())
        {
            *path = std::path::absolute(&*path)?;
        }
        if self.data.layout.ends_with(".toml") {
            // Without UTF-8 in the current directory, the relative path stays.
            if let Some(layout) = std::path::absolute(&self.data.layout)?.to_str() {
                self.data.layout = layout.to_owned();
            }
        }
        Ok(())
    }

    /// Every value out of range, one line each.
    pub fn validate(&self) -> Vec<String> {
        let mut problems = self.model.validate();
        problems.extend(self.data.validate());
        problems.extend(self.loss.validate());
        problems.extend(self.optimizer.validate());
        problems.extend(self.train.validate());
        problems.extend(self.run.validate());
        let epsilon = self.data.albedo_demodulation_epsilon;
        if let Some(epsilon) = epsilon.filter(|_| self.model.variant == Variant::ColorOnly) {
            problems.push(format!(
                "data.albedo_demodulation_epsilon = {epsilon:?}: must be absent for color-only, the control \
                 without features; --set data.albedo_demodulation_epsilon= removes it"
            ));
        }
        if self.model.head == Head::Kernel && self.data.gamma != GAMMA {
            problems.push(format!(
                "data.gamma = {:?}: must be {GAMMA:?} for model.head = \"kernel\"",
                self.data.gamma
            ));
        }
        if self.model.head == Head::Kernel && !self.data.transfer.is_gamma() {
            problems.push("data.transfer: must be \"gamma\" for model.head = \"kernel\"".into());
        }
        if self.model.variant == Variant::Kpcn {
            problems.extend(self.kpcn_problems());
        } else if self.loss.separate != 0.0 {
            let share = self.loss.separate;
            problems.push(format!(
                "loss.separate = {share:?}: must be 0, except for model.variant = \"kpcn\""
            ));
        }
        problems
    }

    /// What the network takes as input.
    pub fn inputs(&self) -> InputKind {
        BundleMeta::inputs_of(self.model.variant)
    }

    /// Keys with another value than KPCN's.
    fn kpcn_problems(&self) -> Vec<String> {
        let data = &self.data;
        let allowed = Augment {
            flip: data.augment.flip,
            transpose: data.augment.transpose,
            crop: data.augment.crop,
            exposure: data.augment.exposure,
            ..Augment::default()
        };
        let absent = "must be absent for model.variant = \"kpcn\"";
        let checks = [
            (
                data.augment == allowed,
                "data.augment: of `rgb`, `axes`, and `noise`, each",
            ),
            (data.dropout.is_off(), "data.dropout"),
            (data.transfer.is_gamma(), "data.transfer"),
            (
                data.albedo_demodulation_epsilon.is_none(),
                "data.albedo_demodulation_epsilon",
            ),
            (data.position.is_scene(), "data.position"),
        ];
        let broken = checks.iter().filter(|(holds, _)| !holds);
        broken.map(|(_, key)| format!("{key} {absent}")).collect()
    }

    /// The configuration as TOML.
    pub fn to_toml(&self) -> String {
        toml::to_string(self).expect("a configuration is plain data")
    }

    /// The run directory.
    ///
    /// # Panics
    /// Without `run.dir`, which [`load`](Self::load) always sets.
    pub fn run_dir(&self) -> &Path {
        let dir = self.run.dir.as_deref();
        dir.expect("a loaded configuration has a run directory")
    }

    /// The learning rate of each step of this run.
    pub fn learning_rate(&self) -> LearningRate {
        let OptimizerConfig {
            lr_start,
            lr_end,
            lr_decay,
            warmup_steps,
            ..
        } = self.optimizer;
        LearningRate {
            start: lr_start,
            end: lr_end,
            decay: lr_decay,
            steps: self.train.steps,
            warmup_steps,
        }
    }

    /// Patches per step.
    pub fn patches_per_step(&self) -> u64 {
        (self.data.batch_size * self.train.grad_accumulation) as u64
    }

    /// The first 16 digits of the SHA-256 of the keys that change numbers of the run
    /// ([`differences`](Self::differences)) and of `data`. That is the text of the data set's
    /// [contents](crate::run::data::DataContents).
    pub fn hash(&self, data: &str) -> String {
        let keys = self.relevant();
        let keys = keys.iter().map(|(key, value)| format!("{key} = {value}\n"));
        let text = keys.collect::<String>() + data;
        let mut digits = sha256([text.as_bytes()]);
        digits.truncate(HASH_DIGITS);
        digits
    }

    /// The keys that change numbers of a run.
    fn relevant(&self) -> BTreeMap<String, Value> {
        let mut config = self.clone();
        let (log_every, validate_every) = (config.run.log_every, config.run.validate_every);
        config.run = RunConfig {
            log_every,
            validate_every,
            ..RunConfig::default()
        };
        config.train.on_nan = OnNan::default();
        config.data.root = PathBuf::new();
        config.data.layout = String::new();
        config.data.workers = DataConfig::default().workers;
        config.data.cache_mib = DataConfig::default().cache_mib;
        config.values()
    }

    /// The keys in which a run of `self` differs from one of `other`; empty if one may resume the
    /// other.
    ///
    /// Keys that change no number of the run are ignored: run directory, checkpoint intervals,
    /// `on_nan`, threads and memory of the loader. Data root and layout are ignored too, because a
    /// resume compares scenes, statistics and channels themselves.
    pub fn differences(&self, other: &Config) -> Vec<String> {
        let (ours, theirs) = (self.relevant(), other.relevant());
        let keys: BTreeSet<&String> = ours.keys().chain(theirs.keys()).collect();
        let shown = |value: Option<&Value>| value.map_or("absent".into(), source::shown);
        keys.into_iter()
            .map(|key| (key, ours.get(key), theirs.get(key)))
            .filter(|(_, ours, theirs)| ours != theirs)
            .map(|(key, ours, theirs)| {
                format!("{key}: {} instead of {}", shown(ours), shown(theirs))
            })
            .collect()
    }
}

/// The text of the path of `key`.
///
/// # Errors
/// A path that TOML cannot hold.
pub fn utf8<'a>(key: &str, path: &'a Path) -> Result<&'a str, ConfigError> {
    path.to_str().ok_or_else(|| {
        let shown = path.display();
        ConfigError::Source(format!(
            "{key}: {shown}: not UTF-8, as a configuration requires; rename it or choose another"
        ))
    })
}

#[cfg(test)]
mod tests;
