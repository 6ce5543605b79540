//! Ablation: several variants with several seeds each, trained alike and compared on the test
//! split.
//!
//! [`AblationSpec`] describes the comparison. [`run`] trains the runs that are not complete, seed
//! by seed, so that a stopped ablation has complete seeds. [`Comparison`] summarises the scores in
//! a table.

pub mod comparison;
pub mod spec;
mod table;

use std::fs;
use std::path::{Path, PathBuf};

use anyhow::{Context, ensure};
use demc_program::output::{Directories, Outputs};

use crate::config::Config;
use crate::record::metrics_log;
use crate::record::progress::say;
use crate::run::checkpoint::store::CheckpointStore;
use crate::run::data::protect_inputs;
use crate::run::initial::read_init;
use crate::run::place::SessionPlace;
use crate::run::run_dir::SCORES;
use crate::run::session::{Session, SessionOptions};
use crate::run::signals::{Outcome, Stopped};
use comparison::{Comparison, FinishedRun};
use spec::AblationSpec;

/// One run of an ablation.
struct PlannedRun {
    /// `DEMC, seed 1 (2 of 9)`
    name: String,
    config: Config,
}

/// Trains every run of `spec` that is not complete, and compares them. The processes of `place` train
/// several runs at the same time. The first process has the comparison.
///
/// # Errors
/// Before any training: a `train.init` of another network, or a result that would replace an input
/// or cannot be written. Later: a run that cannot be trained or read; no test split.
pub fn run(
    spec: &AblationSpec,
    place: &SessionPlace,
) -> anyhow::Result<Outcome<Option<Box<Comparison>>>> {
    let reduce = &place.reduce;
    let planned = planned(spec);
    let missing = reduce.from_first(|| {
        check_init(spec)?;
        check_outputs(spec)?;
        missing(&planned)
    })?;
    let divides_steps = |size: usize| {
        let mut variants = spec.variants.iter();
        variants.all(|variant| variant.config.train.grad_accumulation.is_multiple_of(size))
    };
    let stopped = reduce.in_groups(&missing, divides_steps, |group, index| {
        let run = &planned[*index];
        let place = SessionPlace {
            reduce: group.clone(),
            ..place.clone()
        };
        train(spec, run, &place).with_context(|| run.name.clone())
    })?;
    if let Some(stopped) = stopped {
        return Ok(Outcome::Stopped(stopped));
    }
    let comparison = reduce.is_first().then(|| compared(spec, &planned));
    let comparison = reduce.agree(comparison.transpose())?;
    Ok(Outcome::Complete(comparison.map(Box::new)))
}

/// All runs, seed by seed.
fn planned(spec: &AblationSpec) -> Vec<PlannedRun> {
    let total = spec.seeds.len() * spec.variants.len();
    let runs = spec
        .seeds
        .iter()
        .flat_map(|seed| {
            let variants = spec.variants.iter();
            variants.map(move |variant| (seed, variant))
        })
        .enumerate()
        .map(|(index, (seed, variant))| PlannedRun {
            name: format!("{}, seed {seed} ({} of {total})", variant.name, index + 1),
            config: spec.run(variant, *seed),
        });
    runs.collect()
}

/// The numbers of the runs that are not complete.
fn missing(planned: &[PlannedRun]) -> anyhow::Result<Vec<usize>> {
    let mut missing = Vec::new();
    for (index, run) in planned.iter().enumerate() {
        match finished(&run.config)? {
            None => missing.push(index),
            Some(_) => say(format!(
                "== {}: complete in {}",
                run.name,
                run.config.run_dir().display()
            )),
        }
    }
    Ok(missing)
}

/// Trains a run. Returns the signal if one stopped it.
fn train(
    spec: &AblationSpec,
    run: &PlannedRun,
    place: &SessionPlace,
) -> anyhow::Result<Option<Stopped>> {
    let options = SessionOptions {
        resume: true,
        check: false,
    };
    let session = Session::open(run.config.clone(), options, place)?;
    session.check_outputs(&spec.files)?;
    say(format!("\n== {}: {}", run.name, session.headline()));
    if let Some(placement) = &session.placement {
        say(placement);
    }
    for warning in &session.warnings {
        say(format!("warning: {warning}"));
    }
    for note in &session.notes {
        say(format!("note: {note}"));
    }
    match session.finish()? {
        Outcome::Stopped(stopped) => Ok(Some(stopped)),
        Outcome::Complete(finished) => {
            let dir = run.config.run_dir().display();
            ensure!(
                finished.scores.is_some(),
                "{dir}: no test split to compare on"
            );
            Ok(None)
        }
    }
}

/// The comparison of complete runs.
fn compared(spec: &AblationSpec, planned: &[PlannedRun]) -> anyhow::Result<Comparison> {
    let mut runs = vec![Vec::new(); spec.variants.len()];
    for (index, run) in planned.iter().enumerate() {
        let dir = run.config.run_dir();
        let found = finished(&run.config)?
            .with_context(|| format!("{}: no test split to compare on", dir.display()))?;
        runs[index % spec.variants.len()].push(found);
    }
    Comparison::new(spec, &runs)
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
    ensure!(
        differences.is_empty(),
        "{}: contains a run with another configuration: {}; undo the edit, or name another directory with --run-dir",
        dir.display(),
        differences.join("; ")
    );
    let text = fs::read_to_string(&scores).with_context(|| scores.display().to_string())?;
    let report = serde_json::from_str(&text).with_context(|| scores.display().to_string())?;
    let seconds = metrics_log::elapsed(&dir.join(metrics_log::METRICS)).unwrap_or(f64::NAN);
    Ok(Some(FinishedRun { report, seconds }))
}

/// Writes the tables of a comparison into `dir`; returns the paths.
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
