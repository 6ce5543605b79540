//! A session: one process that trains one run, new or resumed, up to its scores.

use std::path::{Path, PathBuf};

use anyhow::ensure;
use burn::tensor::Device;
use demc_infer::compute;
use demc_program::exit::UsageError;
use demc_program::output::Outputs;
use serde::{Deserialize, Serialize};

use crate::config::Config;
use crate::ranks::cluster::ClusterEstimate;
use crate::ranks::{NodeShare, check_divides};
use crate::run::checkpoint::store::{CheckpointSearch, CheckpointStore};
use crate::run::checkpoint::{self, Checkpoint};
use crate::run::data::{TrainingData, protect_inputs};
use crate::run::estimate::{DurationEstimate, check_memory};
use crate::run::observer::TakenStep;
use crate::run::place::SessionPlace;
use crate::run::run_dir::{self, RunDir};
use crate::run::signals::{Outcome, Signals};
use crate::run::training::TrainingRun;
use crate::run::training::scores::TestScores;

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
    /// The processes of the run, their nodes, threads, and devices; `None` for a single process.
    pub placement: Option<String>,
    first_step: u64,
    place: SessionPlace,
}

/// What a complete run leaves behind besides its files.
#[derive(Clone, Debug)]
pub struct RunResult {
    /// One sentence on which weights the run keeps, and why.
    pub kept: String,
    /// The scores of the kept weights, if there is a test split.
    pub scores: Option<TestScores>,
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
    /// Reads the data and, to resume, the checkpoint. The first process brings the run directory into
    /// order; the others follow it.
    ///
    /// # Errors
    /// A run directory with another run, or in use by another process; invalid data or checkpoint;
    /// processes that differ in program, configuration, or data.
    pub fn open(
        config: Config,
        options: SessionOptions,
        place: &SessionPlace,
    ) -> anyhow::Result<Self> {
        let SessionPlace { device, reduce, .. } = place;
        reduce.check(&config.to_toml(), config.train.grad_accumulation)?;
        let Opened {
            dir,
            data,
            checkpoint,
            mut notes,
        } = reduce.broadcast(
            || Opened::new(&config, options, device),
            Opened::message,
            |message| message.open(&config, device, reduce.on_node()),
        )?;
        reduce.agree(check_memory(&config, device, reduce.on_node().count))?;
        let first_step = checkpoint
            .as_ref()
            .map_or(0, |found| found.loaded.state.step);
        let autodiff = device.clone().autodiff();
        let estimate =
            DurationEstimate::measure(&config, &data, first_step, &autodiff, reduce.count());
        if data.clamped > 0 {
            let clamped = data.clamped;
            notes.push(format!(
                "{clamped} negative radiance values are clamped to 0"
            ));
        }
        let (summary, warnings) = (data.summary(), data.warnings.clone());
        let checkpoint = checkpoint.map(|found| found.loaded);
        let run = reduce.agree(TrainingRun::new(config, data, dir, checkpoint, place))?;
        notes.extend(run.initial().map(|initial| initial.note(run.config())));
        let placement = reduce.describe(&place.device_name, run.parameters())?;
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
        self.place
            .reduce
            .from_first(|| self.check_own_outputs(files))
    }

    fn check_own_outputs(&self, files: &[PathBuf]) -> anyhow::Result<()> {
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
        check_divides(count, config.train.grad_accumulation)?;
        let share = self
            .run
            .estimate(self.first_step, &self.place.device, count);
        let floats = self.run.parameters();
        let cluster = ClusterEstimate::new(share.step, floats, count, bandwidth * 1e9);
        let steps = config.train.steps.saturating_sub(self.first_step);
        let hours = cluster.step() * steps as f64 / 3600.0;
        Ok(format!("{cluster}; {hours:.1} hours for {steps} steps"))
    }

    /// Trains and scores. The first signal of a user or a batch system stops the training.
    ///
    /// # Errors
    /// Those of [`TrainingRun::train`] and [`TrainingRun::test`].
    pub fn finish(self) -> anyhow::Result<Outcome<RunResult>> {
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
    ) -> anyhow::Result<Outcome<RunResult>> {
        if let Some(stopped) = self.run.train(&self.place.device_name, observer)? {
            return Ok(Outcome::Stopped(stopped));
        }
        Ok(Outcome::Complete(RunResult {
            scores: self.run.test(&self.place.device)?,
            kept: self.run.kept_weights(),
        }))
    }
}

/// What a session works on.
struct Opened {
    dir: RunDir,
    data: TrainingData,
    checkpoint: Option<OpenedCheckpoint>,
    notes: Vec<String>,
}

struct OpenedCheckpoint {
    dir: PathBuf,
    loaded: Checkpoint,
}

/// What the first process tells the others.
#[derive(Serialize, Deserialize)]
struct OpenedMessage {
    data: TrainingData,
    /// The directory of the checkpoint to resume from.
    checkpoint: Option<PathBuf>,
    notes: Vec<String>,
}

impl Opened {
    /// Claims the run directory, restores it to resume, and reads the data.
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
        let data = TrainingData::open(config)?;
        if resume {
            dir.check_scenes(&data)?;
        }
        Ok(Opened {
            dir,
            data,
            checkpoint,
            notes,
        })
    }

    fn message(&self) -> OpenedMessage {
        OpenedMessage {
            data: self.data.clone(),
            checkpoint: self.checkpoint.as_ref().map(|found| found.dir.clone()),
            notes: self.notes.clone(),
        }
    }
}

impl OpenedMessage {
    /// Reads the same checkpoint, and checks the same data on this node, without writing anything.
    fn open(self, config: &Config, device: &Device, node: NodeShare) -> anyhow::Result<Opened> {
        self.data.check_files(node)?;
        let checkpoint = self.checkpoint.map(|dir| {
            let loaded = load_checkpoint(&dir, config, device)?;
            anyhow::Ok(OpenedCheckpoint { dir, loaded })
        });
        Ok(Opened {
            dir: RunDir::unclaimed(config),
            data: self.data,
            checkpoint: checkpoint.transpose()?,
            notes: self.notes,
        })
    }
}

/// The checkpoint to resume from. With `restore`, the run directory is brought to its state.
fn latest_checkpoint(
    config: &Config,
    run: &Path,
    restore: bool,
    device: &Device,
    notes: &mut Vec<String>,
) -> anyhow::Result<Option<OpenedCheckpoint>> {
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
    let loaded = load_checkpoint(&intact, config, device)?;
    notes.push(format!("resuming from {}", intact.display()));
    if restore {
        notes.extend(checkpoint::restore_run(run, &intact)?);
        CheckpointStore::new(run).remove_old(&intact, config.run.keep)?;
    }
    Ok(Some(OpenedCheckpoint {
        dir: intact,
        loaded,
    }))
}

fn load_checkpoint(dir: &Path, config: &Config, device: &Device) -> anyhow::Result<Checkpoint> {
    checkpoint::load(dir, config, &device.clone().autodiff())
}
