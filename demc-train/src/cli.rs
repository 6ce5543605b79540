//! The command line: flags to a resolved configuration, and what is printed around a run.

use std::path::PathBuf;

use clap::Parser;
use demc_infer::compute::{self, ComputeFlags};
use demc_infer::device;
use demc_train::checkpoint;
use demc_train::config::Config;
use demc_train::data::Data;
use demc_train::estimate::Estimate;
use demc_train::progress::say;
use demc_train::run_dir::RunDir;
use demc_train::train::Run;

/// Train a DEMC Monte Carlo denoiser on rendered images.
///
/// The configuration is a TOML file with the tables [model], [data], [train] and [run]; configs/demc.toml names every
/// key. The run directory keeps the resolved configuration, metrics.jsonl, checkpoints, the best weights and pictures;
/// `demc-infer --model RUN_DIR` uses it as it is.
#[derive(Debug, Parser)]
#[command(version, after_help = EXAMPLES)]
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

const EXAMPLES: &str = "\
Examples:
  demc-train --config configs/quickstart.toml
  demc-train --config configs/demc.toml --set data.root=/renders --run-dir runs/mine --device cuda
  demc-train --config configs/demc.toml --run-dir runs/mine --resume";

/// Runs the program.
pub fn run(arguments: Arguments) -> anyhow::Result<()> {
    let mut sets = arguments.set;
    if let Some(dir) = &arguments.run_dir {
        sets.push(format!(
            "run.dir={}",
            toml::Value::String(dir.to_string_lossy().into_owned())
        ));
    }
    let config = Config::load(&arguments.config, &sets)?;
    arguments.compute.apply()?;
    let dir = RunDir::claim(&config, arguments.resume)?;
    let device = device::parse(&arguments.device)?;
    let data = Data::open(&config.data, config.train.seed)?;
    let checkpoint = match arguments.resume {
        true => checkpoint::load_latest(
            dir.path(),
            config.train.adam_epsilon,
            &device.clone().autodiff(),
        )?,
        false => None,
    };
    let first = checkpoint
        .as_ref()
        .map_or(0, |checkpoint| checkpoint.state.step);
    let nothing = arguments.resume && checkpoint.is_none();
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
    if nothing {
        say(format!(
            "note: no checkpoint in {}: starting at step 0",
            dir.path().display()
        ));
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
        return Ok(());
    }
    say(format!("run: {}\n", run_path.display()));
    run.train(&arguments.device)?;
    match run.test(&device)? {
        Some((step, report)) => say(format!("\nTest split, weights of step {step}:\n\n{report}")),
        None => say("\nThe data set has no test split: nothing to score."),
    }
    say(format!(
        "\nweights, pictures and scores: {}",
        run_path.display()
    ));
    Ok(())
}
