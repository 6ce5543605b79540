//! The command line: one file per subcommand; training is the default.

mod ablate;
mod compute;
mod find_lr;
mod plot;
mod train;

use std::process::ExitCode;

use clap::{Parser, Subcommand};
use demc_train::ranks::Ranks;

/// Train a DEMC Monte Carlo denoiser on rendered images.
///
/// The configuration is a TOML file; configs/demc.toml lists every key with its default. The run
/// directory contains the resolved configuration, metrics.jsonl, TensorBoard events, checkpoints,
/// the best weights and pictures. `demc-infer --model RUN_DIR` uses its weights.
///
/// Ctrl-C saves a checkpoint and stops; --resume resumes the run. A second Ctrl-C stops at once.
#[derive(Debug, Parser)]
#[command(
    version,
    after_help = EXAMPLES,
    args_conflicts_with_subcommands = true,
    subcommand_negates_reqs = true
)]
pub struct Arguments {
    #[command(subcommand)]
    subcommand: Option<SubcommandArguments>,

    #[command(flatten)]
    train: train::Arguments,
}

#[derive(Debug, Subcommand)]
enum SubcommandArguments {
    FindLr(find_lr::Arguments),
    Ablate(ablate::Arguments),
    Plot(plot::Arguments),
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
    let ranks = Ranks::world();
    match arguments.subcommand {
        Some(SubcommandArguments::FindLr(arguments)) => find_lr::run(arguments, &ranks),
        Some(SubcommandArguments::Ablate(arguments)) => ablate::run(arguments, &ranks),
        Some(SubcommandArguments::Plot(arguments)) => plot::run(arguments),
        None => train::run(arguments.train, &ranks),
    }
}
