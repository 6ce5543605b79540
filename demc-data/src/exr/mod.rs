//! Reading and writing OpenEXR files. Only this module imports the `exr` crate.
//!
//! Reading takes two steps: [`ExrFile::open`] reads and checks the headers, [`ExrFile::read`]
//! decodes the requested channels, each in its own precision. A channel's name is `Layer.channel`
//! in a file of several parts, and the channel's own name (including dots) in a file of one part.
//!
//! [`write_rgb`] writes only three channels. [`rewrite`] copies a file with a different colour.
//! [`merge`] joins the channels of several files.
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
pub mod merge;
mod plan;
mod read;
mod recode;
pub mod rewrite;
mod write;
mod zip;

use std::io;
use std::panic::{AssertUnwindSafe, catch_unwind};
use std::path::Path;

use ::exr::error::Error as ExrError;

use crate::Error;

pub use compression::{Compression, UnknownCompression};
pub use read::ExrFile;
pub use write::{SamplePrecision, write_rgb};

/// Maximum width or height in pixels (ours: four times the width of an 8K frame).
pub const MAX_SIDE: usize = 32_768;
/// Maximum number of pixels of a part (ours: 16K x 8K), so that a damaged header cannot request all
/// memory.
pub const MAX_PIXELS: usize = 1 << 27;

/// An image that is empty or exceeds [`MAX_SIDE`] or [`MAX_PIXELS`].
#[derive(Clone, Copy, Debug, PartialEq, Eq, thiserror::Error)]
#[error(
    "its size is {width}x{height}, not 1x1 to {MAX_SIDE}x{MAX_SIDE} with at most {MAX_PIXELS} pixels"
)]
pub struct UnsupportedSize {
    /// Width in pixels.
    pub width: usize,
    /// Height in pixels.
    pub height: usize,
}

/// Checks the size of an image in pixels. Files, frames in memory and tiles have this one limit.
///
/// # Errors
/// The image is empty or too large.
pub fn check_size(width: usize, height: usize) -> Result<(), UnsupportedSize> {
    let sides = 1..=MAX_SIDE;
    match sides.contains(&width) && sides.contains(&height) && width * height <= MAX_PIXELS {
        true => Ok(()),
        false => Err(UnsupportedSize { width, height }),
    }
}

/// The hint for a file with unsupported features.
const SUPPORTED: &str =
    "expected OpenEXR 2 with scan lines or tiles, neither deep nor subsampled, not HTJ2K";

/// Runs the decoder. Damaged bytes can violate its internal assertions, which must not end the
/// program.
fn guarded<T>(path: &Path, work: impl FnOnce() -> Result<T, ExrError>) -> Result<T, Error> {
    match catch_unwind(AssertUnwindSafe(work)) {
        Ok(done) => done.map_err(|error| reading_error(path, error)),
        Err(_) => Err(undecodable(
            path,
            "the decoder failed on damaged data".to_owned(),
        )),
    }
}

fn reading_error(path: &Path, error: ExrError) -> Error {
    match error {
        ExrError::Io(source) if source.kind() == io::ErrorKind::UnexpectedEof => {
            undecodable(path, "it is cut short".to_owned())
        }
        ExrError::Io(source) => Error::Read {
            path: path.to_owned(),
            source,
        },
        // The crate's words for an end of the file between two fields.
        ExrError::Invalid(detail) if detail == "reference to missing bytes" => {
            undecodable(path, "it is cut short".to_owned())
        }
        ExrError::Invalid(detail) => undecodable(path, detail.into_owned()),
        ExrError::NotSupported(detail) => undecodable(path, format!("{detail} ({SUPPORTED})")),
        ExrError::Aborted => undecodable(path, "reading was aborted".to_owned()),
    }
}

fn undecodable(path: &Path, detail: String) -> Error {
    Error::Exr {
        path: path.to_owned(),
        detail,
    }
}

fn invalid(detail: String) -> ExrError {
    ExrError::Invalid(detail.into())
}
