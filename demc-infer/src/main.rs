//! The command line program `demc-infer`. `cli` has one file per verb.
#![forbid(unsafe_code)]
#![warn(clippy::print_stdout, clippy::print_stderr)]

mod cli;

use std::process::ExitCode;

use clap::Parser;
use demc_data::message;
use demc_data::output::OutputError;
use demc_infer::compute;

#[global_allocator]
static ALLOCATOR: demc_model::ops::Recycler = demc_model::ops::Recycler;

fn main() -> ExitCode {
    let arguments = cli::Arguments::parse();
    if let Some(note) = &demc_data::parallel::threads().note {
        message::say(format_args!("note: {note}"));
    }
    let done = compute::on_threads(|| cli::run(arguments));
    match done.map_err(anyhow::Error::from).flatten() {
        Ok(()) => ExitCode::SUCCESS,
        Err(error) => {
            message::say(format_args!("error: {error:#}"));
            let refused = error.downcast_ref().is_some_and(OutputError::is_usage);
            ExitCode::from(if error.is::<cli::UsageError>() || refused {
                2
            } else {
                1
            })
        }
    }
}
