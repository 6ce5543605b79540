//! `demc-train`: see `--help`.

mod cli;

use std::process::ExitCode;

use clap::Parser;
use demc_infer::device::DeviceError;
use demc_train::config::ConfigError;

fn main() -> ExitCode {
    match cli::run(cli::Arguments::parse()) {
        Ok(()) => ExitCode::SUCCESS,
        Err(error) => {
            eprintln!("error: {error:#}");
            let usage = error.is::<ConfigError>() || error.is::<DeviceError>();
            ExitCode::from(if usage { 2 } else { 1 })
        }
    }
}
