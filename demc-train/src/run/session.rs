//! A session: one process that trains one run, new or resumed, up to its scores.

use std::path::{Path, PathBuf};

use anyhow::ensure;
use burn::tensor::Device;
use demc_data::output::Outputs;
use demc_infer::compute;
use demc_infer::evaluate::Report;

use crate::config::Config;
use crate::run::checkpoint::store::{CheckpointSearch, CheckpointStore};
use crate::run::checkpoint::{self, Checkpoint};
use crate::run::data::{RunData, protect_inputs};
use crate::run::run_dir::{self, RunDir};
use crate::run::training::{LoopEnd, TrainingRun};
use crate::tools::estimate::{DurationEstimate, check_memory};

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
    first_step: u64,
    device: Device,
    device_name: String,
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
    /// # Errors
    /// A run directory with another run, or in use by another process; invalid data or checkpoint.
    pub fn open(
        config: Config,
        options: SessionOptions,
        device: &Device,
        device_name: &str,
    ) -> anyhow::Result<Self> {
        let SessionOptions { resume, check } = options;
        let mut dir = RunDir::claim(&config, resume)?;
        if !check {
            dir.lock_if_present()?;
        }
        let mut notes = Vec::new();
        // First, because it restores a damaged layout.
        let checkpoint = match resume {
            true => latest_checkpoint(&config, dir.path(), !check, device, &mut notes)?,
            false => None,
        };
        let data = RunData::open(&config)?;
        check_memory(&config, device)?;
        if resume {
            dir.check_scenes(&data)?;
        }
        if data.clamped > 0 {
            let clamped = data.clamped;
            notes.push(format!(
                "{clamped} negative radiance values are clamped to 0"
            ));
        }
        let first_step = checkpoint.as_ref().map_or(0, |found| found.state.step);
        let autodiff = device.clone().autodiff();
        let estimate = DurationEstimate::measure(&config, &data, first_step, &autodiff);
        let (summary, warnings) = (data.summary(), data.warnings.clone());
        let run = TrainingRun::new(config, data, dir, checkpoint, device)?;
        notes.extend(run.initial().map(|initial| initial.note(run.config())));
        Ok(Session {
            run,
            estimate,
            data: summary,
            warnings,
            notes,
            first_step,
            device: device.clone(),
            device_name: device_name.into(),
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
            self.device_name,
            compute::describe(&self.device)
        )
    }

    /// Trains and scores.
    ///
    /// # Errors
    /// Those of [`TrainingRun::train`] and [`TrainingRun::test`].
    pub fn finish(mut self) -> anyhow::Result<SessionOutcome> {
        match self.run.train(&self.device_name)? {
            LoopEnd::Stopped { signal, step } => Ok(SessionOutcome::Stopped { signal, step }),
            LoopEnd::Done => {
                let scores = self.run.test(&self.device)?;
                Ok(SessionOutcome::Complete {
                    kept: self.run.kept_weights(),
                    scores: scores.map(|(step, report)| (step, Box::new(report))),
                })
            }
        }
    }
}

/// The checkpoint to resume from. With `restore`, the run directory is brought to its state.
fn latest_checkpoint(
    config: &Config,
    run: &Path,
    restore: bool,
    device: &Device,
    notes: &mut Vec<String>,
) -> anyhow::Result<Option<Checkpoint>> {
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
    let device = device.clone().autodiff();
    let checkpoint = checkpoint::load(&intact, config, &device)?;
    notes.push(format!("resuming from {}", intact.display()));
    if restore {
        notes.extend(checkpoint::restore_run(run, &intact)?);
    }
    Ok(Some(checkpoint))
}
