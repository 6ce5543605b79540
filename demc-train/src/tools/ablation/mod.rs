//! Ablation: several variants with several seeds each, trained alike and compared on the test
//! split.
//!
//! [`AblationSpec`] describes the comparison. [`run`] trains the runs that are not complete, seed
//! by seed, so that a stopped ablation has complete seeds. [`Comparison`] summarises the scores in
//! a table and a figure.

pub mod comparison;
pub mod spec;
mod table;

use std::fs;
use std::path::{Path, PathBuf};

use anyhow::Context;
use burn::tensor::Device;
use demc_data::output::{Directories, Outputs};

use crate::config::Config;
use crate::record::metrics_log;
use crate::record::progress::say;
use crate::run::checkpoint::store::CheckpointStore;
use crate::run::data::protect_inputs;
use crate::run::initial::read_init;
use crate::run::run_dir::SCORES;
use crate::run::session::{Session, SessionOptions, SessionOutcome};
use comparison::{Comparison, FinishedRun};
use spec::AblationSpec;

/// How an ablation ended.
#[derive(Debug)]
pub enum AblationOutcome {
    /// Every run is complete.
    Done(Comparison),
    /// A signal stopped it; everything is saved.
    Stopped {
        /// The signal.
        signal: i32,
        /// The last step of the current run.
        step: u64,
    },
}

/// Trains every run of `spec` that is not complete, and compares them. `device` has no autodiff.
///
/// # Errors
/// Before any training: a `train.init` of another network, or a result that would replace an input
/// or cannot be written. Later: a run that cannot be trained or read; no test split.
pub fn run(
    spec: &AblationSpec,
    device: &Device,
    device_name: &str,
) -> anyhow::Result<AblationOutcome> {
    check_init(spec)?;
    check_outputs(spec)?;
    let total = spec.seeds.len() * spec.variants.len();
    let mut runs = vec![Vec::new(); spec.variants.len()];
    let mut number = 0;
    for seed in &spec.seeds {
        for (variant, runs) in spec.variants.iter().zip(&mut runs) {
            number += 1;
            let config = spec.run(variant, *seed);
            let dir = config.run_dir().to_path_buf();
            let name = format!("{}, seed {seed} ({number} of {total})", variant.name);
            if let Some(finished) = finished(&config)? {
                say(format!("== {name}: complete in {}", dir.display()));
                runs.push(finished);
                continue;
            }
            let options = SessionOptions {
                resume: true,
                check: false,
            };
            let session = Session::open(config.clone(), options, device, device_name)
                .with_context(|| name.clone())?;
            session.check_outputs(&spec.files)?;
            say(format!("\n== {name}: {}", session.headline()));
            for warning in &session.warnings {
                say(format!("warning: {warning}"));
            }
            for note in &session.notes {
                say(format!("note: {note}"));
            }
            match session.finish().with_context(|| name.clone())? {
                SessionOutcome::Stopped { signal, step } => {
                    return Ok(AblationOutcome::Stopped { signal, step });
                }
                SessionOutcome::Complete { .. } => {
                    let found = finished(&config)?;
                    runs.push(found.with_context(|| {
                        format!("{}: no test split to compare on", dir.display())
                    })?);
                }
            }
        }
    }
    Ok(AblationOutcome::Done(Comparison::new(spec, &runs)?))
}

fn check_init(spec: &AblationSpec) -> anyhow::Result<()> {
    for seed in &spec.seeds {
        for variant in &spec.variants {
            let config = spec.run(variant, *seed);
            if !config.run_dir().exists() {
                read_init(&config).with_context(|| variant.name.clone())?;
            }
        }
    }
    Ok(())
}

fn check_outputs(spec: &AblationSpec) -> anyhow::Result<()> {
    let mut outputs = Outputs::default();
    for variant in &spec.variants {
        protect_inputs(&mut outputs, &spec.files, &variant.config)?;
    }
    for file in table::files(&spec.dir) {
        outputs.claim(&file, true)?;
    }
    Ok(outputs.prepare(Directories::Create)?)
}

fn finished(config: &Config) -> anyhow::Result<Option<FinishedRun>> {
    let dir = config.run_dir();
    let scores = dir.join(SCORES);
    let last = CheckpointStore::new(dir).has(config.train.steps);
    if !scores.exists() || !last {
        return Ok(None);
    }
    let saved = Config::load(&dir.join("config.toml"), &[])?;
    let differences = config.differences(&saved);
    anyhow::ensure!(
        differences.is_empty(),
        "{}: contains a run with another configuration: {}",
        dir.display(),
        differences.join("; ")
    );
    let text = fs::read_to_string(&scores).with_context(|| scores.display().to_string())?;
    let report = serde_json::from_str(&text).with_context(|| scores.display().to_string())?;
    let seconds = metrics_log::elapsed(&dir.join("metrics.jsonl")).unwrap_or(f64::NAN);
    Ok(Some(FinishedRun { report, seconds }))
}

/// Writes table and figure of a comparison into `dir`; returns the paths.
///
/// # Errors
/// A file that cannot be written.
pub fn write(comparison: &Comparison, dir: &Path) -> anyhow::Result<[PathBuf; 3]> {
    table::write(comparison, dir)
}

/// The table of a comparison with explanation and conclusions, as Markdown.
pub fn markdown(comparison: &Comparison) -> String {
    table::markdown(comparison)
}
