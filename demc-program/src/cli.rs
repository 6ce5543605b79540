//! The frame of a program: its arguments, its exit code, and its error as one line on standard error.
//!
//! A `main` function is [`main`], or its steps if it does something between them:
//!
//! 1. [`parse`]: help, version, and wrong arguments end the program here.
//! 2. [`note_threads`]: a note if `RAYON_NUM_THREADS` is not followed.
//! 3. The work.
//! 4. [`report`] for an error, and [`code`] for its exit code.

use std::ffi::OsString;

use clap::{Args, Parser};

use crate::exit::{FAILURE, USAGE, UsageError};
use crate::message::say;
use crate::output::OutputError;
use crate::parallel::threads;

/// `--overwrite`, which every program needs to replace an existing output.
#[derive(Args, Clone, Copy, Debug)]
pub struct OverwriteFlag {
    /// Replace existing outputs. Inputs are never replaced
    #[arg(long)]
    pub overwrite: bool,
}

/// Runs a program with its name and arguments: parses them, runs `work`, and reports its error.
/// Returns the exit code, which is that of `work` unless it fails.
pub fn main<A: Parser>(
    arguments: impl IntoIterator<Item = OsString>,
    work: impl FnOnce(A) -> anyhow::Result<u8>,
) -> u8 {
    let arguments = match parse(arguments) {
        Ok(arguments) => arguments,
        Err(code) => return code,
    };
    note_threads();
    work(arguments).unwrap_or_else(|error| {
        report(&error);
        code(&error)
    })
}

/// Parses a command line: name and arguments.
///
/// # Errors
/// The exit code of a program that ends here. Help was printed on standard output, errors on
/// standard error.
pub fn parse<A: Parser>(arguments: impl IntoIterator<Item = OsString>) -> Result<A, u8> {
    A::try_parse_from(arguments).map_err(|shown| {
        // A closed stream ends no program.
        let _ = shown.print();
        u8::try_from(shown.exit_code()).unwrap_or(USAGE)
    })
}

/// Says so if this process does not follow the variable for its number of threads.
pub fn note_threads() {
    if let Some(note) = &threads().note {
        say(format_args!("note: {note}"));
    }
}

/// Prints an error as one line on standard error: `error: a: b: c`.
pub fn report(error: &anyhow::Error) {
    say(format_args!("error: {error:#}"));
}

/// The exit code for an error: [`USAGE`] for a [`UsageError`] and for an output that is refused,
/// otherwise [`FAILURE`].
pub fn code(error: &anyhow::Error) -> u8 {
    let refused = error.downcast_ref().is_some_and(OutputError::is_usage);
    if refused || error.is::<UsageError>() {
        USAGE
    } else {
        FAILURE
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::exit::SUCCESS;

    #[derive(Parser)]
    struct Arguments {
        #[arg(long)]
        fail: bool,
    }

    fn run(arguments: &[&str], error: anyhow::Error) -> u8 {
        let arguments = ["program"].iter().chain(arguments).map(OsString::from);
        main(
            arguments,
            |arguments: Arguments| {
                if arguments.fail { Err(error) } else { Ok(7) }
            },
        )
    }

    #[test]
    fn the_exit_code_is_that_of_the_work_or_of_its_error() {
        let failure = || anyhow::anyhow!("no disk");
        assert_eq!(run(&[], failure()), 7);
        assert_eq!(run(&["--help"], failure()), SUCCESS);
        assert_eq!(run(&["--unknown"], failure()), USAGE);
        assert_eq!(run(&["--fail"], failure()), FAILURE);
        assert_eq!(run(&["--fail"], UsageError("no".into()).into()), USAGE);
        let path = std::path::PathBuf::from("a");
        let refused = OutputError::Twice { path: path.clone() };
        assert_eq!(run(&["--fail"], refused.into()), USAGE);
        let source = std::io::Error::other("full");
        let unwritable = OutputError::Write { path, source };
        assert_eq!(run(&["--fail"], unwritable.into()), FAILURE);
    }
}
