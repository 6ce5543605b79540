//! The configuration of a run: one TOML file with the tables `[model]`, `[data]`, `[train]` and `[run]`.
//!
//! Strict: an unknown key, a wrong type or a value out of range stops the run before it starts, and every problem is
//! named at once. `--set table.key=value` edits the file's tree before it is parsed. Paths are relative to the current
//! directory; the resolved configuration, saved with the run, holds absolute ones.

mod source;
mod tables;

use std::fs::File;
use std::io::{self, Read};
use std::path::{Path, PathBuf};

use demc_data::DataConfig;
use demc_model::{ModelConfig, Variant};
use serde::{Deserialize, Serialize};
use thiserror::Error;

use crate::schedule::LearningRate;
pub(crate) use source::one_line;
pub use tables::{OnNan, RunConfig, TrainConfig};

/// More steps than this are a slip of the keyboard: the paper's run is 250,000.
const MOST_STEPS: u64 = 1_000_000_000;
/// A longer file is no configuration: ours have 4 KB.
const MOST_BYTES: u64 = 1 << 20;
/// More batches in a step are one too.
const MOST_BATCHES: u64 = 65_536;

/// Everything that decides a run.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct Config {
    /// The network.
    pub model: ModelConfig,
    /// The data set and how patches are cut.
    pub data: DataConfig,
    /// The optimisation.
    pub train: TrainConfig,
    /// Where and how often the run is recorded.
    pub run: RunConfig,
}

/// Why a configuration cannot be used.
#[derive(Debug, Error)]
pub enum ConfigError {
    /// The file cannot be read.
    #[error("{}", path.display())]
    Read {
        /// The file.
        path: PathBuf,
        /// What the system says.
        source: std::io::Error,
    },
    /// The file is not TOML, holds unknown keys, or a value has the wrong type.
    #[error("{0}")]
    Source(String),
    /// Values out of range, all of them.
    #[error("{}: {}", path.display(), problems.join("; "))]
    Values {
        /// The file.
        path: PathBuf,
        /// One line each.
        problems: Vec<String>,
    },
}

impl Config {
    /// Reads, edits and checks a configuration; the result has absolute paths.
    ///
    /// `sets` are the edits, `table.key=value`, the value in TOML's notation or a bare string.
    ///
    /// # Errors
    /// See [`ConfigError`]; every unknown key and every value out of range is named.
    pub fn load(path: &Path, sets: &[String]) -> Result<Self, ConfigError> {
        let text = read_text(path).map_err(|source| ConfigError::Read {
            path: path.into(),
            source,
        })?;
        let mut config = Self::parse(path, &text, sets)?;
        if config.run.dir.as_os_str().is_empty() {
            config.run.dir = Path::new("runs").join(path.file_stem().unwrap_or_default());
        }
        config.make_absolute().map_err(|source| ConfigError::Read {
            path: path.into(),
            source,
        })?;
        Ok(config)
    }

    /// Edits and checks the text of a configuration, whose paths stay as they are; `path` is what errors call it.
    ///
    /// # Errors
    /// As [`load`](Self::load).
    pub fn parse(path: &Path, text: &str, sets: &[String]) -> Result<Self, ConfigError> {
        let config = source::parse(path, text, sets);
        // A key may hold line breaks, and codes that a terminal obeys.
        let printable = |error: String| error.replace(char::is_control, "\u{fffd}");
        let config = config.map_err(|error| ConfigError::Source(printable(error)))?;
        let problems = config.validate();
        match problems.is_empty() {
            true => Ok(config),
            false => Err(ConfigError::Values {
                path: path.into(),
                problems,
            }),
        }
    }

    fn make_absolute(&mut self) -> std::io::Result<()> {
        self.data.root = std::path::absolute(&self.data.root)?;
        self.run.dir = std::path::absolute(&self.run.dir)?;
        if !self.train.init.as_os_str().is_empty() {
            self.train.init = std::path::absolute(&self.train.init)?;
        }
        if self.data.layout.ends_with(".toml") {
            let layout = std::path::absolute(&self.data.layout)?;
            self.data.layout = layout.to_string_lossy().into_owned();
        }
        Ok(())
    }

