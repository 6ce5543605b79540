//! The command line: flags, exit codes and messages.
//!
//! Results go to stdout, progress and errors to stderr. Exit codes: 0 success, 1 failure of the run
//! or of one of its files, 2 invalid command line.

mod check;
mod cost;
mod denoise;
mod evaluate;
mod export;
mod exposure;
mod flags;
mod frames;
mod import;
mod inputs;
mod inspect;
mod jobs;
mod layers;
mod layouts;
mod progress;
mod report;
mod scenes;
mod shard;
mod warnings;

use std::ffi::OsString;
use std::path::Path;

use clap::{CommandFactory, Parser, Subcommand};
use demc_program::exit::{self, UsageError};
use demc_program::message;
use demc_program::output::{Directories, OutputError, Outputs};

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

/// Counts negative radiance samples, which are reported once for all images.
#[derive(Default)]
struct Clamped {
    samples: usize,
    images: usize,
}

impl Clamped {
    fn count(&mut self, samples: usize) {
        self.samples += samples;
        self.images += usize::from(samples > 0);
    }

    fn report(self) {
        let Self { samples, images } = self;
        if samples > 0 {
            message::say(format_args!(
                "note: {samples} negative radiance sample(s) in {images} image(s) set to 0"
            ));
        }
    }
}

/// Checks the only output of a command, which may replace a file, but no input.
fn check_output(mut outputs: Outputs, path: &Path) -> Result<(), OutputError> {
    outputs.claim(path, true)?;
    outputs.prepare(Directories::Expect)
}

/// Fails for a path that JSON cannot hold.
fn utf8_for_json(path: &Path) -> Result<(), UsageError> {
    match path.to_str() {
        Some(_) => Ok(()),
        None => Err(UsageError(format!(
            "{}: not UTF-8, as JSON requires; rename it or omit --json",
            path.display()
        ))),
    }
}

/// Writes `text` and a newline to stdout if `path` is `-`, otherwise to a file.
fn write_text(path: &Path, text: &str) -> anyhow::Result<()> {
    if path == Path::new("-") {
        return Ok(message::result(text)?);
    }
    demc_program::file::write_whole(path, |file| {
        std::io::Write::write_all(file, format!("{text}\n").as_bytes())
    })?;
    Ok(())
}
