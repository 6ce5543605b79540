//! A session: one process that trains one run, new or resumed, up to its scores.

use std::path::{Path, PathBuf};

use anyhow::{Context, ensure};
use burn::tensor::Device;
use demc_infer::compute;
use demc_infer::evaluate::Report;
use demc_program::checksum::sha256_of;
use demc_program::exit::UsageError;
use demc_program::output::Outputs;

use serde::{Deserialize, Serialize};

use crate::config::Config;
use crate::ranks::{self, Ranks};
use crate::run::checkpoint::store::{CheckpointSearch, CheckpointStore};
use crate::run::checkpoint::{self, Checkpoint};
use crate::run::data::{RunData, protect_inputs};
use crate::run::observer::TakenStep;
use crate::run::run_dir::{self, RunDir};
use crate::run::signals::Signals;
use crate::run::training::{LoopEnd, TrainingRun};
use crate::tools::estimate::{ClusterEstimate, DurationEstimate, check_memory};

/// A run that can start, and what the user should know about it.
pub struct Session {
    run: TrainingRun,
    estimate: DurationEstimate,
    /// Number of scenes in each split.
    pub data: String,
    /// Suspicious signs in the data.
    pub warnings: Vec<String>,
    /// Notes for the user.
    pub notes: Vec<String>,
    /// Ranks, nodes, threads, and devices; `None` for a single rank.
    pub placement: Option<String>,
    first_step: u64,
    place: SessionPlace,
}

/// How a session ended.
#[derive(Debug)]
pub enum SessionOutcome {
    /// The run is complete.
    Complete {
        /// One sentence on which weights the run keeps, and why.
        kept: String,
        /// The step of the kept weights and their scores, if there is a test split.
        scores: Option<(u64, Box<Report>)>,
    },
    /// A signal stopped the run; everything is saved.
    Stopped {
        /// The signal.
        signal: i32,
        /// The last step.
        step: u64,
    },
}

/// Where a session computes.
#[derive(Clone)]
pub struct SessionPlace {
    /// Device without autodiff.
    pub device: Device,
    /// Its name, for the record.
    pub device_name: String,
    /// The ranks of the run.
    pub ranks: Ranks,
}

/// Options of a session.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct SessionOptions {
    /// Resumes the run in the run directory. Otherwise a directory with a run is refused.
    pub resume: bool,
    /// Writes nothing and locks nothing.
    pub check: bool,
}

impl Session {
    /// Reads the data and, to resume, the checkpoint.
    ///
    /// Rank 0 reads the scenes and brings the run directory into order. Then every rank checks its
    /// node's files, and reads the checkpoint.
    ///
    /// # Errors
    /// A run directory with another run, or in use by another process; invalid data or checkpoint;
    /// ranks that differ in program, configuration, or data.
    pub fn open(
        config: Config,
        options: SessionOptions,
        place: &SessionPlace,
    ) -> anyhow::Result<Self> {
        let SessionPlace {
            device,
            device_name,
            ranks,
        } = place;
        ranks.compare("the program", program)?;
        ranks.compare("the configuration", || Ok(config.to_toml()))?;
        ranks.agree(ranks::check_divides(
            ranks.count(),
            config.train.grad_accumulation,
        ))?;
        let first = ranks
            .is_first()
            .then(|| Prepared::new(&config, options, device));
        let (first, told) = match first.transpose() {
            Ok(Some(Prepared {
                dir,
                checkpoint,
                told,
            })) => (Some((dir, checkpoint)), Ok(Some(told))),
            Ok(None) => (None, Ok(None)),
            Err(error) => (None, Err(error)),
        };
        let told = ranks.gather(told)?.into_iter().next().flatten();
        let Told {
            data,
            checkpoint,
            mut notes,
        } = told.context("rank 0 prepares the run")?;
        let own = || -> anyhow::Result<(RunDir, Option<Checkpoint>)> {
            check_memory(&config, device, ranks.on_node().count)?;
            if let Some(first) = first {
                return Ok(first);
            }
            data.check_files(ranks.on_node())?;
            let checkpoint = checkpoint.map(|dir| load_checkpoint(&dir, &config, device));
            Ok((RunDir::unclaimed(&config), checkpoint.transpose()?))
        };
        let (dir, checkpoint) = ranks.agree(own())?;
        let first_step = checkpoint.as_ref().map_or(0, |found| found.state.step);
        let autodiff = device.clone().autodiff();
        let estimate =
            DurationEstimate::measure(&config, &data, first_step, &autodiff, ranks.count());
        if data.clamped > 0 {
            let clamped = data.clamped;
            notes.push(format!(
                "{clamped} negative radiance values are clamped to 0"
            ));
        }
        let (summary, warnings) = (data.summary(), data.warnings.clone());
        let run = TrainingRun::new(config, data, dir, checkpoint, device, ranks.clone());
        let run = ranks.agree(run)?;
        notes.extend(run.initial().map(|initial| initial.note(run.config())));
        let placement = ranks.describe(device_name, run.parameters())?;
        Ok(Session {
            run,
            estimate,
            data: summary,
            warnings,
            notes,
            placement,
            first_step,
            place: place.clone(),
        })
    }

    /// The run.
    pub fn run(&self) -> &TrainingRun {
        &self.run
    }

    /// Checks that the run's files replace none of its inputs. `files` are the configuration files.
    ///
    /// # Errors
    /// A file of the run that is an input or cannot be replaced.
    pub fn check_outputs(&self, files: &[PathBuf]) -> anyhow::Result<()> {
        self.place.ranks.agree(self.check_own_outputs(files))
    }

