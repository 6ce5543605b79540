//! What can go wrong with files, data sets and settings. Each message is one line that names the path,
//! channel or key, what was expected and what was found; an underlying I/O error is the `source`.

use std::path::PathBuf;

/// An error of this crate.
#[derive(Debug, thiserror::Error)]
pub enum Error {
    /// A file could not be opened or read.
    #[error("cannot read {}", path.display())]
    Read {
        /// The file.
        path: PathBuf,
        /// Why.
        source: std::io::Error,
    },
    /// An output could not be written; nothing was left behind.
    #[error("cannot write {}", path.display())]
    Write {
        /// The output.
        path: PathBuf,
        /// Why.
        source: std::io::Error,
    },
    /// Not an OpenEXR file, cut short, damaged, or of a kind that is not read (deep data, subsampling).
    #[error("{}: not a readable OpenEXR file: {detail}", path.display())]
    Exr {
        /// The file.
        path: PathBuf,
        /// What the decoder said.
        detail: String,
    },
    /// Channels that the layout names are not in the file.
    #[error("{}: no channel {}; the file has {}", path.display(), missing.join(", "), present.join(", "))]
    MissingChannels {
        /// The file.
        path: PathBuf,
        /// The channels asked for and not found.
        missing: Vec<String>,
        /// All channels of the file.
        present: Vec<String>,
    },
    /// Two buffers of one image do not cover the same pixels.
    #[error("{}: buffers of different sizes: {a} is {a_window}, {b} is {b_window}", path.display())]
    Sizes {
        /// The file.
        path: PathBuf,
        /// A channel.
        a: String,
        /// Its window, as `WxH+X+Y`.
        a_window: String,
        /// Another channel.
        b: String,
        /// Its window.
        b_window: String,
    },
    /// NaN or infinity in a buffer.
    #[error(
        "{}: channel {channel}: {value} at x {x}, y {y} ({count} NaN or infinite samples in all)",
        path.display()
    )]
    NonFinite {
        /// The file.
        path: PathBuf,
        /// The channel, by its name in the file.
        channel: String,
        /// The first bad sample.
        value: f32,
        /// Its column, pixels from the left.
        x: usize,
        /// Its row, pixels from the top.
        y: usize,
        /// How many samples of this channel are bad.
        count: usize,
    },
    /// A channel layout that cannot be used.
    #[error("channel layout {name}: {detail}")]
    Layout {
        /// The preset or file.
        name: String,
        /// What is wrong with it.
        detail: String,
    },
    /// A data set that cannot be used; every problem found is named.
    #[error("data set {}: {}", root.display(), problems.join("; "))]
    Dataset {
        /// The data set's directory.
        root: PathBuf,
        /// All problems, one phrase each.
        problems: Vec<String>,
    },
    /// A scene file's size is not the manifest's.
    #[error("{}: is {found}, but the manifest says {expected}", path.display())]
    SceneSize {
        /// The file.
        path: PathBuf,
        /// The file's size, as `WxH`.
        found: String,
        /// The manifest's.
        expected: String,
    },
    /// A scene too small to hold one patch.
    #[error("scene {scene}: {width}x{height} pixels hold no patch of {patch}x{patch}")]
    SceneTooSmall {
        /// The scene's name.
        scene: String,
        /// Its width in pixels.
        width: usize,
        /// Its height in pixels.
        height: usize,
        /// The patch size in pixels.
        patch: usize,
    },
}
