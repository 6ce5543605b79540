//! What a trained network is for: denoising images, scoring them, and moving weights between files.
//!
//! A renderer links this crate to denoise frames that it has in memory:
//!
//! ```
//! use demc_data::Frame;
//! use demc_infer::{Bundle, device};
//!
//! // A run directory, a checkpoint or an exported file: the network with all that its numbers depend on.
//! let device = device::parse("flex")?;
//! let bundle = Bundle::load("../models/demc.safetensors".as_ref(), &device)?;
//!
//! // Planar buffers as rendered: linear HDR colour; normal xyz, position xyz in world space, texture RGB at the first and at
//! // the second hit.
//! let (width, height) = (64, 48);
//! let frame = Frame {
//!     name: "frame 1".into(),
//!     width,
//!     height,
//!     color: vec![0.2; 3 * width * height],
//!     features: vec![0.5; 12 * width * height],
//!     reference: None,
//!     mask: None,
//!     clamped: 0,
//! };
//! for warning in bundle.warnings(&frame)? {
//!     eprintln!("warning: {warning}");
//! }
//! let denoised: Vec<f32> = bundle.denoise(&frame)?;
//! assert_eq!(denoised.len(), 3 * width * height);
//! # Ok::<(), Box<dyn std::error::Error>>(())
//! ```
//!
//! `cargo run --release -p demc-infer --example frame` is a whole program of this kind.
//!
//! - [`bundle`]: a [`Bundle`] is a network together with everything that its numbers depend on: configuration, normalisation
//!   statistics, channel layout, training step. The one writer and the one reader of its file.
//! - [`denoise`]: a frame to its denoised image, of any size: over [`padding`] and [`tiles`], within the [`memory`] that is there,
//!   and as the mean of an [`ensemble`](mod@ensemble) of looks at it where asked for.
//! - [`guard`]: what is refused and what is warned of, when an image is not what the network was trained on.
//! - [`onnx`] writes the network for other runtimes, [`verify`](mod@verify) compares what those make of it with what this crate does.
//! - [`evaluate`]: scores against a reference, beside [`baseline`]s, with [`statistics`]. [`report`]: one page to look at them.
//!   [`picture`]: images to look at.
//! - [`device`], [`compute`]: what computes, and how.
//!
//! Training validates with exactly this code. Nothing here prints or exits; every error names the frame, file or channel.
#![forbid(unsafe_code)]

pub mod baseline;
pub mod bundle;
pub mod compute;
pub mod denoise;
pub mod device;
pub mod ensemble;
pub mod evaluate;
pub mod guard;
pub mod memory;
pub mod onnx;
pub mod padding;
pub mod picture;
pub mod report;
pub mod statistics;
pub mod tiles;
pub mod verify;

pub use baseline::{Baseline, BaselineError};
pub use bundle::{Bundle, BundleError, BundleFile, BundleMeta, Names, Precision};
pub use denoise::{DenoiseError, Denoised};
pub use device::DeviceError;
pub use ensemble::Ensemble;
pub use evaluate::{ImageScore, Report, Score};
pub use picture::Picture;
pub use tiles::{Tiles, Tiling};