    fn check_own_outputs(&self, files: &[PathBuf]) -> anyhow::Result<()> {
        if !self.place.ranks.is_first() {
            return Ok(());
        }
        let mut config = self.run.config().clone();
        // Only a new run reads its initial weights.
        config.train.init.take_if(|_| self.run.initial().is_none());
        let mut outputs = Outputs::default();
        protect_inputs(&mut outputs, files, &config)?;
        for file in run_dir::replaced_files(config.run_dir()) {
            outputs.claim(&file, true)?;
        }
        Ok(())
    }

    /// One line: duration, steps and device.
    pub fn headline(&self) -> String {
        format!(
            "{} for steps {} to {} on {} ({})",
            self.estimate,
            self.first_step,
            self.run.config().train.steps,
            self.place.device_name,
            compute::describe(&self.place.device)
        )
    }

    /// The time of a step and of the run on `count` ranks, one per node like this computer, with a
    /// network of `bandwidth` GB/s: a model.
    ///
    /// # Errors
    /// A number of ranks that does not divide `train.grad_accumulation`; a bandwidth that is not
    /// positive.
    pub fn predict(&self, count: usize, bandwidth: f64) -> anyhow::Result<String> {
        if !(bandwidth > 0.0 && bandwidth.is_finite()) {
            let problem = format!("--bandwidth {bandwidth}: expected a positive number of GB/s");
            return Err(UsageError(problem).into());
        }
        let config = self.run.config();
        ranks::check_divides(count, config.train.grad_accumulation)?;
        let share = self
            .run
            .estimate(self.first_step, &self.place.device, count);
        let cluster = ClusterEstimate::new(&share, self.run.parameters(), count, bandwidth * 1e9);
        let steps = config.train.steps.saturating_sub(self.first_step);
        let hours = cluster.step() * steps as f64 / 3600.0;
        Ok(format!("{cluster}; {hours:.1} hours for {steps} steps"))
    }

    /// Trains and scores. The first signal of a user or a batch system stops the training.
    ///
    /// # Errors
    /// Those of [`TrainingRun::train`] and [`TrainingRun::test`].
    pub fn finish(self) -> anyhow::Result<SessionOutcome> {
        let signals = Signals::listen()?;
        self.finish_observed(move |_| signals.received())
    }

    /// As [`finish`](Self::finish), but signals are the caller's: `observer` hears of every step, and
    /// the number of a signal that it returns stops the training.
    ///
    /// # Errors
    /// As [`finish`](Self::finish).
    pub fn finish_observed(
        mut self,
        observer: impl FnMut(&TakenStep) -> Option<i32>,
    ) -> anyhow::Result<SessionOutcome> {
        match self.run.train(&self.place.device_name, observer)? {
            LoopEnd::Stopped { signal, step } => Ok(SessionOutcome::Stopped { signal, step }),
            LoopEnd::Done => {
                let scores = self.run.test(&self.place.device)?;
                Ok(SessionOutcome::Complete {
                    kept: self.run.kept_weights(),
                    scores: scores.map(|(step, report)| (step, Box::new(report))),
                })
            }
        }
    }
}

/// What rank 0 does before the others start.
struct Prepared {
    dir: RunDir,
    checkpoint: Option<Checkpoint>,
    told: Told,
}

/// What rank 0 tells the others.
#[derive(Serialize, Deserialize)]
struct Told {
    data: RunData,
    /// The directory of the checkpoint to resume from.
    checkpoint: Option<PathBuf>,
    notes: Vec<String>,
}

impl Prepared {
    fn new(config: &Config, options: SessionOptions, device: &Device) -> anyhow::Result<Self> {
        let SessionOptions { resume, check } = options;
        let mut dir = RunDir::claim(config, resume)?;
        if !check {
            dir.lock_if_present()?;
        }
        let mut notes = Vec::new();
        // First, because it restores a damaged layout.
        let checkpoint = if resume {
            latest_checkpoint(config, dir.path(), !check, device, &mut notes)?
        } else {
            None
        };
        let (path, checkpoint) = checkpoint.unzip();
        let data = RunData::open(config)?;
        if resume {
            dir.check_scenes(&data)?;
        }
        Ok(Prepared {
            dir,
            checkpoint,
            told: Told {
                data,
                checkpoint: path,
                notes,
            },
        })
    }
}

/// The version and checksum of this program, which must be the same on all ranks.
fn program() -> anyhow::Result<String> {
    let version = env!("CARGO_PKG_VERSION");
    let file = std::env::current_exe().context("the program's own file")?;
    Ok(format!("{version}, SHA-256 {}", sha256_of(&file)?))
}

/// The checkpoint to resume from. With `restore`, the run directory is brought to its state.
fn latest_checkpoint(
    config: &Config,
    run: &Path,
    restore: bool,
    device: &Device,
    notes: &mut Vec<String>,
) -> anyhow::Result<Option<(PathBuf, Checkpoint)>> {
    let CheckpointSearch { intact, damaged } = CheckpointStore::new(run).newest_intact()?;
    let Some(intact) = intact else {
        ensure!(
            damaged.is_empty(),
            "{}: no intact checkpoint: {}",
            run.display(),
            damaged.join("; ")
        );
        notes.push(format!(
            "no checkpoint in {}: starting at step 0",
            run.display()
        ));
        return Ok(None);
    };
    notes.extend(damaged);
    let checkpoint = load_checkpoint(&intact, config, device)?;
    notes.push(format!("resuming from {}", intact.display()));
    if restore {
        notes.extend(checkpoint::restore_run(run, &intact)?);
        CheckpointStore::new(run).remove_old(&intact, config.run.keep)?;
    }
    Ok(Some((intact, checkpoint)))
}

fn load_checkpoint(dir: &Path, config: &Config, device: &Device) -> anyhow::Result<Checkpoint> {
    checkpoint::load(dir, config, &device.clone().autodiff())
}
