//! Uses a trained network: denoises images, scores them, exports and imports weights.
//!
//! A renderer links this crate to denoise frames in memory. Without the default feature `cli`, the
//! library has no dependency for the command line, JPEG or progress bars.
//!
//! ```
//! use demc_data::Frame;
//! use demc_infer::{Bundle, device};
//!
//! // A bundled model (quality or fast), a run directory, a checkpoint or an exported file.
//! let device = device::parse("flex")?;
//! let bundle = Bundle::load("quality".as_ref(), &device)?;
//!
//! let (width, height) = (64, 48);
//! // Planar buffers as rendered. Colour is linear HDR.
//! let color = vec![0.2; 3 * width * height];
//!
//! // Normal xyz, position xyz, albedo rgb of the first and of the second hit.
//! let features = vec![0.5; 12 * width * height];
//!
//! let frame = Frame::new("frame 1", width, height, color, features);
//!
//! for warning in bundle.warnings(&frame)? {
//!     eprintln!("warning: {warning}");
//! }
//! let denoised: Vec<f32> = bundle.denoise(&frame)?;
//! assert_eq!(denoised.len(), 3 * width * height);
//! # Ok::<(), Box<dyn std::error::Error>>(())
//! ```
//!
//! `cargo run --release -p demc-infer --example frame` runs a complete program of this kind.
//!
//! - [`bundle`]: a [`Bundle`] is a network with its configuration, normalisation statistics,
//!   channel layout and training step. This module alone reads and writes its file.
//! - [`buffers`]: images in a caller's memory, with any strides, as a frame.
//! - [`denoise`]: denoises a frame of the size of any file, with [`padding`], [`tiles`] that fit into
//!   the available [`memory`], and optional test-time augmentation ([`ensemble`](mod@ensemble)).
//! - [`nfor`]: NFOR (Bitterli et al. 2016), a filter without a network, for comparisons.
//! - [`guard`]: compares an image with the training data, then refuses it or warns.
//! - [`onnx`]: exports the network for other runtimes. [`verify`](mod@verify) compares their output
//!   with this crate's.
//! - [`tza`]: weights of Open Image Denoise, to start from and to export.
//! - [`evaluate`]: scores against a reference, with [`baseline`]s and [`statistics`]. `report`
//!   (feature `cli`) makes an HTML page of them, [`picture`] makes 8-bit pictures.
//! - [`device`], [`compute`]: the device, its operations and instruction set.
//!
//! Training validates with this code. The library never prints or exits. Every error names the
//! frame, file or channel.
#![forbid(unsafe_code)]
#![warn(clippy::print_stdout, clippy::print_stderr)]

pub mod baseline;
pub mod buffers;
pub mod bundle;
#[cfg(feature = "cli")]
pub mod cli;
pub mod compute;
pub mod denoise;
pub mod device;
pub mod ensemble;
mod error;
pub mod evaluate;
pub mod guard;
pub mod memory;
pub mod nfor;
pub mod onnx;
pub mod padding;
pub mod picture;
#[cfg(feature = "cli")]
pub mod report;
pub mod statistics;
pub mod tiles;
pub mod tza;
pub mod verify;

pub use baseline::{Baseline, BaselineError};
pub use bundle::{Bundle, BundleError, BundleFile, BundleMeta, Bundled, Names, Precision};
pub use denoise::{DenoiseError, Denoised};
pub use device::DeviceError;
pub use ensemble::Ensemble;
pub use evaluate::{ImageScore, Report, Score};
pub use picture::Picture;
pub use tiles::{Tiles, Tiling};
