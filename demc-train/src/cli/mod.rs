//! The command line: one file per subcommand; training is the default.

mod ablate;
mod compute;
mod find_lr;
mod plot;
mod train;

use std::ffi::OsString;
use std::panic::{AssertUnwindSafe, catch_unwind, resume_unwind};

use crate::ranks::{self, Launch, Ranks, SharedError};
use clap::{CommandFactory, Parser, Subcommand};
use demc_infer::compute::on_threads;
use demc_program::{message, parallel};

/// The exit code of a program that panicked.
const PANICKED: u8 = 101;

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
    let arguments = match demc_program::cli::parse::<Arguments>(arguments) {
        Ok(arguments) => arguments,
        Err(code) => return code,
    };
    let launch = match Launch::start() {
        Ok(launch) => launch,
        Err(error) => {
            message::say(format_args!("error: {error}"));
            return 1;
        }
    };
    message::silence(!launch.is_first());
    parallel::share_processors(launch.on_node().count);
    if let Some(note) = &parallel::threads().note {
        message::say(format_args!("note: {note}"));
    }
    let work = AssertUnwindSafe(|| on_threads(|| run(arguments)));
    let done = catch_unwind(work).unwrap_or_else(|panic| {
        // The other ranks would wait for this one.
        ranks::abort(PANICKED);
        resume_unwind(panic)
    });
    match done.map_err(anyhow::Error::from).flatten() {
        Ok(code) => code,
        Err(error) => {
            let code = ranks::exit_code(&error);
            match launch.name().filter(|_| !error.is::<SharedError>()) {
                None => message::say(format_args!("error: {error:#}")),
                // The other ranks know nothing of it and would wait for this one.
                Some(name) => {
                    message::silence(false);
                    message::say(format_args!("error: {name}: {error:#}"));
                    ranks::abort(code);
                }
            }
            code
        }
    }
}

fn run(arguments: Arguments) -> anyhow::Result<u8> {
    let ranks = Ranks::world();
    match arguments.subcommand {
        Some(SubcommandArguments::FindLr(arguments)) => find_lr::run(arguments, &ranks),
        Some(SubcommandArguments::Ablate(arguments)) => ablate::run(arguments, &ranks),
        Some(SubcommandArguments::Plot(arguments)) => plot::run(arguments),
        None => train::run(arguments.train, &ranks),
    }
}
