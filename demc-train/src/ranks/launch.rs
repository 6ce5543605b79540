//! The start of a program on all ranks, and its end.

use std::panic::{AssertUnwindSafe, catch_unwind, resume_unwind};

use demc_infer::compute::on_threads;
use demc_program::cli::{note_threads, report};
use demc_program::exit::FAILURE;
use demc_program::message::{say, silence};
use demc_program::parallel::share_processors;

use super::group::{Launch, abort};
use super::{ExitCode, Reduce, SharedError};

/// The exit code of a program that panicked.
const PANICKED: u8 = 101;

/// Runs `work` on every rank that was started with this one. Returns the exit code, that of `work`
/// or of its error, which rank 0 prints.
pub fn run(exit_code: ExitCode, work: impl FnOnce(&Reduce) -> anyhow::Result<u8> + Send) -> u8 {
    let launch = match Launch::start() {
        Ok(launch) => launch,
        Err(error) => {
            say(format_args!("error: {error}"));
            return FAILURE;
        }
    };
    silence(!launch.is_first());
    share_processors(launch.on_node().count);
    note_threads();
    let work = AssertUnwindSafe(|| on_threads(|| work(&Reduce::world(exit_code))));
    let done = catch_unwind(work).unwrap_or_else(|panic| {
        // The other ranks would wait for this one.
        abort(PANICKED);
        resume_unwind(panic)
    });
    let error = match done.map_err(anyhow::Error::from).flatten() {
        Ok(code) => return code,
        Err(error) => error,
    };
    let code = exit_code(&error);
    match launch.name().filter(|_| !error.is::<SharedError>()) {
        None => report(&error),
        // The other ranks know nothing of it and would wait for this one.
        Some(name) => {
            silence(false);
            report(&error.context(name));
            abort(code);
        }
    }
    code
}
