//! The command line: one file per subcommand; training is the default.

mod ablate;
mod compute;
mod find_lr;
mod plot;
mod train;

use std::ffi::OsString;

use clap::{CommandFactory, Parser, Subcommand};
use demc_infer::compute::IsaError;
use demc_infer::device::DeviceError;
use demc_program::exit::USAGE;

use crate::config::ConfigError;
use crate::ranks::{Reduce, SharedError, launch};

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
struct Arguments {
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

/// The command line's description, for manuals and completions.
pub fn command() -> clap::Command {
    Arguments::command()
}

/// Runs the program with its name and arguments. Returns the exit code.
pub fn main(arguments: impl IntoIterator<Item = OsString>) -> u8 {
    match demc_program::cli::parse(arguments) {
        Ok(arguments) => launch::run(exit_code, |reduce| run(arguments, reduce)),
        Err(code) => code,
    }
}

fn run(arguments: Arguments, reduce: &Reduce) -> anyhow::Result<u8> {
    match arguments.subcommand {
        Some(SubcommandArguments::FindLr(arguments)) => find_lr::run(arguments, reduce),
        Some(SubcommandArguments::Ablate(arguments)) => ablate::run(arguments, reduce),
        Some(SubcommandArguments::Plot(arguments)) => plot::run(arguments),
        None => train::run(arguments.train, reduce),
    }
}

/// The exit code for an error: 2 for wrong usage or configuration, otherwise 1.
fn exit_code(error: &anyhow::Error) -> u8 {
    if let Some(shared) = error.downcast_ref::<SharedError>() {
        shared.code
    } else if error.is::<ConfigError>() || error.is::<DeviceError>() || error.is::<IsaError>() {
        USAGE
    } else {
        demc_program::cli::code(error)
    }
}
