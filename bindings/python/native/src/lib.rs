//! The native half of the Python package `demc`: the module `demc._native`.
//!
//! `bindings/python/demc` is the other half. It checks types and layouts of arrays and has the docstrings. This
//! crate takes arrays through Python's buffer protocol (PEP 3118), so it needs no NumPy to build.
//!
//! - [`arrays`]: arrays as images in memory
//! - [`work`]: work on the crate's own threads, while Python stays responsive
//! - [`bundle`]: the class `Bundle`, which denoises
//! - [`evaluate`], [`train`]: scores of a data set, and a training run
//! - [`error`]: errors as Python exceptions

mod arrays;
mod bundle;
mod error;
mod evaluate;
mod train;
mod work;

use std::ffi::OsString;

use pyo3::prelude::*;

use error::exception;
use work::{Caller, UNHEARD};

#[global_allocator]
static ALLOCATOR: demc_model::ops::Recycler = demc_model::ops::Recycler;

#[pymodule(name = "_native")]
mod native {
    #[pymodule_export]
    use super::bundle::PyBundle;
    #[pymodule_export]
    use super::error::DemcError;
    #[pymodule_export]
    use super::evaluate::evaluate;
    #[pymodule_export]
    use super::train::train;
    use super::*;

    /// The layouts of renderers' files: pairs of name and TOML text.
    #[pyfunction]
    fn presets() -> Vec<(&'static str, &'static str)> {
        demc_data::image::layout::PRESETS.to_vec()
    }

    /// Runs `demc-infer` with its name and arguments. Returns the exit code.
    ///
    /// All three programs run until their end with the handlers of signals that the package sets.
    #[pyfunction]
    fn infer(py: Python<'_>, arguments: Vec<OsString>) -> u8 {
        py.detach(|| demc_infer::cli::main(arguments))
    }

    /// Runs a command of `demc-infer` on the crate's threads. Its error becomes an exception.
    #[pyfunction]
    fn run_infer(py: Python<'_>, arguments: Vec<OsString>) -> PyResult<()> {
        let command = |_: Caller<()>| demc_infer::cli::run_command(arguments);
        work::run(py, command, UNHEARD)?.map_err(exception)
    }

    /// Runs `demc-data` with its name and arguments. Returns the exit code.
    #[pyfunction]
    fn data(py: Python<'_>, arguments: Vec<OsString>) -> u8 {
        py.detach(|| demc_data::cli::main(arguments))
    }

    /// Runs `demc-train` with its name and arguments. Returns the exit code.
    #[pyfunction]
    fn train_program(py: Python<'_>, arguments: Vec<OsString>) -> u8 {
        py.detach(|| demc_train::cli::main(arguments))
    }

    #[pymodule_init]
    fn init(module: &Bound<'_, PyModule>) -> PyResult<()> {
        module.add("__version__", env!("CARGO_PKG_VERSION"))
    }
}
