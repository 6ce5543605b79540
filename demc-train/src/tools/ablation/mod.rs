//! Ablation: several variants with several seeds each, trained alike and compared on the test
//! split.
//!
//! [`AblationSpec`] describes the comparison. [`run`] trains the runs that are not complete, seed
//! by seed, so that a stopped ablation has complete seeds. Each complete run adds its scores to
//! [`results`]. Then [`baselines`], methods without training, are scored. [`Comparison`] summarises all
//! in a table.

pub mod baselines;
pub mod comparison;
mod figure;
mod pictures;
pub mod results;
pub mod spec;
mod table;

use std::collections::BTreeMap;
use std::collections::btree_map::Entry;
use std::fs;
use std::path::{Path, PathBuf};

use anyhow::{Context, bail, ensure};
use demc_data::DataConfig;
use demc_infer::BundleFile;
use demc_infer::evaluate::{ImageScore, Report};
use demc_model::metrics::METRICS;
use demc_program::checksum::sha256_of;
use demc_program::message::printable;
use demc_program::output::{Directories, Outputs};

use crate::config::{Config, HASH_DIGITS};
use crate::record::metrics_log;
use crate::record::progress::say;
use crate::run::checkpoint::store::CheckpointStore;
use crate::run::data::{DataContents, protect_inputs};
use crate::run::initial::read_init;
use crate::run::place::SessionPlace;
use crate::run::run_dir::{RunDir, SCORES};
use crate::run::session::{Session, SessionOptions};
use crate::run::signals::{Outcome, Stopped};
use comparison::Comparison;
use results::{ImageValue, RESULTS, ScoredRun};
use spec::AblationSpec;

/// One run of an ablation.
struct PlannedRun {
    /// `DEMC, seed 1 (2 of 9)`
    name: String,
    variant: String,
    /// Keys outside `[model]` in which the variant differs from the first one.
    settings: String,
    config: Config,
}

/// The planned runs that are complete and those that are not.
struct Progress {
    /// The complete runs, in the order of the table: variant by variant.
    complete: Vec<ScoredRun>,
    /// A line about each complete run, in training order.
    notes: Vec<String>,
    /// The numbers of the planned runs that are not complete.
    missing: Vec<usize>,
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
    let mut files = DataFiles::new();
    let missing = reduce.from_first(|| {
        check_init(spec)?;
        check_outputs(spec)?;
        files = data_files(spec)?;
        let progress = collect(spec, &planned, &files)?;
        progress.notes.iter().for_each(say);
        Ok(progress.missing)
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
        let stopped = train(spec, run, &place).with_context(|| run.name.clone())?;
        if reduce.is_first() {
            collect(spec, &planned, &files)?;
        }
        Ok(stopped)
    })?;
    let progress = reduce.is_first().then(|| collect(spec, &planned, &files));
    let progress = reduce.agree(progress.transpose())?;
    if let Some(stopped) = stopped {
        return Ok(Outcome::Stopped(stopped));
    }
    let compared = progress.map(|progress| {
        if let Some(index) = progress.missing.first() {
            let dir = planned[*index].config.run_dir().display();
            bail!("{dir}: no test split to compare on");
        }
        let mut runs = progress.complete;
        runs.extend(baselines::scored(spec, &files)?);
        pictures::write(spec)?;
        Comparison::new(&runs).with_context(|| spec.dir.display().to_string())
    });
    let comparison = reduce.agree(compared.transpose())?;
    Ok(Outcome::Complete(comparison.map(Box::new)))
}

/// All runs, seed by seed.
fn planned(spec: &AblationSpec) -> Vec<PlannedRun> {
    let total: usize = spec.variants.iter().map(|variant| variant.seeds).sum();
    let runs = spec
        .seeds
        .iter()
        .enumerate()
        .flat_map(|(index, seed)| {
            let variants = spec.variants.iter();
            let trained = variants.filter(move |variant| index < variant.seeds);
            trained.map(move |variant| (seed, variant))
        })
        .enumerate()
        .map(|(index, (seed, variant))| PlannedRun {
            name: format!("{}, seed {seed} ({} of {total})", variant.name, index + 1),
            variant: variant.name.clone(),
            settings: spec.differences_of(variant).join("; "),
            config: spec.run(variant, *seed),
        });
    runs.collect()
}

/// The contents of each data set, by its directory and channel layout.
type DataFiles = BTreeMap<(PathBuf, String), DataContents>;

fn data_key(data: &DataConfig) -> (PathBuf, String) {
    (data.root.clone(), data.layout.clone())
}

fn data_files(spec: &AblationSpec) -> anyhow::Result<DataFiles> {
    let mut files = DataFiles::new();
    for variant in &spec.variants {
        let data = &variant.config.data;
        if let Entry::Vacant(entry) = files.entry(data_key(data)) {
            entry.insert(DataContents::of(&data.root, &data.layout)?);
        }
    }
    Ok(files)
}

