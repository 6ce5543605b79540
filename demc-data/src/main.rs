//! The command line program `demc-data`; see [`demc_data::cli`].
#![forbid(unsafe_code)]

use std::process::ExitCode;

fn main() -> ExitCode {
    ExitCode::from(demc_data::cli::main(std::env::args_os()))
}
