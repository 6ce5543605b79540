//! `demc-data`: inspects images and data sets before training.

mod cli;

use std::process::ExitCode;

use clap::Parser;

fn main() -> ExitCode {
    match cli::Cli::parse().run() {
        Ok(status) => status,
        Err(error) => {
            cli::report(&error);
            ExitCode::FAILURE
        }
    }
}
