//! `demc-infer`: what is done with a trained network, a verb a file. See `cli`.
#![forbid(unsafe_code)]

mod cli;
mod progress;

use std::process::ExitCode;

use clap::Parser;

#[global_allocator]
static ALLOCATOR: demc_model::ops::Recycler = demc_model::ops::Recycler;

fn main() -> ExitCode {
    let arguments = cli::Arguments::parse();
    match demc_model::ops::within_pool(|| cli::run(arguments)) {
        Ok(()) => ExitCode::SUCCESS,
        Err(error) => {
            eprintln!("error: {error:#}");
            ExitCode::from(if error.is::<cli::Usage>() { 2 } else { 1 })
        }
    }
}
