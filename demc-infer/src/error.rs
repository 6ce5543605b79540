//! Why a frame cannot be denoised or scored.

use burn::tensor::TensorReadError;
use demc_data::image::exr::{UnsupportedSize, check_size};
use demc_data::input::kpcn::PASS_PLANES;
use demc_data::{FEATURES, Frame};
use demc_model::config::COLOR_CHANNELS;
use demc_model::metrics::ImageError;

use crate::memory::TooLarge;

/// Why a frame cannot be denoised or scored.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
#[allow(missing_docs, reason = "the messages explain the fields")]
pub enum DenoiseError {
    /// A buffer does not have the frame's size.
    #[error("{name}: {buffer} holds {found} values; {width}x{height} pixels need {expected}")]
    Size {
        name: String,
        buffer: &'static str,
        found: usize,
        expected: usize,
        /// The frame's width in pixels.
        width: usize,
        /// The frame's height in pixels.
        height: usize,
    },
    /// The image exceeds the limits of files.
    #[error("{name}")]
    Limit {
        name: String,
        source: UnsupportedSize,
    },
    /// The image does not fit into memory.
    #[error("{name}")]
    Memory { name: String, source: TooLarge },
    /// The layers cannot be denoised.
    #[error("{name}")]
    Layers { name: String, source: LayersError },
    /// A frame without the passes of KPCN.
    #[error("{name}: no passes, which kpcn needs; read the frame with the model's layout")]
    NoPasses { name: String },
    /// A feature channel is far from the training data: another unit, or another buffer.
    #[error(
        "{name}: {channel} does not fit the model's statistics: \
         it is {rms:.1} training deviations from the training mean (root mean square, limit {limit}); \
         training mean {mean:.4}, deviation {std:.4}. Is it in another unit, or another buffer?"
    )]
    Statistics {
        name: String,
        channel: &'static str,
        /// Its root mean square distance from the training mean, in training deviations.
        rms: f64,
        /// The largest distance that is accepted, [`FARTHEST_RMS`](crate::guard::FARTHEST_RMS).
        limit: f64,
        mean: f32,
        std: f32,
    },
    /// The network's output has NaN or infinite values.
    #[error(
        "{name}: {count} NaN or infinite values in the network's output: the image does not fit \
         the training data's statistics, or the weights are damaged"
    )]
    NonFinite {
        name: String,
        /// Number of such values.
        count: usize,
    },
    /// The device failed to compute or to return the image.
    #[error("{name}: the device failed")]
    Device {
        name: String,
        source: TensorReadError,
    },
    /// The observer stopped the work.
    #[error("{name}: cancelled")]
    Cancelled { name: String },
    /// An image with NaN or infinite values has no score.
    #[error("{name}: {what}")]
    Image {
        name: String,
        what: String,
        /// Number and kind of the values.
        source: ImageError,
    },
    /// The frame has no reference to compare with.
    #[error("{name}: no reference in the file")]
    NoReference { name: String },
}

/// Why layers cannot be denoised.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[allow(missing_docs, reason = "the messages explain the fields")]
pub enum LayersError {
    /// The network denoises diffuse and specular light.
    #[error("a kpcn model denoises no layers: it takes diffuse and specular light, not images")]
    Kpcn,
    /// Test-time augmentation with a kernel head.
    #[error(
        "layers of a kernel head need a single pass, not the mean of {count}: it is taken in gamma \
         space, where layers do not add up"
    )]
    Ensemble { count: usize },
    /// A layer does not have the frame's size.
    #[error("layer {name} holds {found} values; the image has {expected} pixels")]
    Size {
        name: String,
        found: usize,
        expected: usize,
    },
}

pub(crate) fn check_sizes(frame: &Frame) -> Result<(), DenoiseError> {
    let Frame { width, height, .. } = *frame;
    let checks = [
        ("color", frame.color.len(), COLOR_CHANNELS),
        ("features", frame.features.len(), FEATURES),
    ];
    check_size(width, height).map_err(|source| DenoiseError::Limit {
        name: frame.name.clone(),
        source,
    })?;
    let mask = frame.mask.as_ref().map(|mask| ("mask", mask.len(), 1));
    let passes = frame.passes.as_ref();
    let passes = passes.map(|passes| ("passes", passes.len(), PASS_PLANES));
    for (buffer, found, channels) in checks.into_iter().chain(mask).chain(passes) {
        let expected = channels * width * height;
        if found != expected {
            return Err(DenoiseError::Size {
                name: frame.name.clone(),
                buffer,
                found,
                expected,
                width,
                height,
            });
        }
    }
    Ok(())
}
