//! The command line: flags, exit codes and messages.
//!
//! Results go to stdout, progress and errors to stderr. Exit codes: 0 success, 1 failure of the run
//! or of one of its files, 2 invalid command line.

mod check;
mod clamped;
mod cost;
mod denoise;
mod evaluate;
mod export;
mod exposure;
mod exposure_curve;
mod filter;
mod flags;
mod frames;
mod import;
mod inputs;
mod inspect;
mod jobs;
mod layers;
mod layouts;
mod output_flags;
mod outputs;
mod preview;
mod progress;
mod record;
mod report;
mod scenes;
mod shard;
mod warnings;

use std::ffi::OsString;

use clap::{CommandFactory, Parser, Subcommand};
use demc_program::exit;

use crate::compute;

/// Use a trained DEMC network: denoise and score renderings, export and import weights.
#[derive(Parser)]
#[command(
    version,
    after_help = "MODEL is the bundled model `quality` (the default) or `fast`, a run directory of \
    demc-train (its best weights), a checkpoint directory, or a file written by `export`.\n\n\
    Exit codes: 0 success, 1 failure, 2 invalid command line."
)]
struct Arguments {
    #[command(subcommand)]
    verb: Verb,
}

#[derive(Subcommand)]
enum Verb {
    Denoise(denoise::Arguments),
    Cost(cost::Arguments),
    Check(check::Arguments),
    Evaluate(evaluate::Arguments),
    Export(export::Arguments),
    Import(import::Arguments),
    Inspect(inspect::Arguments),
    Report(report::Arguments),
}

/// The command line's description, for manuals and completions.
pub fn command() -> clap::Command {
    Arguments::command()
}

/// Runs a command for a program that reports the error itself: name and arguments as in [`main`].
///
/// # Errors
/// As the command; an invalid command line.
pub fn run_command(arguments: impl IntoIterator<Item = OsString>) -> anyhow::Result<()> {
    run(Arguments::try_parse_from(arguments)?)
}

/// Runs the program with its name and arguments. Returns the exit code.
pub fn main(arguments: impl IntoIterator<Item = OsString>) -> u8 {
    demc_program::cli::main(arguments, |arguments: Arguments| {
        compute::on_threads(|| run(arguments))??;
        Ok(exit::SUCCESS)
    })
}

fn run(arguments: Arguments) -> anyhow::Result<()> {
    match arguments.verb {
        Verb::Denoise(command) => command.run(),
        Verb::Cost(command) => command.run(),
        Verb::Check(command) => command.run(),
        Verb::Evaluate(command) => command.run(),
        Verb::Export(command) => command.run(),
        Verb::Import(command) => command.run(),
        Verb::Inspect(command) => command.run(),
        Verb::Report(command) => command.run(),
    }
}
