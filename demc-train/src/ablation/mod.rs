//! Ablation: several variants, each from several seeds, trained alike and compared on the test split.
//!
//! [`Spec`] says what is compared, [`run`] trains what is not trained yet (seed by seed, so that an ablation that
//! was stopped early compares whole seeds), [`Comparison`] makes one table and one figure of the scores.

mod comparison;
mod spec;
mod table;

use std::fs;
use std::path::Path;

use anyhow::Context;
use burn::tensor::Device;
use demc_infer::evaluate::Report;

use crate::checkpoint::Store;
use crate::config::Config;
use crate::initial::read_init;
use crate::metrics_log;
use crate::progress::say;
use crate::session::{Manner, Outcome, Session};
pub use comparison::{Comparison, Row};
pub use demc_infer::statistics::{Estimate, RESAMPLES};
pub use spec::{Spec, Variant};

/// Scores of the test split in a run directory.
const SCORES: &str = "test.json";

/// How an ablation ended.
#[derive(Debug)]
pub enum Ended {
    /// Every run is complete.
    Done(Comparison),
    /// A signal came; everything is saved.
    Stopped {
        /// The signal.
        signal: i32,
        /// The last step of the run under way.
        step: u64,
    },
}

/// A complete run.
#[derive(Clone, Debug)]
pub struct Finished {
    /// Scores of the test split.
    pub report: Report,
    /// Seconds of training.
    pub seconds: f64,
}

/// Trains every run of `spec` that is not complete, and compares them. `device` is plain.
///
/// # Errors
/// A run that cannot be trained or read; runs without a test split; before anything is trained, a `train.init` that does not fit.
pub fn run(spec: &Spec, device: &Device, device_name: &str) -> anyhow::Result<Ended> {
    check_init(spec)?;
    let total = spec.seeds.len() * spec.variants.len();
    let mut runs = vec![Vec::new(); spec.variants.len()];
    let mut number = 0;
    for seed in &spec.seeds {
        for (variant, runs) in spec.variants.iter().zip(&mut runs) {
            number += 1;
            let config = spec.run(variant, *seed);
            let dir = config.run.dir.clone();
            let name = format!("{}, seed {seed} ({number} of {total})", variant.name);
            if let Some(finished) = finished(&config)? {
                say(format!("== {name}: complete in {}", dir.display()));
                runs.push(finished);
                continue;
            }
            let manner = Manner {
                resume: true,
                check: false,
            };
            let session = Session::open(config.clone(), manner, device, device_name)
                .with_context(|| name.clone())?;
            say(format!("\n== {name}: {}", session.headline()));
            for note in &session.notes {
                say(format!("note: {note}"));
            }
            match session.finish().with_context(|| name.clone())? {
                Outcome::Stopped { signal, step } => return Ok(Ended::Stopped { signal, step }),
                Outcome::Scored(_) => {
                    let found = finished(&config)?;
                    runs.push(found.with_context(|| {
                        format!("{}: no test split, nothing to compare", dir.display())
                    })?);
                }
            }
        }
    }
    Ok(Ended::Done(Comparison::new(spec, &runs)?))
}

/// Checks that each run that has not begun can begin with what its `train.init` says: known before the first one trains for hours.
fn check_init(spec: &Spec) -> anyhow::Result<()> {
    for seed in &spec.seeds {
        for variant in &spec.variants {
            let config = spec.run(variant, *seed);
            if !config.run.dir.exists() {
                read_init(&config).with_context(|| variant.name.clone())?;
            }
        }
    }
    Ok(())
}

/// The scores of a run that is complete; `None` of one that is not.
fn finished(config: &Config) -> anyhow::Result<Option<Finished>> {
    let dir = &config.run.dir;
    let scores = dir.join(SCORES);
    let last = Store::new(dir).has(config.train.steps);
    if !scores.exists() || !last {
        return Ok(None);
    }
    let saved = Config::load(&dir.join("config.toml"), &[])?;
    let differences = config.differences(&saved);
    anyhow::ensure!(
        differences.is_empty(),
        "{}: holds a run with another configuration: {}",
        dir.display(),
        differences.join("; ")
    );
    let text = fs::read_to_string(&scores).with_context(|| scores.display().to_string())?;
    let report = serde_json::from_str(&text).with_context(|| scores.display().to_string())?;
    let seconds = metrics_log::elapsed(&dir.join("metrics.jsonl")).unwrap_or(f64::NAN);
    Ok(Some(Finished { report, seconds }))
}

/// Writes table and figure of a comparison into `dir`.
///
/// # Errors
/// A file that cannot be written.
pub fn write(comparison: &Comparison, dir: &Path) -> anyhow::Result<Vec<std::path::PathBuf>> {
    table::write(comparison, dir)
}

/// The table of a comparison, what it says, and how to read it.
pub fn markdown(comparison: &Comparison) -> String {
    table::markdown(comparison)
}
