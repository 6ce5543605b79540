//! Why a frame could not be denoised.

use burn::tensor::TensorReadError;
use demc_model::metrics::ImageError;

use crate::guard::FARTHEST_RMS;
use crate::memory::TooLarge;

/// Why a frame could not be denoised.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum DenoiseError {
    /// The frame's buffers do not have the size that it claims.
    #[error("{name}: {buffer} holds {found} values; {width}x{height} pixels need {expected}")]
    Size {
        /// The frame.
        name: String,
        /// The buffer.
        buffer: &'static str,
        /// Its length.
        found: usize,
        /// What it should be.
        expected: usize,
        /// The frame's width in pixels.
        width: usize,
        /// The frame's height in pixels.
        height: usize,
    },
    /// The image does not fit into memory.
    #[error("{name}")]
    Memory {
        /// The frame.
        name: String,
        /// What it needs and what there is.
        source: TooLarge,
    },
    /// A feature channel is nowhere near what the network was trained on: another unit, or another buffer.
    #[error(
        "{name}: {channel} does not fit the model's statistics: {rms:.1} deviations from the training mean (root mean square; at most {FARTHEST_RMS}), in training mean {mean:.4} with a deviation of {std:.4}; another unit or another buffer?"
    )]
    Statistics {
        /// The frame.
        name: String,
        /// The channel.
        channel: &'static str,
        /// Its root mean square distance from the training mean, in training deviations.
        rms: f64,
        /// Its mean over the training scenes.
        mean: f32,
        /// Its standard deviation over the training scenes.
        std: f32,
    },
    /// The network's output is not a number everywhere.
    #[error(
        "{name}: {count} NaN or infinite values in the network's output: the image does not fit the training data's statistics, or the weights are damaged"
    )]
    NonFinite {
        /// The frame.
        name: String,
        /// How many.
        count: usize,
    },
    /// The device could not compute or hand over the image.
    #[error("{name}: the device failed")]
    Device {
        /// The frame.
        name: String,
        /// What the device said.
        source: TensorReadError,
    },
    /// An image with values that are not finite has no score.
    #[error("{name}: {what}")]
    Image {
        /// The frame.
        name: String,
        /// Which image of it.
        what: String,
        /// How many.
        source: ImageError,
    },
    /// There is nothing to compare with.
    #[error("{name}: no reference in the file")]
    NoReference {
        /// The frame.
        name: String,
    },
}
