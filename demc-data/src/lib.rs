//! Files, statistics, patches and batches: the steps from rendered images on disk to the plain
//! `f32` buffers that the network takes as input. This crate does not depend on tensors or devices.
//!
//! | module | contents |
//! |---|---|
//! | [`image`] | OpenEXR files, channel layouts, frames |
//! | [`input`] | from a whole image to the network's input space, and what is measured for it |
//! | [`dataset`] | scenes and splits |
//! | [`check`] | mistakes in images and data sets |
//! | [`training`] | patches, augmentations, batches, statistics of the training scenes |
//!
//! Each imports only those above it.
//!
//! ```
//! use demc_data::{ChannelLayout, read_frame};
//!
//! let layout = ChannelLayout::resolve("demc-exr")?;
//! let frame = read_frame("../data/sample/train/col-ashtray-0.exr".as_ref(), &layout)?;
//! assert_eq!((frame.width, frame.height), (224, 224));
//! # Ok::<(), demc_data::Error>(())
//! ```
#![forbid(unsafe_code)]
#![warn(clippy::print_stdout, clippy::print_stderr)]

pub mod array_lengths;
pub mod check;
#[cfg(feature = "cli")]
pub mod cli;
pub mod dataset;
pub mod error;
pub mod image;
pub mod input;
mod seed;
pub mod training;

pub use dataset::{Dataset, Scene, Split};
pub use error::Error;
pub use image::exr::{Compression, SamplePrecision, write_rgb};
pub use image::frame::{FEATURES, Frame, read_frame};
pub use image::layout::{ChannelLayout, InputKind};
pub use image::rewrite::{Change, OutputChannels, WriteOptions, Written, write_denoised};
pub use image::rgb::{Rgb, read_rgb};
pub use input::position::{PositionMap, PositionSpace};
pub use input::preparation::Preparation;
pub use input::ranges::{FrameSummary, Ranges};
pub use input::transfer::Transfer;
pub use input::transform::{FeatureStats, Normalizer};
pub use training::augment::Augment;
pub use training::batch::{Batch, PatchSource};
pub use training::config::DataConfig;
pub use training::dropout::Dropout;
pub use training::loader::BatchLoader;
pub use training::patch::Patch;
pub use training::stats::Statistics;
