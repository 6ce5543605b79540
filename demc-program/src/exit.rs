//! How a program ends: exit codes, and the error of a wrong command line.

/// The exit code of a program that did its work.
pub const SUCCESS: u8 = 0;

/// The exit code if the work, or a part of it, failed.
pub const FAILURE: u8 = 1;

/// The exit code for a command line or configuration that cannot be carried out.
pub const USAGE: u8 = 2;

/// A command line that cannot be carried out: exit code 2. The message names the wrong arguments.
#[derive(Debug, thiserror::Error)]
#[error("{0}")]
pub struct UsageError(pub String);
