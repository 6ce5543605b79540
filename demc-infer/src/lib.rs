//! What a trained network is for: denoising images, scoring them, and moving weights between files.
//!
//! A [`Bundle`] is a network together with everything that its numbers depend on: configuration, normalisation
//! statistics, channel layout, training step. [`bundle`] is the one writer and the one reader of its file.
//! [`onnx`] writes the network for other runtimes, [`verify`](mod@verify) compares what those make of it with what this program does.
//! `Bundle::denoise` ([`denoise`]) takes a frame to its denoised image, over [`padding`]; [`evaluate`] scores the
//! result against a reference, [`picture`] makes it visible. Training validates with exactly this code.
#![forbid(unsafe_code)]

pub mod bundle;
pub mod compute;
pub mod denoise;
pub mod device;
pub mod evaluate;
pub mod memory;
pub mod onnx;
pub mod padding;
pub mod picture;
pub mod verify;

pub use bundle::{Bundle, BundleError, BundleFile, BundleMeta, Names, Precision};
pub use denoise::DenoiseError;
pub use device::DeviceError;
pub use evaluate::{ImageScore, Report, Score};
pub use picture::Picture;
