//! The command line: one verb a file, training where no verb is given.

mod train;

use std::process::ExitCode;

use clap::Parser;

/// Train a DEMC Monte Carlo denoiser on rendered images.
///
/// The configuration is a TOML file with the tables [model], [data], [train] and [run]; configs/demc.toml names every
/// key. The run directory keeps the resolved configuration, metrics.jsonl, TensorBoard events, checkpoints, the best
/// weights and pictures; `demc-infer --model RUN_DIR` uses it as it is.
///
/// Ctrl-C saves and stops, and --resume goes on; a second Ctrl-C stops at once.
#[derive(Debug, Parser)]
#[command(version, after_help = EXAMPLES)]
pub struct Arguments {
    #[command(flatten)]
    train: train::Arguments,
}

const EXAMPLES: &str = "\
Examples:
  demc-train --config configs/quickstart.toml
  demc-train --config configs/demc.toml --set data.root=/renders --run-dir runs/mine --device cuda
  demc-train --config configs/demc.toml --run-dir runs/mine --resume";

/// Runs the program.
pub fn run(arguments: Arguments) -> anyhow::Result<ExitCode> {
    train::run(arguments.train)
}
