//! Trains the networks of `demc-model` on the scenes of `demc-data`.
//!
//! The way of a run, in the order of the modules: [`config`] reads and checks a TOML file, [`data`] opens the data set
//! and measures its statistics, [`trainer`] steps (loss of Eq. 5, [`optimizer`], [`schedule`]), [`validation`] scores
//! held-out scenes with the code that ships, [`checkpoint`] and [`run_dir`] keep what a resumed run needs to go on bit
//! for bit. [`train`] is the loop that ties them together.

pub mod ablation;
pub mod census;
pub mod chart;
pub mod checkpoint;
mod clock;
pub mod config;
pub mod data;
pub mod ema;
pub mod estimate;
mod faults;
pub mod find_lr;
pub mod initial;
pub mod metrics_log;
pub mod optimizer;
pub mod plot;
pub mod progress;
pub mod rate;
pub mod recorder;
pub mod run_dir;
mod running_statistics;
pub mod schedule;
pub mod session;
pub mod signals;
pub mod tensorboard;
pub mod train;
pub mod trainer;
pub mod validation;
pub mod watch;

pub use config::Config;
