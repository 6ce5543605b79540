//! `demc-data`: looks into images and data sets before anything is trained on them.

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
