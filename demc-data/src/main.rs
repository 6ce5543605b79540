//! `demc-data`: prepares and inspects images and data sets before training.

#![forbid(unsafe_code)]
#![warn(clippy::print_stdout, clippy::print_stderr)]

mod cli;

use std::process::ExitCode;

use clap::Parser;

fn main() -> ExitCode {
    let cli = cli::Cli::parse();
    if let Some(note) = &demc_data::parallel::threads().note {
        demc_data::message::say(format_args!("note: {note}"));
    }
    match cli.run() {
        Ok(status) => status,
        Err(error) => {
            cli::report(&error);
            ExitCode::from(if error.is::<cli::UsageError>() { 2 } else { 1 })
        }
    }
}
