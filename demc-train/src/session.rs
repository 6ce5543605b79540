//! A run from its configuration to its scores, new or resumed: what one process does with one run directory.

use std::path::Path;

use anyhow::ensure;
use burn::tensor::Device;
use demc_infer::compute;
use demc_infer::evaluate::Report;

use crate::checkpoint::{self, Checkpoint, Found, Store};
use crate::config::Config;
use crate::data::Data;
use crate::estimate::Estimate;
use crate::run_dir::RunDir;
use crate::train::{Ended, Run};

/// A run that is ready, and what there is to say about it.
pub struct Session {
    run: Run,
    /// How long it will take.
    pub estimate: Estimate,
    /// `10 scenes to train on, 2 to validate, 4 to test`.
    pub data: String,
    /// What the user should know.
    pub notes: Vec<String>,
    first: u64,
    device: Device,
    device_name: String,
}

/// What came of a session.
#[derive(Debug)]
pub enum Outcome {
    /// The run is complete; the step of the weights that were scored, and the scores, where there is a test split.
    Scored(Option<(u64, Report)>),
    /// A signal came; everything is saved.
    Stopped {
        /// The signal.
        signal: i32,
        /// The last step.
        step: u64,
    },
}

/// How a session goes about its run directory.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Manner {
    /// A run that is there goes on; otherwise it is refused.
    pub resume: bool,
    /// Nothing is written, and nobody locked out.
    pub check: bool,
}

impl Session {
    /// Reads the data and, where the run goes on, its checkpoint.
    ///
    /// # Errors
    /// A run directory that holds another run or that another process trains in; data or a checkpoint that cannot be used.
    pub fn open(
        config: Config,
        manner: Manner,
        device: &Device,
        device_name: &str,
    ) -> anyhow::Result<Self> {
        let Manner { resume, check } = manner;
        let mut dir = RunDir::claim(&config, resume)?;
        if !check {
            dir.lock_if_there()?;
        }
        let data = Data::open(&config.data, config.train.seed)?;
        let mut notes = Vec::new();
        if data.clamped > 0 {
            let clamped = data.clamped;
            notes.push(format!("{clamped} negative values of radiance count as 0"));
        }
        let checkpoint = match resume {
            true => latest(&config, dir.path(), !check, device, &mut notes)?,
            false => None,
        };
        let first = checkpoint.as_ref().map_or(0, |found| found.state.step);
        let estimate = Estimate::measure(&config, &data, first, &device.clone().autodiff());
        let summary = data.summary();
        let run = Run::new(config, data, dir, checkpoint, device)?;
        notes.extend(run.origin.as_ref().map(|origin| origin.note(run.config())));
        Ok(Session {
            run,
            estimate,
            data: summary,
            notes,
            first,
            device: device.clone(),
            device_name: device_name.into(),
        })
    }

    /// The run.
    pub fn run(&self) -> &Run {
        &self.run
    }

    /// One line: how long for what, and on what.
    pub fn headline(&self) -> String {
        format!(
            "{} for steps {} to {} on {} ({})",
            self.estimate,
            self.first,
            self.run.config().train.steps,
            self.device_name,
            compute::describe(&self.device)
        )
    }

    /// Trains and scores.
    ///
    /// # Errors
    /// Those of [`Run::train`] and [`Run::test`].
    pub fn finish(mut self) -> anyhow::Result<Outcome> {
        match self.run.train(&self.device_name)? {
            Ended::Stopped { signal, step } => Ok(Outcome::Stopped { signal, step }),
            Ended::Done => Ok(Outcome::Scored(self.run.test(&self.device)?)),
        }
    }
}

/// The checkpoint to go on from; the run directory is brought to where it left off if it may be `written`.
fn latest(
    config: &Config,
    run: &Path,
    written: bool,
    device: &Device,
    notes: &mut Vec<String>,
) -> anyhow::Result<Option<Checkpoint>> {
    let Found { intact, damaged } = Store::new(run).newest_intact()?;
    let Some(intact) = intact else {
        ensure!(
            damaged.is_empty(),
            "{}: no checkpoint is whole: {}",
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
    let checkpoint = checkpoint::load(&intact, &config.train, &device)?;
    notes.push(format!("going on from {}", intact.display()));
    if written {
        notes.extend(checkpoint::restore_run(run, &intact)?);
    }
    Ok(Some(checkpoint))
}
