//! The tests of this crate, one program: each further one would link Burn again.

#[path = "../../../tests/alone.rs"]
mod alone;
mod cli;
mod common;
mod full_disk;
mod fuzz_inputs;
mod init;
mod memory;
mod resume;
mod signals;
mod tensorboard;
mod trouble;
mod verbs;

use demc_model::ops::Recycler;

/// The allocator of the programs, which counts.
#[global_allocator]
static ALLOCATOR: Recycler = Recycler;