/// Looks for complete runs: in their directories, then in `results.csv`, whose rows count if
/// configuration and data are the same. Writes the rows of all complete runs. Rows of other runs stay at the
/// end of the file.
fn collect(
    spec: &AblationSpec,
    planned: &[PlannedRun],
    files: &DataFiles,
) -> anyhow::Result<Progress> {
    let path = spec.dir.join(RESULTS);
    let stored = results::read(&path)?;
    let mut others = stored.clone();
    let mut found_runs: Vec<Option<ScoredRun>> = Vec::new();
    let mut notes = Vec::new();
    for run in planned {
        let is_stored =
            |row: &ScoredRun| row.variant == run.variant && row.seed == run.config.train.seed;
        let data = &files[&data_key(&run.config.data)];
        let hash = run.config.hash(&data.text);
        let is_same = |row: &&ScoredRun| is_stored(row) && row.configuration == hash;
        let in_file = || Some((stored.iter().find(is_same)?.clone(), path.as_path()));
        let in_dir = finished(run, data)?.map(|found| (found, run.config.run_dir()));
        let found = in_dir.or_else(in_file);
        if let Some((_, place)) = &found {
            notes.push(format!("== {}: complete in {}", run.name, place.display()));
            others.retain(|row| !is_stored(row));
        }
        found_runs.push(found.map(|(run, _)| run));
    }
    let missing = (0..planned.len()).filter(|index| found_runs[*index].is_none());
    let missing = missing.collect();
    let order = |run: &ScoredRun| {
        let mut variants = spec.variants.iter();
        variants.position(|variant| variant.name == run.variant)
    };
    let mut complete: Vec<ScoredRun> = found_runs.into_iter().flatten().collect();
    complete.sort_by_key(order);
    let all = [complete.as_slice(), &others].concat();
    if all != stored {
        results::write(&path, &all)?;
    }
    Ok(Progress {
        complete,
        notes,
        missing,
    })
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
    outputs.claim(&spec.dir.join(RESULTS), true)?;
    for file in table::files(&spec.dir)
        .into_iter()
        .chain(pictures::files(spec))
    {
        outputs.claim(&file, true)?;
    }
    table::check_own(&spec.dir)?;
    Ok(outputs.prepare(Directories::Create)?)
}

/// The scores of a run whose directory is complete, on this data.
fn finished(run: &PlannedRun, data: &DataContents) -> anyhow::Result<Option<ScoredRun>> {
    let config = &run.config;
    let dir = config.run_dir();
    let scores = dir.join(SCORES);
    let last = CheckpointStore::new(dir).has(config.train.steps);
    if !scores.exists() || !last {
        return Ok(None);
    }
    let saved = Config::load(&dir.join("config.toml"), &[])?;
    let mut differences = config.differences(&saved);
    if config.data.layout != saved.data.layout {
        differences.push(format!(
            "data.layout: {} instead of {}",
            config.data.layout, saved.data.layout
        ));
    }
    ensure!(
        differences.is_empty(),
        "{}: contains a run with another configuration: {}; undo the edit, or name another directory with --run-dir",
        dir.display(),
        differences.join("; ")
    );
    RunDir::unclaimed(config).check_files(&data.checksums)?;
    let text = fs::read_to_string(&scores).with_context(|| scores.display().to_string())?;
    let report: Report =
        serde_json::from_str(&text).with_context(|| scores.display().to_string())?;
    let seconds = metrics_log::elapsed(&dir.join(metrics_log::METRICS)).unwrap_or(f64::NAN);
    let mut weights = sha256_of(&BundleFile::read(dir)?.path)?;
    weights.truncate(HASH_DIGITS);
    Ok(Some(ScoredRun {
        variant: run.variant.clone(),
        seed: config.train.seed,
        configuration: config.hash(&data.text),
        weights,
        steps: config.train.steps,
        minutes: seconds / 60.0,
        width: config.model.width,
        parameters: config.model.parameter_count(),
        flops_per_pixel: config.model.flops_per_pixel(),
        settings: run.settings.clone(),
        scores: report.images.iter().flat_map(values_of).collect(),
    }))
}

/// The values of all metrics of an image that have one.
fn values_of(image: &ImageScore) -> impl Iterator<Item = ImageValue> {
    METRICS.iter().filter_map(|metric| {
        Some(ImageValue {
            image: image.name.clone(),
            base: image.base_scene().to_owned(),
            metric: metric.name.to_owned(),
            value: image.denoised.get(metric.name)?,
        })
    })
}

/// Compares the runs of the file `results` and writes table, numbers, and figures beside it. Returns
/// the comparison and the paths.
///
/// # Errors
/// A file without comparable runs; a file that cannot be written.
pub fn remake(results: &Path) -> anyhow::Result<(Comparison, [PathBuf; 4])> {
    let dir = results.parent().unwrap_or(Path::new(""));
    ensure!(results.exists(), "{}: no such file", results.display());
    let runs = results::read(results)?;
    let comparison =
        Comparison::new(&runs).with_context(|| printable(&results.display().to_string()))?;
    let mut outputs = Outputs::default();
    outputs.protect(results, "the results");
    for file in table::files(dir) {
        outputs.claim(&file, true)?;
    }
    outputs.prepare(Directories::Expect)?;
    table::check_own(dir)?;
    let paths = write(&comparison, dir)?;
    Ok((comparison, paths))
}

/// Writes table, numbers, and figures of a comparison into `dir`; returns the paths.
///
/// # Errors
/// A file that cannot be written.
pub fn write(comparison: &Comparison, dir: &Path) -> anyhow::Result<[PathBuf; 4]> {
    table::write(comparison, dir)
}

/// The table of a comparison with explanation and conclusions, as Markdown.
pub fn markdown(comparison: &Comparison) -> String {
    table::markdown(comparison)
}
