//! What can go wrong with bundle files; each message is one line that begins with the path.

use std::path::PathBuf;

use demc_model::WeightsError;

use super::FORMAT;

/// Why a bundle could not be written or read.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum BundleError {
    /// The file or directory could not be read.
    #[error("cannot read {}", path.display())]
    Read {
        /// The file or directory.
        path: PathBuf,
        /// Why.
        source: std::io::Error,
    },
    /// The file could not be written.
    #[error(transparent)]
    Write(#[from] demc_data::Error),
    /// A directory that is neither a run nor a checkpoint.
    #[error(
        "{}: neither a run directory nor a checkpoint: no best.safetensors, latest or model.safetensors in it",
        path.display()
    )]
    NoModel {
        /// The directory.
        path: PathBuf,
    },
    /// Not a safetensors file, or one cut short.
    #[error("{}: cut short, damaged or no safetensors file: {detail}", path.display())]
    Damaged {
        /// The file.
        path: PathBuf,
        /// What the decoder said.
        detail: String,
    },
    /// A safetensors file of somebody else.
    #[error(
        "{}: a safetensors file, but no DEMC bundle: its header has no `demc` entry with statistics and layout",
        path.display()
    )]
    Foreign {
        /// The file.
        path: PathBuf,
    },
    /// A bundle of another version of this program.
    #[error("{}: bundle format {found}; this build reads format {FORMAT}", path.display())]
    Format {
        /// The file.
        path: PathBuf,
        /// Its format.
        found: u64,
    },
    /// The header's JSON does not say what it should.
    #[error("{}: header entry `demc`: {detail}", path.display())]
    Header {
        /// The file.
        path: PathBuf,
        /// What is wrong.
        detail: String,
    },
    /// A tensor whose values are of no use: another type than f32 or f16, NaN or infinity.
    #[error("{}: tensor {name}: {detail}", path.display())]
    Tensor {
        /// The file.
        path: PathBuf,
        /// The tensor.
        name: String,
        /// What is wrong.
        detail: String,
    },
    /// The tensors do not make the network that the header describes.
    #[error("{}", path.display())]
    Weights {
        /// The file.
        path: PathBuf,
        /// The first tensor that does not fit.
        source: WeightsError,
    },
    /// Tensors that do not make the network that they are said to be of; every one of them.
    #[error("{}: {problems}", path.display())]
    Import {
        /// The file.
        path: PathBuf,
        /// What is missing, unknown, of another shape or type, or of no use.
        problems: String,
    },
    /// A weight beyond f16's largest value.
    #[error("tensor {name}: {value} does not fit into f16; export with f32")]
    Overflow {
        /// The tensor.
        name: String,
        /// The value.
        value: f32,
    },
    /// A network beyond what one ONNX file can hold.
    #[error(
        "an ONNX file of {bytes} bytes: protobuf's limit is 2 GiB; export with f16, or a narrower network"
    )]
    TooLargeForOnnx {
        /// What it would need.
        bytes: u64,
    },
    /// What was read back after writing is not what was written.
    #[error("{}: read back after writing, but {what} differs: do not use this file", path.display())]
    ReadBack {
        /// The file.
        path: PathBuf,
        /// What differs.
        what: String,
    },
    /// The safetensors writer refused; a programmer's error.
    #[error("cannot encode the weights: {0}")]
    Encode(String),
}
