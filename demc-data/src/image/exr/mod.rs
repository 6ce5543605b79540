//! Reading and writing OpenEXR files. Only this module imports the `exr` crate.
//!
//! Reading takes two steps: [`ExrFile::open`] reads and checks the headers, [`ExrFile::read`]
//! decodes the requested channels, each in its own precision. A channel's name is `Layer.channel`
//! in a file of several parts, and the channel's own name (including dots) in a file of one part.
//!
//! [`write_rgb`] writes only three channels. [`merge`] joins the channels of several files.
//! [`rewrite`](super::rewrite) copies a file with a different colour.
//!
//! # Supported files
//!
//! OpenEXR 2 files with one or several parts, of scan lines or tiles, in every compression except
//! HTJ2K. If an image has smaller levels (mip or rip maps), the full size is read. Deep and
//! subsampled channels are refused.
//!
//! # Untrusted files
//!
//! A header is checked before memory of the claimed size is allocated: [`MAX_SIDE`],
//! [`MAX_PIXELS`], and that the table of blocks fits in the file. A block must fit in the file, and
//! its bytes must be able to encode its pixels. Planes grow as rows are decoded.

mod blocks;
mod compression;
mod decode;
mod failure;
mod key_code;
mod limits;
pub mod merge;
pub(super) mod plan;
mod read;
pub(super) mod recode;
mod write;
mod zip;

pub use compression::{Compression, UnknownCompression};
pub use limits::{MAX_PIXELS, MAX_SIDE, UnsupportedSize, check_size};
pub use read::ExrFile;
pub use write::{SamplePrecision, write_rgb};
