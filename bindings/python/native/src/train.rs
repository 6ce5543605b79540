//! A training run in this process.

use std::path::PathBuf;

use demc_infer::device;
use demc_program::message;
use demc_train::Config;
use demc_train::ranks::Reduce;
use demc_train::run::observer::TakenStep;
use demc_train::run::place::SessionPlace;
use demc_train::run::session::{Session, SessionOptions};
use demc_train::run::signals::Outcome;
use pyo3::prelude::*;

use crate::error::exception;
use crate::work::{self, Caller};

/// The signal that stops a run, SIGINT: the number is only a record.
const INTERRUPT: i32 = 2;

/// What the package gets of a finished run: run directory, the sentence on the kept weights, their step
/// and scores as JSON, warnings about the data, and notes.
type Finished = (
    PathBuf,
    String,
    Option<(u64, String)>,
    Vec<String>,
    Vec<String>,
);

/// A step as a tuple: step, steps, loss, norm of the gradient, learning rate, RelMSE and SSIM of a
/// validation.
type Step = (u64, u64, f64, f64, f64, Option<f64>, Option<f64>);

/// Trains a run, new or resumed, and scores it. `sets` are edits `table.key=value` of the
/// configuration. `on_step` gets every step. With `quiet`, nothing is printed.
#[pyfunction]
pub fn train(
    py: Python<'_>,
    config: PathBuf,
    sets: Vec<String>,
    resume: bool,
    quiet: bool,
    on_step: Option<Py<PyAny>>,
) -> PyResult<Finished> {
    let hear = on_step
        .map(|on_step| move |py: Python<'_>, step: Step| on_step.call1(py, step).map(|_| ()));
    let train = |caller: Caller<Step>| -> anyhow::Result<Finished> {
        let config = Config::load(&config, &sets)?;
        let dir = config.run_dir().to_path_buf();
        let place = SessionPlace {
            device: device::parse("flex")?,
            device_name: "flex".into(),
            reduce: Reduce::default(),
        };
        let options = SessionOptions {
            resume,
            check: false,
        };
        let session = Session::open(config, options, &place)?;
        session.check_outputs(&[])?;
        let (warnings, notes) = (session.warnings.clone(), session.notes.clone());
        let outcome = session.finish_observed(|step| {
            let is_last = caller.call(values(step)).is_break();
            is_last.then_some(INTERRUPT)
        })?;
        let (kept, scores) = match outcome {
            Outcome::Complete(finished) => (finished.kept, finished.scores),
            // The exception that stopped the run takes the place of the result.
            Outcome::Stopped(_) => (String::new(), None),
        };
        let scores = match scores {
            Some(found) => Some((found.step, serde_json::to_string(&found.report)?)),
            None => None,
        };
        Ok((dir, kept, scores, warnings, notes))
    };
    let was_silent = message::is_silent();
    message::silence(quiet);
    let finished = work::run(py, train, hear);
    message::silence(was_silent);
    finished?.map_err(exception)
}

fn values(step: &TakenStep) -> Step {
    let TakenStep {
        step,
        steps,
        loss,
        grad_norm,
        lr,
        valid_relmse,
        valid_ssim,
        ..
    } = *step;
    (step, steps, loss, grad_norm, lr, valid_relmse, valid_ssim)
}
