//! What a trained network is for: denoising images, scoring them, and moving weights between files.
//!
//! A [`Bundle`] is a network together with everything that its numbers depend on: configuration, normalisation
//! statistics, channel layout, training step. [`bundle`] is the one writer and the one reader of its file.
//! `Bundle::denoise` ([`denoise`]) takes a frame to its denoised image, over [`padding`]; [`evaluate`] scores the
//! result against a reference, [`picture`] makes it visible. Training validates with exactly this code.
#![forbid(unsafe_code)]

pub mod baseline;
pub mod bundle;
pub mod compute;
pub mod denoise;
pub mod device;
pub mod evaluate;
pub mod memory;
pub mod padding;
pub mod picture;
pub mod report;
pub mod statistics;

pub use baseline::{Baseline, BaselineError};
pub use bundle::{Bundle, BundleError, BundleFile, BundleMeta, Names, Precision};
pub use denoise::DenoiseError;
pub use device::DeviceError;
pub use evaluate::{ImageScore, Report, Score};
pub use picture::Picture;
