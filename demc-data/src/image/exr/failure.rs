//! The decoder's and the encoder's errors as errors of files.

use std::io;
use std::panic::{AssertUnwindSafe, catch_unwind};
use std::path::Path;

use ::exr::error::Error as ExrError;
use demc_program::file::FileError;

use crate::error::Error;

/// The hint for a file with unsupported features.
const SUPPORTED: &str =
    "expected OpenEXR 2 with scan lines or tiles, neither deep nor subsampled, not HTJ2K";

/// Runs the decoder. Damaged bytes can violate its internal assertions, which must not end the
/// program.
pub(super) fn guarded<T>(
    path: &Path,
    work: impl FnOnce() -> Result<T, ExrError>,
) -> Result<T, Error> {
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
        ExrError::Io(source) => FileError::Read {
            path: path.to_owned(),
            source,
        }
        .into(),
        // The crate's words for an end of the file between two fields.
        ExrError::Invalid(detail) if detail == "reference to missing bytes" => {
            undecodable(path, "it is cut short".to_owned())
        }
        ExrError::Invalid(detail) => undecodable(path, detail.into_owned()),
        ExrError::NotSupported(detail) => undecodable(path, format!("{detail} ({SUPPORTED})")),
        ExrError::Aborted => undecodable(path, "reading was aborted".to_owned()),
    }
}

pub(super) fn undecodable(path: &Path, detail: String) -> Error {
    Error::Exr {
        path: path.to_owned(),
        detail,
    }
}

pub(super) fn invalid(detail: String) -> ExrError {
    ExrError::Invalid(detail.into())
}

/// An error of the encoder as one of the output.
pub(super) fn io_error(error: ExrError) -> io::Error {
    match error {
        ExrError::Io(source) => source,
        other => io::Error::other(other.to_string()),
    }
}
