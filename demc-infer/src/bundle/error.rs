//! Errors of bundle files. Each message is one line that starts with the path.

use std::path::PathBuf;

use demc_model::WeightsError;
use demc_program::file::FileError;

use super::meta::FORMAT;

/// Why a bundle cannot be written or read.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
#[allow(missing_docs, reason = "the messages explain the fields")]
pub enum BundleError {
    /// The file or directory cannot be read.
    #[error("cannot read {}", path.display())]
    Read {
        path: PathBuf,
        source: std::io::Error,
    },
    /// The file cannot be written.
    #[error(transparent)]
    Write(#[from] FileError),
    /// A directory that is neither a run nor a checkpoint.
    #[error(
        "{}: neither a run directory nor a checkpoint: it has no best.safetensors, latest or model.safetensors",
        path.display()
    )]
    NoModel { path: PathBuf },
    /// Not a safetensors file, or one cut short.
    #[error("{}: cut short, damaged or no safetensors file: {detail}", path.display())]
    Damaged { path: PathBuf, detail: String },
    /// The content differs from the checksum in the header.
    #[error(
        "{}: damaged: its checksum differs; copy or export it again, or, if you edited it, run demc-infer import",
        path.display()
    )]
    Checksum { path: PathBuf },
    /// A checkpoint's list of checksums that cannot be used.
    #[error("{}: {detail}", path.display())]
    Sums { path: PathBuf, detail: String },
    /// A safetensors file from another program.
    #[error(
        "{}: a safetensors file, but no DEMC bundle: its header has no `demc` entry with statistics and layout",
        path.display()
    )]
    Foreign { path: PathBuf },
    /// A bundle from another version of this program.
    #[error("{}: bundle format {found}; this build reads format {FORMAT}", path.display())]
    Format { path: PathBuf, found: u64 },
    /// The header's JSON is invalid.
    #[error("{}: header entry `demc`: {detail}", path.display())]
    Header { path: PathBuf, detail: String },
    /// A tensor has a type other than f32 and f16, or holds NaN or infinity.
    #[error("{}: tensor {name}: {detail}", path.display())]
    Tensor {
        path: PathBuf,
        name: String,
        detail: String,
    },
    /// The tensors do not match the network that the header describes.
    #[error("{}", path.display())]
    Weights { path: PathBuf, source: WeightsError },
    /// Imported tensors do not match the network.
    #[error("{}: {problems}", path.display())]
    Import { path: PathBuf, problems: String },
    /// A network that cannot be the albedo filter of another.
    #[error("{0}")]
    AlbedoFilter(String),
    /// A weight beyond f16's range.
    #[error("tensor {name}: {value} does not fit into f16; export with f32")]
    Overflow { name: String, value: f32 },
    /// The network is too large for one ONNX file.
    #[error(
        "the ONNX file would have {bytes} bytes, but protobuf's limit is 2 GiB; export with f16, or use a narrower network"
    )]
    TooLargeForOnnx { bytes: u64 },
    /// The file that was read back differs from what was written.
    #[error("{}: read back after writing, but {what} differs: do not use this file", path.display())]
    ReadBack { path: PathBuf, what: String },
    /// The safetensors writer failed; a programmer's error.
    #[error("cannot encode the weights: {0}")]
    Encode(String),
}
