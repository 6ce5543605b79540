//! Files, statistics, patches and batches: everything between rendered images on disk and the plain `f32`
//! buffers that the network eats. Knows nothing of tensors or devices.
//!
//! A file's way, in the order of the modules: [`exr`] decodes channels, [`layout`] says which channel is
//! what, [`frame`] checks the buffers and holds them, [`transform`] takes them to the network's space.
//! Training adds [`dataset`] (scenes and splits), [`stats`] (what [`transform`] subtracts and divides by),
//! [`patch`] (which pixels, in which order), [`cache`] and [`batch`] (decoded ahead on threads).
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

pub mod augment;
pub mod batch;
pub mod cache;
pub mod channel;
pub mod config;
pub mod dataset;
pub mod error;
pub mod exr;
pub mod file;
pub mod frame;
pub mod layout;
pub mod loader;
mod parallel;
pub mod patch;
pub mod plane;
pub mod ranges;
pub mod reference_filter;
pub mod resample;
pub mod rgb;
mod seed;
pub mod stats;
pub mod transform;

pub use augment::Augment;
pub use batch::{Batch, PatchSource};
pub use config::DataConfig;
pub use dataset::{Dataset, Scene, Split};
pub use error::Error;
pub use exr::rewrite::{self, Change, Keep, WriteOptions, Written, write_denoised};
pub use exr::{Compression, Precision, write_rgb};
pub use frame::{FEATURES, Frame, read_frame};
pub use layout::ChannelLayout;
pub use loader::BatchLoader;
pub use patch::{Border, Patch};
pub use ranges::{Ranges, Summary};
pub use rgb::{Rgb, read_rgb};
pub use stats::Statistics;
pub use transform::{FeatureStats, Normalizer};
