//! Everything about a network except its weights.

use demc_data::{ChannelLayout, InputKind, Normalizer, PositionSpace, Ranges};
use demc_model::{ModelConfig, Variant};
use serde::{Deserialize, Serialize};

/// The bundle format that this build writes and reads. It increases when a tensor's name or meaning
/// changes.
pub const FORMAT: u32 = 1;

/// Everything about a network except its weights.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct BundleMeta {
    /// Bundle format, [`FORMAT`].
    pub format: u32,
    /// Variant, reading and width.
    pub model: ModelConfig,
    /// Gamma and the training set's statistics.
    pub normalizer: Normalizer,
    /// Which channels of a renderer's files hold the 15 planes.
    pub layout: ChannelLayout,
    /// Number of optimizer steps behind the weights.
    pub step: u64,
    /// Ranges of the training scenes' statistics, which [`guard`](crate::guard) uses; `None` if
    /// unknown.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub ranges: Option<Ranges>,
    /// The licence of weights that come from another program, and of those trained from them; `None` for
    /// weights of one's own.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub license: Option<String>,
}

impl BundleMeta {
    /// Metadata in the current [`FORMAT`]. The layout is read for the network of `model`.
    pub fn new(
        model: ModelConfig,
        normalizer: Normalizer,
        layout: ChannelLayout,
        step: u64,
    ) -> Self {
        Self {
            format: FORMAT,
            model,
            normalizer,
            layout: ChannelLayout {
                inputs: Self::inputs_of(model.variant),
                ..layout
            },
            step,
            ranges: None,
            license: None,
        }
    }

    /// Adds the licence of weights that come from another program.
    pub fn with_license(self, license: impl Into<String>) -> Self {
        Self {
            license: Some(license.into()),
            ..self
        }
    }

    /// Adds the ranges of the training scenes' statistics.
    pub fn with_ranges(self, ranges: Ranges) -> Self {
        Self {
            ranges: Some(ranges),
            ..self
        }
    }

    /// The planes that a network of a variant takes as input.
    pub fn inputs_of(variant: Variant) -> InputKind {
        match variant {
            Variant::Kpcn => InputKind::Kpcn,
            _ => InputKind::Demc,
        }
    }

    /// Why this network cannot be the albedo filter of one that takes such inputs and positions; `None`
    /// if it can. Both get the same positions: in ONNX and Python the caller maps them once.
    pub fn filter_problem(&self, inputs: InputKind, position: PositionSpace) -> Option<String> {
        if !(inputs.is_demc() && self.layout.inputs.is_demc()) {
            return Some("kpcn neither has an albedo filter nor is one".into());
        }
        if self.model.variant.spec().pads_with_zeros {
            return Some("a network of variant unet cannot be an albedo filter".into());
        }
        // The variant without features takes no positions.
        let same = self.normalizer.position == position || self.model.variant == Variant::ColorOnly;
        let name = |space: PositionSpace| match space {
            PositionSpace::Scene => "scene",
            PositionSpace::Image => "image",
        };
        (!same).then(|| {
            let [own, theirs] = [self.normalizer.position, position].map(name);
            format!(
                "the albedo filter was trained with data.position = \"{own}\", the network with \
                 \"{theirs}\"; train the filter with \"{theirs}\""
            )
        })
    }
}
