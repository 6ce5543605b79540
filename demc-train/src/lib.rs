//! Trains the networks of `demc-model` on the scenes of `demc-data`.
//!
//! - [`config`] reads and checks the TOML file of a run.
//! - [`run`] is a run from its first step to its scores: [`run::session`] opens it,
//!   [`run::training`] is the loop, [`run::checkpoint`] saves everything that an exact resume
//!   needs.
//! - [`step`] is one optimizer step: [`step::trainer`] computes loss and gradient (Eq. 5),
//!   [`step::optimizer`] updates the weights.
//! - [`ranks`] joins the processes that train one run, with the feature `mpi`.
//! - [`record`] writes metrics, TensorBoard events and the progress bar.
//! - [`tools`] compares variants, finds learning rates and draws charts.
#![warn(clippy::print_stdout, clippy::print_stderr)]

pub mod cli;
pub mod config;
pub mod ranks;
pub mod record;
pub mod run;
pub mod step;
pub mod tools;

pub use config::Config;
