//! The command line program `demc-infer`; see [`demc_infer::cli`].
#![forbid(unsafe_code)]

use std::process::ExitCode;

#[global_allocator]
static ALLOCATOR: demc_model::ops::Recycler = demc_model::ops::Recycler;

fn main() -> ExitCode {
    ExitCode::from(demc_infer::cli::main(std::env::args_os()))
}
