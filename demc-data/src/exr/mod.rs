//! OpenEXR in and out, and the only place that imports the `exr` crate.
//!
//! Reading ([`ExrFile`]) is in two steps: [`ExrFile::open`] reads and checks the headers, [`ExrFile::read`] decodes the
//! channels that are asked for, each in its own precision. A channel's name is `Layer.channel` in a file of several
//! parts and the channel's own name (dots and all) in a file of one. [`write_rgb`] writes three channels and nothing
//! else; [`rewrite`] writes a file again with another colour.
//!
//! # What is read
//! Files of OpenEXR 2 with one part or several, of scan lines or tiles, in every compression but HTJ2K. Of an image with
//! smaller levels (mip or rip maps) the full size is read. Deep and subsampled channels are refused.
//!
//! # Files of strangers
//! A header is checked before anything of the size that it claims is allocated: [`MAX_SIDE`], [`MAX_PIXELS`], and
//! that the table of blocks fits into the file. So is a block: it has to be as long as the file is, and its pixels are
//! not more than its bytes can stand for. Planes grow with the rows that were decoded.

mod attributes;
mod blocks;
mod compression;
mod decode;
mod kept;
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
pub use write::{Precision, write_rgb};

/// Largest accepted width or height, in pixels (ours: four times an 8K frame's width).
pub const MAX_SIDE: usize = 32_768;
/// Largest accepted number of pixels of a part (ours: 16K x 8K), so that a damaged header cannot ask for
/// all the memory there is.
pub const MAX_PIXELS: usize = 1 << 27;

/// What is said of a file that uses more of the format than is read.
const SUPPORTED: &str =
    "expected OpenEXR 2 with scan lines or tiles, neither deep nor subsampled, not HTJ2K";

/// Runs the decoder; damaged bytes can fail its internal assertions, which must not end the program.
fn guarded<T>(path: &Path, work: impl FnOnce() -> Result<T, ExrError>) -> Result<T, Error> {
    match catch_unwind(AssertUnwindSafe(work)) {
        Ok(done) => done.map_err(|error| reading_error(path, error)),
        Err(_) => Err(undecodable(
            path,
            "the decoder gave up on damaged data".to_owned(),
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
