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

use anyhow::Context;
use demc_program::message;
use demc_program::output::{Directories, Outputs};

use crate::config::Config;
use crate::record::metrics_log;
use crate::record::progress::say;
use crate::run::checkpoint::store::CheckpointStore;
use crate::run::data::protect_inputs;
use crate::run::initial::read_init;
use crate::run::run_dir::SCORES;
use crate::run::session::{Session, SessionOptions, SessionOutcome, SessionPlace};
use comparison::{Comparison, FinishedRun};
use spec::AblationSpec;

/// How an ablation ended.
#[derive(Debug)]
pub enum AblationOutcome {
    /// Every run is complete. Rank 0 has the comparison.
    Done(Option<Box<Comparison>>),
    /// A signal stopped it; everything is saved.
    Stopped {
        /// The signal.
        signal: i32,
        /// The last step of the current run.
        step: u64,
    },
}

/// One run of an ablation.
struct PlannedRun {
    /// `DEMC, seed 1 (2 of 9)`
    name: String,
    config: Config,
}

/// Trains every run of `spec` that is not complete, and compares them.
///
/// Groups of ranks train different runs at the same time. Rank 0 of each group prints.
///
/// # Errors
/// Before any training: a `train.init` of another network, or a result that would replace an input
/// or cannot be written. Later: a run that cannot be trained or read; no test split.
pub fn run(spec: &AblationSpec, place: &SessionPlace) -> anyhow::Result<AblationOutcome> {
    let world = &place.ranks;
    let planned = planned(spec);
    let missing = world.from_first(|| {
        check_init(spec)?;
        check_outputs(spec)?;
        missing(&planned)
    })?;
    let size = group_size(spec, world.count(), missing.len());
    let (group, number) = world.split(size);
    let groups = world.count() / size;
    let own = missing.iter().skip(number).step_by(groups);
    // Ranks that are too few for a group wait.
    let own = own.take(if number < groups { usize::MAX } else { 0 });
    message::silence(!group.is_first());
    let place = SessionPlace {
        ranks: group,
        ..place.clone()
    };
    let mut stopped = None;
    for run in own.map(|index| &planned[*index]) {
        let end = train(spec, run, &place).with_context(|| run.name.clone());
        // The other groups do not know of an error.
        stopped = end.map_err(|error| match groups {
            1 => error,
            _ => anyhow::anyhow!("{error:#}"),
        })?;
        if stopped.is_some() {
            break;
        }
    }
    let stopped = world.gather(Ok(stopped))?.into_iter().flatten().next();
    message::silence(!world.is_first());
    if let Some((signal, step)) = stopped {
        return Ok(AblationOutcome::Stopped { signal, step });
    }
    let comparison = world.is_first().then(|| compared(spec, &planned));
    Ok(AblationOutcome::Done(
        world.agree(comparison.transpose())?.map(Box::new),
    ))
}

/// All runs, seed by seed.
fn planned(spec: &AblationSpec) -> Vec<PlannedRun> {
    let total = spec.seeds.len() * spec.variants.len();
    let runs = spec.seeds.iter().flat_map(|seed| {
        let variants = spec.variants.iter();
        variants.map(move |variant| (seed, variant))
    });
    let runs = runs.enumerate().map(|(index, (seed, variant))| PlannedRun {
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

/// Ranks per run: as many as there are for each of `missing` runs, but a divisor of every variant's
/// `train.grad_accumulation`.
fn group_size(spec: &AblationSpec, ranks: usize, missing: usize) -> usize {
    let most = (ranks / missing.max(1)).max(1);
    let divides = |size: &usize| {
        let variants = spec.variants.iter();
        let mut counts = variants.map(|variant| variant.config.train.grad_accumulation);
        counts.all(|count| count.is_multiple_of(*size))
    };
    (1..=most).rev().find(divides).unwrap_or(1)
}

/// Trains a run. Returns the signal and the step if it was stopped.
fn train(
    spec: &AblationSpec,
    run: &PlannedRun,
    place: &SessionPlace,
) -> anyhow::Result<Option<(i32, u64)>> {
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
    Ok(match session.finish()? {
        SessionOutcome::Stopped { signal, step } => Some((signal, step)),
        SessionOutcome::Complete { scores: None, .. } => {
            let dir = run.config.run_dir().display();
            anyhow::bail!("{dir}: no test split to compare on")
        }
        SessionOutcome::Complete { .. } => None,
    })
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
