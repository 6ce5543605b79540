//! `demc-train`: see `--help`.

mod cli;

use std::process::ExitCode;

use clap::Parser;
use demc_data::output::OutputError;
use demc_infer::compute::IsaError;
use demc_infer::device::DeviceError;
use demc_model::ops::within_pool;
use demc_train::config::ConfigError;
use demc_train::usage::UsageError;

#[global_allocator]
static ALLOCATOR: demc_model::ops::Recycler = demc_model::ops::Recycler;

fn main() -> ExitCode {
    let arguments = cli::Arguments::parse();
    match within_pool(|| cli::run(arguments)) {
        Ok(code) => code,
        Err(error) => {
            eprintln!("error: {error:#}");
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
