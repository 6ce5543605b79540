//! `demc-train find-lr`: what learning rate to start with.

use std::path::{Path, PathBuf};
use std::process::ExitCode;

use clap::Args;
use demc_train::config::Config;
use demc_train::data::Data;
use demc_train::find_lr::{Range, sweep};
use demc_train::progress::{Progress, say};

use super::ComputeArguments;

/// Find a learning rate: train the network that the run begins with while the rate climbs, and stop when the loss diverges
///
/// Writes every step to STEM.csv and a picture to STEM.svg and STEM.png. No run directory is touched.
#[derive(Debug, Args)]
pub struct Arguments {
    /// Configuration of the run that the rate is for
    #[arg(short, long, value_name = "FILE")]
    config: PathBuf,

    /// First learning rate
    #[arg(long, value_name = "RATE", default_value_t = 1e-6)]
    from: f64,

    /// Last learning rate, if nothing diverges before
    #[arg(long, value_name = "RATE", default_value_t = 1.0)]
    to: f64,

    /// Steps from the one to the other
    #[arg(long, value_name = "N", default_value_t = 300)]
    steps: usize,

    /// Files to write, without ending (default: runs/find-lr/ and the configuration's name)
    #[arg(short, long, value_name = "STEM")]
    out: Option<PathBuf>,

    #[command(flatten)]
    compute: ComputeArguments,

    /// Change a key of the configuration, such as model.width=32; can be given several times
    #[arg(short, long, value_name = "KEY=VALUE")]
    set: Vec<String>,
}

/// Sweeps.
pub fn run(arguments: Arguments) -> anyhow::Result<ExitCode> {
    let Arguments {
        from, to, steps, ..
    } = arguments;
    anyhow::ensure!(
        from > 0.0 && from < to && to.is_finite() && steps >= 10,
        "--from {from} --to {to} --steps {steps}: the rates must be positive and climb, in 10 steps or more"
    );
    let config = Config::load(&arguments.config, &arguments.set)?;
    let device = arguments.compute.device()?;
    let data = Data::open(&config.data, config.train.seed)?;
    say(format!(
        "data: {} in {}",
        data.summary(),
        config.data.root.display()
    ));
    let name = arguments.config.file_stem().unwrap_or_default();
    let stem = arguments
        .out
        .unwrap_or_else(|| Path::new("runs/find-lr").join(name));
    let per_step = config.patches_per_step();
    let progress = Progress::new(0, steps as u64, per_step, data.train.len());
    let mut done = 0;
    let range = Range { from, to, steps };
    let found = sweep(&config, &data, range, &device, |point| {
        done += 1;
        progress.step(done, point.loss);
    })?;
    progress.finish();
    let last = found.points.last().map_or(from, |point| point.lr);
    match found.diverged {
        true => say(format!(
            "the loss diverged at a learning rate of {last:.1e}"
        )),
        false => say(format!("the loss did not diverge up to {last:.1e}")),
    }
    match found.suggestion() {
        Some(lr) => say(format!(
            "suggestion: --set train.lr_start={lr:e}, a tenth of where the loss was smallest"
        )),
        None => say("the loss never fell below that of the untrained network: no suggestion"),
    }
    for path in found.write(&stem)? {
        say(path.display());
    }
    Ok(ExitCode::SUCCESS)
}
