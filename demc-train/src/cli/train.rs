//! Training: flags to a resolved configuration, and what is printed around a run.

use std::path::PathBuf;
use std::process::ExitCode;

use clap::Args;
use demc_infer::compute::{self, ComputeFlags};
use demc_infer::device;
use demc_train::checkpoint::{self, Checkpoint, Found, Store};
use demc_train::config::Config;
use demc_train::data::Data;
use demc_train::estimate::Estimate;
use demc_train::progress::say;
use demc_train::run_dir::RunDir;
use demc_train::signals;
use demc_train::train::{Ended, Run};

#[derive(Debug, Args)]
pub struct Arguments {
    /// Configuration of the run
    #[arg(short, long, value_name = "FILE")]
    config: PathBuf,

    /// Directory of the run, instead of the configuration's run.dir (default: runs/ and the configuration's name)
    #[arg(short, long, value_name = "DIR")]
    run_dir: Option<PathBuf>,

    /// Continue the run in the run directory from its latest checkpoint, bit for bit
    #[arg(long)]
    resume: bool,

    /// Where to compute: flex (CPU), or ndarray, wgpu[:N], cuda[:N] in a build with that feature
    #[arg(short, long, value_name = "DEVICE", default_value = "flex")]
    device: String,

    #[command(flatten)]
    compute: ComputeFlags,

    /// Change a key of the configuration, such as train.steps=1000; can be given several times
    #[arg(short, long, value_name = "KEY=VALUE")]
    set: Vec<String>,

    /// Check configuration and data, tell how long the run will take, and stop; nothing is written
    #[arg(long)]
    check: bool,
}

/// Trains, or goes on.
pub fn run(arguments: Arguments) -> anyhow::Result<ExitCode> {
    let mut sets = arguments.set;
    if let Some(dir) = &arguments.run_dir {
        sets.push(format!(
            "run.dir={}",
            toml::Value::String(dir.to_string_lossy().into_owned())
        ));
    }
    let config = Config::load(&arguments.config, &sets)?;
    arguments.compute.apply()?;
    let mut dir = RunDir::claim(&config, arguments.resume)?;
    if !arguments.check {
        dir.lock_if_there()?;
    }
    let device = device::parse(&arguments.device)?;
    let data = Data::open(&config.data, config.train.seed)?;
    let mut notes = Vec::new();
    let checkpoint = match arguments.resume {
        true => latest(&config, &dir, !arguments.check, &device, &mut notes)?,
        false => None,
    };
    let first = checkpoint
        .as_ref()
        .map_or(0, |checkpoint| checkpoint.state.step);
    let estimate = Estimate::measure(&config, &data, first, &device.clone().autodiff());
    let run_path = dir.path().to_owned();
    say(format!(
        "demc-train: {estimate} for steps {first} to {} on {} ({})",
        config.train.steps,
        arguments.device,
        compute::describe(&device)
    ));
    say(format!("\n{}", config.to_toml()));
    say(format!(
        "data: {} in {}",
        data.summary(),
        config.data.root.display()
    ));
    if data.clamped > 0 {
        say(format!(
            "data: {} negative values of radiance count as 0",
            data.clamped
        ));
    }
    for note in notes {
        say(format!("note: {note}"));
    }
    let mut run = Run::new(config, data, dir, checkpoint, &device)?;
    say(format!(
        "network: {} trainable parameters",
        run.parameters()
    ));
    say(format!(
        "patches: {} an epoch, {} a step",
        run.patches(),
        run.patches_per_step()
    ));
    if arguments.check {
        say("check: all is well; nothing was written");
        return Ok(ExitCode::SUCCESS);
    }
    say(format!("run: {}\n", run_path.display()));
    if let Ended::Stopped { signal, step } = run.train(&arguments.device)? {
        say(format!(
            "\n{}: stopped after step {step}, everything is saved; --resume goes on from there",
            signals::name(signal)
        ));
        return Ok(ExitCode::from(signals::exit_code(signal) as u8));
    }
    match run.test(&device)? {
        Some((step, report)) => say(format!("\nTest split, weights of step {step}:\n\n{report}")),
        None => say("\nThe data set has no test split: nothing to score."),
    }
    say(format!(
        "\nweights, pictures and scores: {}",
        run_path.display()
    ));
    Ok(ExitCode::SUCCESS)
}

/// The checkpoint to go on from, the run directory brought to where it left off if it may be `written`; what the user should
/// know goes to `notes`.
fn latest(
    config: &Config,
    dir: &RunDir,
    written: bool,
    device: &burn::tensor::Device,
    notes: &mut Vec<String>,
) -> anyhow::Result<Option<Checkpoint>> {
    let Found { intact, damaged } = Store::new(dir.path()).newest_intact()?;
    let Some(intact) = intact else {
        anyhow::ensure!(
            damaged.is_empty(),
            "{}: no checkpoint is whole: {}",
            dir.path().display(),
            damaged.join("; ")
        );
        let path = dir.path().display();
        notes.push(format!("no checkpoint in {path}: starting at step 0"));
        return Ok(None);
    };
    notes.extend(damaged);
    let device = device.clone().autodiff();
    let checkpoint = checkpoint::load(&intact, config.train.adam_epsilon, &device)?;
    notes.push(format!("going on from {}", intact.display()));
    if written {
        notes.extend(checkpoint::restore_run(dir.path(), &intact)?);
    }
    Ok(Some(checkpoint))
}
