//! From the scenes of a data set to batches of training patches.
//!
//! [`config`] has the settings, [`stats`] measures the training scenes, [`patch`] lists the patches,
//! [`cache`] holds decoded scenes, [`augment`], [`dropout`] and [`resample`] vary patches, [`batch`]
//! computes a batch, and [`loader`] prepares batches on threads.

pub mod augment;
pub mod batch;
pub mod cache;
pub mod config;
pub mod dropout;
pub mod loader;
pub mod patch;
pub mod resample;
pub mod stats;
