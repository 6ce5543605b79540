//! `demc-train`: see `--help`.

#![warn(clippy::print_stdout, clippy::print_stderr)]

mod cli;

use std::process::ExitCode;

use clap::Parser;
use demc_data::message::{self, UsageError};
use demc_data::output::OutputError;
use demc_infer::compute::{self, IsaError};
use demc_infer::device::DeviceError;
use demc_train::config::ConfigError;

#[global_allocator]
static ALLOCATOR: demc_model::ops::Recycler = demc_model::ops::Recycler;

fn main() -> ExitCode {
    let arguments = cli::Arguments::parse();
    if let Some(note) = &demc_data::parallel::threads().note {
        message::say(format_args!("note: {note}"));
    }
    let done = compute::on_threads(|| cli::run(arguments));
    match done.map_err(anyhow::Error::from).flatten() {
        Ok(code) => code,
        Err(error) => {
            message::say(format_args!("error: {error:#}"));
            let refused = error.downcast_ref().is_some_and(OutputError::is_usage);
            let usage = error.is::<ConfigError>()
                || error.is::<DeviceError>()
                || error.is::<IsaError>()
                || error.is::<UsageError>()
                || refused;
            ExitCode::from(if usage { 2 } else { 1 })
        }
    }
}
