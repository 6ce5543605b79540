//! `demc-data`: prepares and inspects images and data sets before training.

#![forbid(unsafe_code)]
#![warn(clippy::print_stdout, clippy::print_stderr)]

mod cli;

use std::process::ExitCode;

use clap::Parser;
use demc_data::output::OutputError;

fn main() -> ExitCode {
    let cli = cli::Cli::parse();
    if let Some(note) = &demc_data::parallel::threads().note {
        demc_data::message::say(format_args!("note: {note}"));
    }
    match cli.run() {
        Ok(status) => status,
        Err(error) => {
            cli::report(&error);
            let refused = error.downcast_ref().is_some_and(OutputError::is_usage);
            ExitCode::from(if error.is::<cli::UsageError>() || refused {
                2
            } else {
                1
            })
        }
    }
}
