//! Files, statistics, patches and batches: the steps from rendered images on disk to the plain
//! `f32` buffers that the network takes as input. This crate does not depend on tensors or devices.
//!
//! The modules, in the order of use: [`exr`] decodes channels, [`layout`] maps them to buffers,
//! [`frame`] checks and holds the buffers, [`transform`] converts them to the network's input
//! space.
//!
//! Training adds [`dataset`] (scenes and splits), [`stats`] (the statistics that [`transform`]
//! uses), [`patch`] (patches and their order), [`cache`] (decoded scenes) and [`batch`] (batches,
//! prepared on threads).
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

pub mod augment;
pub mod batch;
pub mod cache;
pub mod channel;
pub mod checksum;
#[cfg(feature = "cli")]
pub mod cli;
pub mod config;
pub mod content;
pub mod dataset;
pub mod doctor;
pub mod dropout;
pub mod error;
pub mod exr;
pub mod file;
pub mod frame;
pub mod geometry;
pub mod layout;
pub mod loader;
pub mod message;
mod moments;
pub mod noise;
pub mod output;
pub mod parallel;
pub mod patch;
pub mod plane;
pub mod position;
pub mod preparation;
pub mod ranges;
pub mod resample;
pub mod rgb;
mod seed;
pub mod stats;
pub mod transform;

pub use augment::Augment;
pub use batch::{Batch, PatchSource};
pub use config::DataConfig;
pub use dataset::{Dataset, Scene, Split};
pub use dropout::Dropout;
pub use error::Error;
pub use exr::rewrite::{self, Change, OutputChannels, WriteOptions, Written, write_denoised};
pub use exr::{Compression, SamplePrecision, write_rgb};
pub use frame::{FEATURES, Frame, read_frame};
pub use layout::ChannelLayout;
pub use loader::BatchLoader;
pub use patch::{Border, Patch};
pub use position::{PositionMap, PositionSpace};
pub use preparation::Preparation;
pub use ranges::{FrameSummary, Ranges};
pub use rgb::{Rgb, read_rgb};
pub use stats::Statistics;
pub use transform::{FeatureStats, Normalizer};
