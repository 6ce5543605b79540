//! `demc-train`: see `--help`.

#![warn(clippy::print_stdout, clippy::print_stderr)]

mod cli;

use std::panic::{AssertUnwindSafe, catch_unwind, resume_unwind};
use std::process::ExitCode;

use clap::Parser;
use demc_data::{message, parallel};
use demc_infer::compute;
use demc_train::ranks::{self, Launch, SharedError};

#[global_allocator]
static ALLOCATOR: demc_model::ops::Recycler = demc_model::ops::Recycler;

/// The exit code of a program that panicked.
const PANICKED: u8 = 101;

fn main() -> ExitCode {
    let arguments = cli::Arguments::parse();
    let launch = match Launch::start() {
        Ok(launch) => launch,
        Err(error) => {
            message::say(format_args!("error: {error}"));
            return ExitCode::FAILURE;
        }
    };
    message::silence(!launch.is_first());
    parallel::share_processors(launch.on_node().count);
    if let Some(note) = &parallel::threads().note {
        message::say(format_args!("note: {note}"));
    }
    let work = AssertUnwindSafe(|| compute::on_threads(|| cli::run(arguments)));
    let done = catch_unwind(work).unwrap_or_else(|panic| {
        // The other ranks would wait for this one.
        ranks::abort(PANICKED);
        resume_unwind(panic)
    });
    match done.map_err(anyhow::Error::from).flatten() {
        Ok(code) => code,
        Err(error) => {
            let code = ranks::exit_code(&error);
            match launch.name().filter(|_| !error.is::<SharedError>()) {
                None => message::say(format_args!("error: {error:#}")),
                // The other ranks know nothing of it and would wait for this one.
                Some(name) => {
                    message::silence(false);
                    message::say(format_args!("error: {name}: {error:#}"));
                    ranks::abort(code);
                }
            }
            ExitCode::from(code)
        }
    }
}
