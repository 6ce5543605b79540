//! `demc-data`: prepares and inspects images and data sets before training.

mod cli;

use std::process::ExitCode;

use clap::Parser;
use demc_data::output::OutputError;

fn main() -> ExitCode {
    match cli::Cli::parse().run() {
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
