//! The command line program `demc-infer`. `cli` has one file per verb.
#![forbid(unsafe_code)]

mod cli;

use std::process::ExitCode;

use clap::Parser;
use demc_data::output::OutputError;

#[global_allocator]
static ALLOCATOR: demc_model::ops::Recycler = demc_model::ops::Recycler;

fn main() -> ExitCode {
    let arguments = cli::Arguments::parse();
    match demc_model::ops::within_pool(|| cli::run(arguments)) {
        Ok(()) => ExitCode::SUCCESS,
        Err(error) => {
            eprintln!("error: {error:#}");
            let refused = error.downcast_ref().is_some_and(OutputError::is_usage);
            ExitCode::from(if error.is::<cli::UsageError>() || refused {
                2
            } else {
                1
            })
        }
    }
}
