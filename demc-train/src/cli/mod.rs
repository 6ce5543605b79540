//! The command line: one verb a file, training where no verb is given.

mod ablate;
mod find_lr;
mod plot;
mod train;

use std::path::Path;
use std::process::ExitCode;

use burn::tensor::Device;
use clap::{Args, Parser, Subcommand};
use demc_infer::compute::ComputeFlags;
use demc_infer::device;
use demc_train::progress::say;
use demc_train::signals;

/// Train a DEMC Monte Carlo denoiser on rendered images.
///
/// The configuration is a TOML file with the tables [model], [data], [train] and [run]; configs/demc.toml names every
/// key. The run directory keeps the resolved configuration, metrics.jsonl, TensorBoard events, checkpoints, the best
/// weights and pictures; `demc-infer --model RUN_DIR` uses it as it is.
///
/// Ctrl-C saves and stops, and --resume goes on; a second Ctrl-C stops at once.
#[derive(Debug, Parser)]
#[command(
    version,
    after_help = EXAMPLES,
    args_conflicts_with_subcommands = true,
    subcommand_negates_reqs = true
)]
pub struct Arguments {
    #[command(subcommand)]
    verb: Option<Verb>,

    #[command(flatten)]
    train: train::Arguments,
}

#[derive(Debug, Subcommand)]
enum Verb {
    FindLr(find_lr::Arguments),
    Ablate(ablate::Arguments),
    Plot(plot::Arguments),
}

/// Where and with what to compute.
#[derive(Debug, Args)]
struct ComputeArguments {
    /// Where to compute: flex (CPU), or ndarray, wgpu[:N], cuda[:N] in a build with that feature
    #[arg(short, long, value_name = "DEVICE", default_value = "flex")]
    device: String,

    #[command(flatten)]
    flags: ComputeFlags,
}

impl ComputeArguments {
    /// The device, without autodiff; operations and instructions are set for the process.
    fn device(&self) -> anyhow::Result<Device> {
        self.flags.apply()?;
        Ok(device::parse(&self.device)?)
    }
}

const EXAMPLES: &str = "\
Examples:
  demc-train --config configs/quickstart.toml
  demc-train --config configs/demc.toml --set data.root=/renders --run-dir runs/mine --device cuda
  demc-train --config configs/demc.toml --run-dir runs/mine --resume
  demc-train find-lr --config configs/demc.toml
  demc-train ablate --config configs/ablation.toml
  demc-train plot runs/mine runs/other";

/// Runs the program.
pub fn run(arguments: Arguments) -> anyhow::Result<ExitCode> {
    match arguments.verb {
        Some(Verb::FindLr(arguments)) => find_lr::run(arguments),
        Some(Verb::Ablate(arguments)) => ablate::run(arguments),
        Some(Verb::Plot(arguments)) => plot::run(arguments),
        None => train::run(arguments.train),
    }
}

/// The edit that gives a run another directory.
fn run_dir_set(dir: &Path) -> String {
    let dir = toml::Value::String(dir.to_string_lossy().into_owned());
    format!("run.dir={dir}")
}

/// Says that a signal ended the run after this step and how to go on; gives the exit code.
fn stopped(signal: i32, step: u64, how: &str) -> ExitCode {
    say(format!(
        "\n{}: stopped after step {step}, everything is saved; {how} from there",
        signals::name(signal)
    ));
    ExitCode::from(u8::try_from(signals::exit_code(signal)).unwrap_or(1))
}
