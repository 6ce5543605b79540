//! Sizes and guides of the U-Net, a table: channels of each convolution.

use serde::{Deserialize, Serialize};

/// Levels of the encoder and of the decoder, without the bottom.
pub const UNET_LEVELS: usize = 4;

/// Channels of the colour and of each guide.
const IMAGE_CHANNELS: usize = 3;

/// First of the three feature channels with the normal.
const NORMAL: usize = 0;

/// First of the three feature channels with the albedo at the first hit.
const ALBEDO: usize = 6;

/// The sizes that OIDN ships, and one between them.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Hash, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum UnetSize {
    /// 0.3 million parameters, OIDN's quality `fast`.
    Small,
    /// 0.9 million parameters, OIDN's quality `high` with noisy guides.
    #[default]
    Base,
    /// 3.8 million parameters: the large one with fewer channels at the full resolution.
    Medium,
    /// 3.8 million parameters, OIDN's quality `high` with clean guides.
    Large,
}

/// The guides beside the colour.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Hash, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Guides {
    /// The colour alone.
    None,
    /// Albedo.
    Albedo,
    /// Albedo and normal.
    #[default]
    AlbedoNormal,
}

/// A row of the table of sizes: the output channels of each convolution.
#[derive(Debug)]
pub struct UnetSpec {
    /// Name in configuration files.
    pub name: &'static str,
    /// Convolutions of each encoder level, from the full resolution down.
    pub encoder: [&'static [usize]; UNET_LEVELS],
    /// Convolutions at a sixteenth of the resolution.
    pub bottom: [usize; 2],
    /// Convolutions of each decoder level, from the deepest up.
    pub decoder: [[usize; 2]; UNET_LEVELS],
}

impl UnetSize {
    /// All sizes, smallest first.
    pub const ALL: [UnetSize; 4] = [
        UnetSize::Small,
        UnetSize::Base,
        UnetSize::Medium,
        UnetSize::Large,
    ];

    pub(crate) fn is_default(&self) -> bool {
        *self == Self::default()
    }

    /// The table of sizes.
    pub fn spec(self) -> &'static UnetSpec {
        match self {
            UnetSize::Small => &UnetSpec {
                name: "small",
                encoder: [&[32, 32], &[32], &[32], &[32]],
                bottom: [32, 32],
                decoder: [[64, 64], [64, 64], [64, 32], [32, 32]],
            },
            UnetSize::Base => &UnetSpec {
                name: "base",
                encoder: [&[32, 32], &[48], &[64], &[80]],
                bottom: [96, 96],
                decoder: [[112, 112], [96, 96], [64, 64], [64, 32]],
            },
            UnetSize::Medium => &UnetSpec {
                name: "medium",
                encoder: [&[48, 64], &[96, 96], &[128, 128], &[192, 192]],
                bottom: [256, 256],
                decoder: [[192, 192], [128, 128], [96, 96], [48, 48]],
            },
            UnetSize::Large => &UnetSpec {
                name: "large",
                encoder: [&[64, 64], &[96, 96], &[128, 128], &[192, 192]],
                bottom: [256, 256],
                decoder: [[192, 192], [128, 128], [96, 96], [64, 64]],
            },
        }
    }
}

impl Guides {
    /// From none to both.
    pub const ALL: [Guides; 3] = [Guides::None, Guides::Albedo, Guides::AlbedoNormal];

    pub(crate) fn is_default(&self) -> bool {
        *self == Self::default()
    }

    /// The name in configurations.
    pub fn name(self) -> &'static str {
        match self {
            Guides::None => "none",
            Guides::Albedo => "albedo",
            Guides::AlbedoNormal => "albedo-normal",
        }
    }

    /// The first channel of each guide among the 12 features, in the order of the network's input.
    pub fn first_channels(self) -> &'static [usize] {
        match self {
            Guides::None => &[],
            Guides::Albedo => &[ALBEDO],
            Guides::AlbedoNormal => &[ALBEDO, NORMAL],
        }
    }

    /// Channels of the network's input, colour included.
    pub fn channels(self) -> usize {
        IMAGE_CHANNELS * (1 + self.first_channels().len())
    }
}
