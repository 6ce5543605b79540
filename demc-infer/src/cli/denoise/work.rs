//! What the images of a command share, and what is read of one.

use demc_data::image::exr::ExrFile;
use demc_data::input::ranges;
use demc_data::{ChannelLayout, Frame};

use crate::cli::layouts::Layouts;
use crate::cli::progress::Progress;
use crate::cli::record::Record;
use crate::cli::warnings::Warnings;
use crate::denoise::{Layer, SeamError};
use crate::guard::Warning;
use crate::{Bundle, memory};

/// Largest cache of an input's decoded blocks in bytes, kept until its output is written (ours:
/// three times 19 half channels of 1920x1080). Blocks beyond it are decompressed twice.
const MAX_CACHE: u64 = 256 << 20;

/// Size of that cache with the available memory, most of which the network needs.
pub(super) fn cache_bytes() -> usize {
    let share = memory::available().map_or(MAX_CACHE, |bytes| bytes / 16);
    share.min(MAX_CACHE) as usize
}

/// Largest distance of a frame's exposure from that of its sequence without a warning, in stops (ours).
const MOST_STOPS: f64 = 2.0;

/// A warning about a frame whose exposure is far from the one that its factor is made for.
pub(super) fn far_from_sequence(frame: &Frame, exposure: Option<f64>) -> Option<Warning> {
    let expected = exposure.filter(|exposure| *exposure > 0.0)?;
    let stops = (ranges::exposure(&frame.color) / expected).log2();
    // A black frame is at infinity.
    (stops.is_finite() && stops.abs() > MOST_STOPS).then(|| Warning {
        what: "exposure".into(),
        found: format!("it is {stops:+.1} stops from that of the frames around it"),
        cause: "the factor of a sequence changes slowly; denoise such a frame by its own name with --overwrite",
    })
}

/// The error at seams, in words.
pub(super) fn described(error: &SeamError) -> String {
    let SeamError {
        relmse,
        largest,
        windows,
    } = error;
    format!(
        "error at seams, from {windows} windows denoised exactly: RelMSE {relmse:.2e}, \
         largest difference {largest:.2e} of the largest value"
    )
}

/// What all images of a command share.
pub(super) struct Work<'a> {
    pub(super) bundle: Bundle,
    pub(super) layouts: Layouts<'a>,
    /// The options.
    pub(super) record: Record,
    pub(super) progress: Progress,
    pub(super) warnings: Warnings,
}

/// An image to denoise.
pub(super) struct Prepared<'a> {
    pub(super) file: ExrFile,
    pub(super) layout: &'a ChannelLayout,
    /// Of the output's header.
    pub(super) record: &'a Record,
    /// The exposure that the factor is made for; `None`: its own.
    pub(super) exposure: Option<f64>,
}

/// What is denoised of a file.
pub(super) struct Contents {
    pub(super) frame: Frame,
    pub(super) layers: Vec<Layer>,
    /// Number of samples that were repaired.
    pub(super) repaired: usize,
}
