//! Errors of files, data sets and settings. Each message is one line that names the path, channel
//! or key, the expectation and the finding. An underlying I/O error is the `source`.

use std::path::PathBuf;

use demc_program::file::FileError;
use demc_program::message::list;

/// An error of this crate.
#[derive(Debug, thiserror::Error)]
#[allow(missing_docs, reason = "the messages explain the fields")]
pub enum Error {
    /// A file could not be read or written.
    #[error(transparent)]
    File(#[from] FileError),
    /// Not an OpenEXR file, truncated, damaged, or of an unsupported kind (deep data, subsampling).
    #[error("{}: not a readable OpenEXR file: {detail}", path.display())]
    Exr { path: PathBuf, detail: String },
    /// Memory does not suffice for the pixels of a file.
    #[error("{}: its pixels do not fit into memory: {needed} MiB are needed", path.display())]
    Memory {
        path: PathBuf,
        /// Size of the buffer that could not be allocated, MiB.
        needed: usize,
    },
    /// The file lacks channels that the layout names.
    #[error("{}: no channel {}; the file has {}", path.display(), list(missing), list(present))]
    MissingChannels {
        path: PathBuf,
        missing: Vec<String>,
        present: Vec<String>,
    },
    /// The file or the layout lacks passes.
    #[error(
        "{}: lacks {}; render with tools/render --passes paper, or name other channels in [passes] of a layout",
        path.display(),
        list(missing)
    )]
    MissingPasses {
        path: PathBuf,
        /// Names of channels; the content of buffers that the layout does not name.
        missing: Vec<String>,
    },
    /// Two buffers of one image cover different pixels.
    #[error("{}: buffers of different sizes: {a} is {a_window}, {b} is {b_window}", path.display())]
    Sizes {
        path: PathBuf,
        a: String,
        /// Its window, as `WxH+X+Y`.
        a_window: String,
        b: String,
        b_window: String,
    },
    /// A channel that cannot be denoised beside the colour.
    #[error("{}: channel {channel} is no layer: {detail}", path.display())]
    Layer {
        path: PathBuf,
        channel: String,
        detail: String,
    },
    /// Files that cannot be joined.
    #[error("cannot merge: {0}")]
    Merge(String),
    /// A buffer contains NaN or infinity.
    #[error(
        "{}: channel {channel}: {value} at x {x}, y {y} ({count} NaN or infinite samples in all)",
        path.display()
    )]
    NonFinite {
        path: PathBuf,
        channel: String,
        value: f32,
        /// Its column, pixels from the left.
        x: usize,
        /// Its row, pixels from the top.
        y: usize,
        /// Number of bad samples in this channel.
        count: usize,
    },
    /// A buffer with too many NaN or infinite samples to be repaired.
    #[error(
        "{}: channel {channel}: {count} of {samples} samples are NaN or infinite, more than the {percent} % that are repaired",
        path.display()
    )]
    Unrepairable {
        path: PathBuf,
        channel: String,
        /// Number of bad samples.
        count: usize,
        /// Number of all samples.
        samples: usize,
        /// The largest share that is repaired.
        percent: u32,
    },
    /// An unusable channel layout.
    #[error("channel layout {name}: {detail}")]
    Layout { name: String, detail: String },
    /// An unusable data set; the message names every problem.
    #[error("data set {}: {}", root.display(), problems.join("; "))]
    Dataset {
        root: PathBuf,
        problems: Vec<String>,
    },
    /// A scene file whose size differs from the manifest.
    #[error("{}: is {found}, but the manifest says {expected}", path.display())]
    SceneSize {
        path: PathBuf,
        /// The file's size, as `WxH`.
        found: String,
        expected: String,
    },
    /// The albedo filter of a training run failed.
    #[error("{}: albedo filter", path.display())]
    AlbedoFilter {
        path: PathBuf,
        source: Box<dyn std::error::Error + Send + Sync>,
    },
    /// A scene too small for one patch.
    #[error("scene {scene}: {width}x{height} pixels hold no patch of {patch}x{patch}")]
    SceneTooSmall {
        scene: String,
        /// Its width in pixels.
        width: usize,
        /// Its height in pixels.
        height: usize,
        /// The patch size in pixels.
        patch: usize,
    },
}
