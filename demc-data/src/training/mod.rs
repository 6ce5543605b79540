//! From the scenes of a data set to batches of training patches.
//!
//! | module | contents |
//! |---|---|
//! | [`config`] | the settings |
//! | [`stats`] | statistics of the training scenes |
//! | [`patch`] | the grid of patches, and their order |
//! | [`cache`] | decoded scenes |
//! | [`augment`], [`dropout`], [`resample`] | variations of a patch |
//! | [`batch`] | one batch |
//! | [`loader`] | batches ahead of time, on threads |

pub mod augment;
pub mod batch;
pub mod cache;
pub mod config;
pub mod dropout;
pub mod loader;
pub mod patch;
pub mod resample;
pub mod stats;