    /// Every value out of range, one line each.
    pub fn validate(&self) -> Vec<String> {
        let (train, run) = (&self.train, &self.run);
        let mut problems = self.model.validate();
        problems.extend(self.data.validate());
        let mut require = |holds: bool, key: &str, value: &dyn std::fmt::Debug, allowed: &str| {
            if !holds {
                problems.push(format!("{key} = {value:?}: must be {allowed}"));
            }
        };
        for (key, value) in [
            ("train.lr_start", train.lr_start),
            ("train.lr_end", train.lr_end),
            ("train.adam_epsilon", train.adam_epsilon.into()),
            ("train.loss_epsilon", train.loss_epsilon.into()),
        ] {
            let positive = value.is_finite() && value > 0.0;
            require(positive, key, &value, "a positive number");
        }
        for (key, value) in [
            ("train.grad_clip", train.grad_clip),
            ("train.ssim", train.ssim),
            ("train.smape", train.smape),
        ] {
            let holds = value.is_finite() && value >= 0.0;
            require(holds, key, &value, "0 (off) or a positive number");
        }
        require(
            (0.0..1.0).contains(&train.ema),
            "train.ema",
            &train.ema,
            "from 0 (off) to below 1",
        );
        for (key, value, most) in [
            ("train.steps", train.steps, MOST_STEPS),
            (
                "train.grad_accumulation",
                train.grad_accumulation as u64,
                MOST_BATCHES,
            ),
            ("run.log_every", run.log_every, MOST_STEPS),
            ("run.validate_every", run.validate_every, MOST_STEPS),
            ("run.checkpoint_every", run.checkpoint_every, MOST_STEPS),
            ("run.keep", run.keep as u64, MOST_STEPS),
        ] {
            let allowed = format!("from 1 to {most}");
            require((1..=most).contains(&value), key, &value, &allowed);
        }
        let minutes = run.checkpoint_minutes;
        require(
            minutes.is_finite() && minutes >= 0.0,
            "run.checkpoint_minutes",
            &minutes,
            "0 (off) or a positive number",
        );
        require(
            train.warmup <= MOST_STEPS,
            "train.warmup",
            &train.warmup,
            "at most 1000000000",
        );
        require(
            train.recycle <= MOST_STEPS,
            "train.recycle",
            &train.recycle,
            "at most 1000000000",
        );
        require(
            run.keep_every <= MOST_STEPS,
            "run.keep_every",
            &run.keep_every,
            "at most 1000000000",
        );
        let sees_texture = self.model.variant != Variant::ColorOnly || self.data.demodulate == 0.0;
        require(
            sees_texture,
            "data.demodulate",
            &self.data.demodulate,
            "0 for color-only, the control without features",
        );
        let seed = train.seed <= i64::MAX as u64;
        require(
            seed,
            "train.seed",
            &train.seed,
            "at most 9223372036854775807, TOML's largest integer",
        );
        problems
    }

    /// The configuration as TOML.
    pub fn to_toml(&self) -> String {
        toml::to_string(self).expect("a configuration is plain data")
    }

    /// The learning rate of this run.
    pub fn learning_rate(&self) -> LearningRate {
        let TrainConfig {
            steps,
            lr_start,
            lr_end,
            decay,
            warmup,
            ..
        } = self.train;
        LearningRate {
            start: lr_start,
            end: lr_end,
            decay,
            steps,
            warmup,
        }
    }

    /// Patches that one step sees.
    pub fn patches_per_step(&self) -> u64 {
        (self.data.batch_size * self.train.grad_accumulation) as u64
    }

    /// The keys by which a run of `self` would differ from one of `other`; empty if one may continue the other.
    ///
    /// Where the run and its data are kept (scenes, statistics and layout are compared on their own), when checkpoints are
    /// written and which stay, what happens at a step that is not finite, and threads and memory of the loader change no
    /// number of the run so far.
    pub fn differences(&self, other: &Config) -> Vec<String> {
        let essence = |config: &Config| {
            let mut config = config.clone();
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
            source::leaves(&config)
        };
        let (ours, theirs) = (essence(self), essence(other));
        let changed = ours
            .iter()
            .filter(|(key, value)| theirs.get(*key) != Some(*value));
        changed
            .map(|(key, value)| {
                let there = theirs.get(key).map_or("nothing".into(), source::shown);
                format!("{key} = {}, there {there}", source::shown(value))
            })
            .collect()
    }
}

/// The text of a file that may be a pipe, but not one without end.
fn read_text(path: &Path) -> io::Result<String> {
    let mut text = String::new();
    File::open(path)?
        .take(MOST_BYTES + 1)
        .read_to_string(&mut text)?;
    if text.len() as u64 > MOST_BYTES {
        let why = format!("more than {MOST_BYTES} bytes; expected a configuration in TOML");
        return Err(io::Error::new(io::ErrorKind::InvalidData, why));
    }
    Ok(text)
}

#[cfg(test)]
mod tests;
