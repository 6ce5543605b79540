//! The tests of this crate, one program: each further one would link Burn again.

mod baselines;
mod commands;
mod common;
mod denoise;
mod farm;
mod filter;
mod fuzz_inputs;
mod guard;
mod inputs;
mod layers;
mod moving;
mod outputs;
mod renderers;
mod report_browser;
