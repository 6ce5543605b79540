//! The tests of this crate, one program: each further one would link Burn again.

#[path = "../../../tests/alone.rs"]
mod alone;
mod inference;
mod kpcn;
mod layers;
mod memory;
mod network;
mod ops;
mod ops_network;
mod unet;

use demc_kernels::memory::Recycler;

/// The allocator of the programs, which counts.
#[global_allocator]
static ALLOCATOR: Recycler = Recycler;
