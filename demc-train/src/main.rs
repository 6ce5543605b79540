//! The command line program `demc-train`; see [`demc_train::cli`].

use std::process::ExitCode;

#[global_allocator]
static ALLOCATOR: demc_model::ops::Recycler = demc_model::ops::Recycler;

fn main() -> ExitCode {
    ExitCode::from(demc_train::cli::main(std::env::args_os()))
}
