//! Errors as Python exceptions. The texts are those of the command line.

use std::io::{self, ErrorKind};

use pyo3::exceptions::{
    PyFileExistsError, PyFileNotFoundError, PyOSError, PyPermissionError, PyValueError,
};
use pyo3::prelude::*;

pyo3::create_exception!(
    demc,
    DemcError,
    PyValueError,
    "An image, a model, a data set, or a configuration that cannot be used. The text is one sentence."
);

/// An error of the crates as a Python exception: `OSError` or one of its kinds for a file that cannot
/// be read or written, otherwise [`DemcError`].
pub fn exception(error: impl Into<anyhow::Error>) -> PyErr {
    let error = error.into();
    let text = format!("{error:#}");
    let cause = error
        .chain()
        .find_map(|cause| cause.downcast_ref::<io::Error>());
    match cause.map(io::Error::kind) {
        None | Some(ErrorKind::InvalidData | ErrorKind::UnexpectedEof) => DemcError::new_err(text),
        Some(ErrorKind::NotFound) => PyFileNotFoundError::new_err(text),
        Some(ErrorKind::PermissionDenied) => PyPermissionError::new_err(text),
        Some(ErrorKind::AlreadyExists) => PyFileExistsError::new_err(text),
        Some(_) => PyOSError::new_err(text),
    }
}
