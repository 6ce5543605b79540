//! The variants (Sec. 3, 4.3, 4.4), and networks of others.

use serde::{Deserialize, Serialize};

use super::{COLOR_CHANNELS, DETAIL_CHANNELS, FEATURE_CHANNELS, LEVELS};
use crate::unet_size::UNET_LEVELS;

/// The network's topology.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Variant {
    /// The dual-encoder network (Fig. 3).
    Demc,
    /// DEMC without the fusion sub-network: the features are the input of their encoder (Sec. 4.3).
    DemcNosn,
    /// The single-encoder network (Fig. 4, Sec. 4.4).
    Semc,
    /// SEMC without features: one encoder for the noisy colour. Ours: a control that measures what
    /// the features contribute.
    ColorOnly,
    /// The kernel-predicting networks that the paper compares with ([`crate::kpcn`]).
    Kpcn,
    /// The U-Net of Open Image Denoise ([`crate::unet`]).
    Unet,
    /// The U-Net with a second encoder for the detail map ([`crate::side_encoder`]).
    UnetDemc,
    /// The same without the fusion sub-network: the second encoder takes the features.
    UnetNosn,
}

/// One of the images that an encoder takes as input.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Input {
    /// Gamma-compressed noisy colour, 3 channels.
    Color,
    /// The fused detail map, 3 channels.
    DetailMap,
    /// The Z-scored features, 12 channels.
    Features,
}

impl Input {
    /// Number of channels.
    pub fn channels(self) -> usize {
        match self {
            Input::Color => COLOR_CHANNELS,
            Input::DetailMap => DETAIL_CHANNELS,
            Input::Features => FEATURE_CHANNELS,
        }
    }
}

/// Channels of the concatenation of `inputs`.
pub fn channels_of(inputs: &[Input]) -> usize {
    inputs.iter().map(|input| input.channels()).sum()
}

/// A row of the table of variants.
#[derive(Debug)]
pub struct VariantSpec {
    /// Name in configuration files.
    pub name: &'static str,
    /// The inputs of each encoder, concatenated over channels in this order. The skips enter the
    /// fusion in the order of the encoders (Eq. 2: features, then HDR). The last encoder feeds the
    /// latent. None: the variant has another body.
    pub encoders: &'static [&'static [Input]],
    /// Channels of the colour at input and output: one image, or two for KPCN.
    pub color_channels: usize,
    /// Times that the network halves the resolution: the sides of its input are multiples of 2 to this
    /// power. The convolutions of KPCN could take any size.
    pub halvings: usize,
    /// Whether an image of another size gets zeros at its right and bottom, as in OIDN; otherwise its
    /// last pixels are repeated.
    pub pads_with_zeros: bool,
    /// What the encoder beside a U-Net takes, if there is one.
    pub side: Option<Input>,
}

/// What most rows share: the paper's values.
const PAPER: VariantSpec = VariantSpec {
    name: "",
    encoders: &[],
    color_channels: COLOR_CHANNELS,
    halvings: LEVELS,
    pads_with_zeros: false,
    side: None,
};

/// What the rows of U-Nets share.
const UNET: VariantSpec = VariantSpec {
    name: "unet",
    halvings: UNET_LEVELS,
    pads_with_zeros: true,
    ..PAPER
};

impl VariantSpec {
    /// Whether the variant has the fusion sub-network: whether an encoder takes the detail map as
    /// input.
    pub fn has_fusion(&self) -> bool {
        let inputs = self.encoders.iter().copied().flatten();
        inputs
            .chain(&self.side)
            .any(|input| *input == Input::DetailMap)
    }

    /// Whether the features have any effect: false if encoders take the colour alone as input.
    pub fn takes_features(&self) -> bool {
        self.encoders != [[Input::Color]]
    }
}

impl Variant {
    /// All variants: those of the paper in its order, the control, KPCN, and the U-Net.
    pub const ALL: [Variant; 8] = [
        Variant::Demc,
        Variant::DemcNosn,
        Variant::Semc,
        Variant::ColorOnly,
        Variant::Kpcn,
        Variant::Unet,
        Variant::UnetDemc,
        Variant::UnetNosn,
    ];

    /// Whether this is a [`crate::unet::Unet`].
    pub fn is_unet(self) -> bool {
        matches!(self, Variant::Unet | Variant::UnetDemc | Variant::UnetNosn)
    }

    /// The variants that are a [`crate::dual_encoder::DualEncoder`].
    pub fn with_encoders() -> impl Iterator<Item = Variant> {
        Self::ALL
            .into_iter()
            .filter(|variant| !variant.spec().encoders.is_empty())
    }

    /// The table of variants.
    pub fn spec(self) -> &'static VariantSpec {
        match self {
            Variant::Demc => &VariantSpec {
                name: "demc",
                encoders: &[&[Input::DetailMap], &[Input::Color]],
                ..PAPER
            },
            Variant::DemcNosn => &VariantSpec {
                name: "demc-nosn",
                encoders: &[&[Input::Features], &[Input::Color]],
                ..PAPER
            },
            Variant::Semc => &VariantSpec {
                name: "semc",
                encoders: &[&[Input::DetailMap, Input::Color]],
                ..PAPER
            },
            Variant::ColorOnly => &VariantSpec {
                name: "color-only",
                encoders: &[&[Input::Color]],
                ..PAPER
            },
            Variant::Kpcn => &VariantSpec {
                name: "kpcn",
                color_channels: 2 * COLOR_CHANNELS,
                ..PAPER
            },
            Variant::Unet => &UNET,
            Variant::UnetDemc => &VariantSpec {
                name: "unet-demc",
                side: Some(Input::DetailMap),
                ..UNET
            },
            Variant::UnetNosn => &VariantSpec {
                name: "unet-nosn",
                side: Some(Input::Features),
                ..UNET
            },
        }
    }
}
