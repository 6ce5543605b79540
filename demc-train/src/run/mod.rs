//! A training run and its directory: session, loop, checkpoints, signals, validation, warnings.

pub mod checkpoint;
pub mod data;
pub mod estimate;
pub mod initial;
pub mod observer;
pub mod place;
pub mod run_dir;
pub mod run_record;
pub mod session;
pub mod signals;
mod starting_point;
pub mod training;
pub mod validation;
pub mod warnings;
