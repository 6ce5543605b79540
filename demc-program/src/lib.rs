//! What the programs of all crates share: how they print, end, write files, and use processors.
//!
//! | module | contents |
//! |---|---|
//! | `cli` | the frame of a `main` function (feature `cli`) |
//! | [`exit`] | exit codes, the error of a wrong command line |
//! | [`message`] | text that is safe for a terminal |
//! | [`output`] | which files a command may write |
//! | [`mod@file`] | files that are complete or absent |
//! | [`checksum`] | SHA-256 |
//! | [`parallel`] | the number of threads, work on them |
//!
//! This crate knows no image, no data set, and no network.
#![forbid(unsafe_code)]
#![warn(clippy::print_stdout, clippy::print_stderr)]

pub mod checksum;
#[cfg(feature = "cli")]
pub mod cli;
pub mod exit;
pub mod file;
pub mod message;
pub mod output;
pub mod parallel;
