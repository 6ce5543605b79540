//! The tests of this crate, one program: each further one would link Burn again.

mod augmenting;
mod batches;
#[cfg(feature = "cli")]
mod cli;
#[cfg(feature = "cli")]
mod cli_datasets;
#[cfg(feature = "cli")]
mod cli_index;
mod datasets;
mod doctor;
mod fuzz_inputs;
mod hostile;
mod kpcn;
mod layers;
mod merging;
mod reading;
mod refusing;
mod rewriting;
mod rewriting_openexr;
mod rewriting_options;
mod rgb;
mod support;
mod writing;
