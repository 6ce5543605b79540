//! What the images of a command share, and what is read of one.

use demc_data::image::exr::ExrFile;
use demc_data::image::frame::{decode_input, decode_repaired};
use demc_data::input::ranges;
use demc_data::{ChannelLayout, Frame};

use crate::cli::filter::Filter;
use crate::cli::flags::ModelFlag;
use crate::cli::layers::read_layers;
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
    pub(super) method: Method,
    pub(super) layouts: Layouts<'a>,
    /// The options.
    pub(super) record: Record,
    pub(super) progress: Progress,
    pub(super) warnings: Warnings,
}

impl Work<'_> {
    /// The layout of a file. A choice among the presets is passed to `say`.
    pub(super) fn layout(
        &self,
        file: &ExrFile,
        say: impl FnOnce(&str),
    ) -> Result<ChannelLayout, demc_data::Error> {
        match &self.method {
            Method::Network(bundle) => self.layouts.of(file, bundle, say),
            Method::Filter(_) => self.layouts.of_filtered(file),
        }
    }
}

/// What denoises.
pub(super) enum Method {
    Network(Box<Bundle>),
    Filter(Filter),
}

impl Method {
    /// Its record, without options.
    pub(super) fn record(&self, model: &ModelFlag) -> anyhow::Result<Record> {
        Ok(match self {
            Self::Network(bundle) => Record::of_model(&model.short_name(), &bundle.checksum()?),
            Self::Filter(filter) => Record::of_filter(filter.name()),
        })
    }
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

impl Contents {
    /// Decodes the frame and these layers, and repairs them if wanted.
    pub(super) fn read(
        file: &mut ExrFile,
        layout: &ChannelLayout,
        names: &[String],
        repair: bool,
    ) -> anyhow::Result<Self> {
        let (mut frame, repaired) = if repair {
            decode_repaired(file, layout)?
        } else {
            (decode_input(file, layout)?, 0)
        };
        frame.name = file.path().display().to_string();
        let (layers, more) = read_layers(file, layout, names, repair)?;
        let alpha = layout.alpha.as_ref();
        if alpha.is_some_and(|alpha| names.contains(alpha)) {
            // As a layer, alpha needs no pass of its own.
            frame.alpha = None;
        }
        Ok(Self {
            frame,
            layers,
            repaired: repaired + more,
        })
    }
}
