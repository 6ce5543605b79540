//! `demc-train find-lr`: suggests an initial learning rate.

use std::path::{Path, PathBuf};

use crate::config::Config;
use crate::ranks::Reduce;
use crate::record::progress::{StepProgress, say};
use crate::run::data::{TrainingData, protect_inputs};
use crate::tools::chart::with_extension;
use crate::tools::find_lr::{RateRange, sweep};
use clap::Args;
use demc_program::cli::OverwriteFlag;
use demc_program::exit::UsageError;
use demc_program::message::printable;
use demc_program::output::{Directories, Outputs};

use super::compute::ComputeArguments;

/// Fewest steps of a sweep: the first ten ratios are 1.
const MIN_STEPS: usize = 10;
/// More steps are a mistake.
const MAX_STEPS: usize = 1_000_000;

/// Find a learning rate: train with a rising rate until the loss diverges
///
/// Writes every step to STEM.csv and a chart to STEM.svg. No run directory is touched.
#[derive(Debug, Args)]
pub struct Arguments {
    /// Configuration of the run
    #[arg(short, long, value_name = "FILE")]
    config: PathBuf,

    /// First learning rate
    #[arg(long, value_name = "RATE", default_value_t = 1e-6)]
    from: f64,

    /// Last learning rate, unless the loss diverges before
    #[arg(long, value_name = "RATE", default_value_t = 1.0)]
    to: f64,

    /// Number of steps
    #[arg(long, value_name = "N", default_value_t = 300)]
    steps: usize,

    /// Output files, with or without .svg (default: runs/find-lr/ and the configuration's name, whose files are
    /// replaced)
    #[arg(short, long, value_name = "FILE")]
    out: Option<PathBuf>,

    #[command(flatten)]
    overwrite: OverwriteFlag,

    #[command(flatten)]
    compute: ComputeArguments,

    /// Override a key of the configuration, such as model.width=32; KEY= removes it; can be
    /// repeated
    #[arg(short, long, value_name = "KEY=VALUE")]
    set: Vec<String>,
}

/// Runs the sweep and prints its suggestion.
pub fn run(arguments: Arguments, reduce: &Reduce) -> anyhow::Result<u8> {
    let Arguments {
        from, to, steps, ..
    } = arguments;
    let is_range = from > 0.0 && from < to && to.is_finite();
    if !is_range || !(MIN_STEPS..=MAX_STEPS).contains(&steps) {
        return Err(UsageError(format!(
            "--from {from} --to {to} --steps {steps}: expected positive, rising rates and {MIN_STEPS} to {MAX_STEPS} steps"
        ))
        .into());
    }
    if let Some(stem) = &arguments.out
        && stem.file_name().is_none()
    {
        let stem = stem.display();
        return Err(UsageError(format!("--out {stem}: expected a file name")).into());
    }
    let config = Config::load(&arguments.config, &arguments.set);
    let config = reduce.agree(config.map_err(Into::into))?;
    let name = arguments.config.file_stem().unwrap_or_default();
    let replaces = arguments.overwrite.overwrite || arguments.out.is_none();
    let stem = arguments
        .out
        .unwrap_or_else(|| Path::new("runs/find-lr").join(name));
    let place = arguments.compute.place(reduce)?;
    reduce.check(&config.to_toml(), config.train.grad_accumulation)?;
    let data = reduce.from_first(|| {
        let mut outputs = Outputs::default();
        let file = std::slice::from_ref(&arguments.config);
        protect_inputs(&mut outputs, file, &config)?;
        for extension in ["csv", "svg"] {
            outputs.claim(&with_extension(&stem, extension)?, replaces)?;
        }
        outputs.prepare(Directories::Create)?;
        TrainingData::open(&config)
    })?;
    for warning in &data.warnings {
        say(format!("warning: {}", printable(warning)));
    }
    say(format!(
        "data: {} in {}",
        data.summary(),
        config.data.root.display()
    ));
    let per_step = config.patches_per_step();
    let progress = StepProgress::new(0, steps as u64, per_step, data.train.len());
    let mut done = 0;
    let range = RateRange { from, to, steps };
    let found = sweep(&config, &data, range, &place, |point| {
        done += 1;
        progress.step(done, point.loss);
    })?;
    progress.finish();
    let last = found.points.last().map_or(from, |point| point.lr);
    if found.diverged {
        say(format!(
            "the loss diverged at a learning rate of {last:.1e}"
        ))
    } else {
        say(format!("the loss did not diverge up to {last:.1e}"))
    }
    match found.suggestion() {
        Some(lr) => say(format!(
            "suggestion: --set optimizer.lr_start={lr:e}, a tenth of the rate with the smallest loss"
        )),
        None => say("no suggestion: the loss never fell below that of the untrained network"),
    }
    if !reduce.is_first() {
        return Ok(0);
    }
    for path in found.write(&stem)? {
        say(path.display());
    }
    Ok(0)
}
