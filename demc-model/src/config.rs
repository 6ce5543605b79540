//! The `[model]` table, the variants, and the readings of the paper.
//!
//! All differences between networks are in [`VariantSpec`] and [`ReadingSpec`]. The modules read
//! these tables and do not branch on names. A new variant is a new row.

use std::fmt;

use serde::{Deserialize, Serialize};

use crate::unet_size::{Guides, UnetSize};

mod validate;
mod variant;

pub use variant::{Input, Variant, VariantSpec, channels_of};

/// Levels of an encoder and of the decoder (Sec. 3.2: "five down-sampling units").
pub const LEVELS: usize = 5;

/// Factor between the input's and the latent's height and width of the paper's networks: 2^5. The largest
/// of all variants.
pub const DOWNSAMPLING: usize = 1 << LEVELS;

/// The paper's channels of each level as multiples of the base width, from the full resolution down
/// (Sec. 3.2: 512 in the latent at C = 64).
pub const LEVEL_WIDTHS: [usize; LEVELS] = [1, 2, 4, 8, 8];

/// Colour channels of input and output.
pub const COLOR_CHANNELS: usize = 3;

/// Feature channels (Sec. 3.1): normal, position, albedo at the first and at the second hit, three
/// each.
pub const FEATURE_CHANNELS: usize = 12;

/// Channels of the detail map, the output of the fusion sub-network (Sec. 3.2).
pub const DETAIL_CHANNELS: usize = 3;

/// Largest base width of a configuration. Ours: 256 has 685 million parameters, 11 GB with Adam's
/// state and gradients; a larger value is probably a typing error.
pub const MAX_WIDTH: usize = 256;

/// Largest number of channels of a level as a multiple of the base width, for the same reason.
pub const MAX_LEVEL: usize = 16;

/// The reading of the paper where its text and the authors' released model differ.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Reading {
    /// The text and Fig. 3.
    Paper,
    /// The model definition that the authors released.
    Released,
}

/// The head: what follows the decoder's levels. The paper has a convolution to colour, and specifies
/// Xavier for encoders and latent only (Sec. 4.2).
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Hash, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Head {
    /// A convolution that starts at a nearly flat image. The bias is the flat colour with the smallest loss on the training set;
    /// the weights are Xavier times [`crate::init::GREY_HEAD_SCALE`].
    ///
    /// Ours: with plain Xavier most outputs start below zero, where ReLU and x^2.2 have no
    /// gradient. The mean colour of the set is no better, because dark pixels dominate the loss. On
    /// the sample its loss is 15 (black: 2.6, the best flat colour: 1.7), and the outputs soon die.
    #[default]
    Grey,
    /// A convolution with Xavier weights and a zero bias, as for all other convolutions.
    Xavier,
    /// Kernels: the network predicts the weights with which noisy pixels are averaged, on four
    /// scales (Bako et al. 2017, Vogels et al. 2018). See [`crate::kernel_head`].
    Kernel,
}

impl Head {
    /// The name in configurations.
    pub fn name(self) -> &'static str {
        match self {
            Head::Grey => "grey",
            Head::Xavier => "xavier",
            Head::Kernel => "kernel",
        }
    }

    /// Whether two heads have the same weights; they may differ in the initialisation.
    pub fn has_weights_of(self, other: Head) -> bool {
        let is_plain = |head| matches!(head, Head::Grey | Head::Xavier);
        self == other || is_plain(self) && is_plain(other)
    }
}

/// Initialisation of the detail map, the output of the fusion sub-network. Its activation is a
/// ReLU, so a channel that is zero everywhere has no gradient and stays zero.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Hash, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Detail {
    /// Above zero nearly everywhere: the last convolution has a bias of [`crate::init::OPEN_BIAS`].
    ///
    /// Ours: with a bias of zero, two of the three channels were zero at 97 % or more of the pixels
    /// after a few hundred steps. This held for every seed.
    #[default]
    Open,
    /// A zero bias, as for all other convolutions.
    Xavier,
}

/// A row of the table of readings.
#[derive(Debug)]
pub struct ReadingSpec {
    /// Name in configuration files.
    pub name: &'static str,
    /// Number of 3x3 convolutions of each encoder level.
    pub convolutions: [usize; LEVELS],
    /// Number of convolutions of each level before its skip.
    pub skip_after: [usize; LEVELS],
    /// Whether latent and deconvolutions have a batch normalisation before their ReLU.
    pub normalised_decoder: bool,
    /// Whether a ReLU follows the skip fusion (the sigma of Eq. 2).
    pub activated_fusion: bool,
    /// Side of the output convolution's kernel (Fig. 3: 1), unless the head is [`Head::Kernel`].
    pub head_kernel: usize,
}

impl Reading {
    /// Both readings of the paper.
    pub const ALL: [Reading; 2] = [Reading::Paper, Reading::Released];

    /// The table of readings.
    pub fn spec(self) -> &'static ReadingSpec {
        match self {
            Reading::Paper => &ReadingSpec {
                name: "paper",
                convolutions: [3, 3, 3, 3, 3],
                skip_after: [2, 2, 2, 2, 2],
                normalised_decoder: false,
                activated_fusion: true,
                head_kernel: 1,
            },
            Reading::Released => &ReadingSpec {
                name: "released",
                convolutions: [2, 2, 3, 3, 3],
                skip_after: [2, 2, 3, 3, 3],
                normalised_decoder: true,
                activated_fusion: false,
                head_kernel: 3,
            },
        }
    }
}

/// The `[model]` table: the shape and the initialisation of a network.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct ModelConfig {
    /// The network's topology.
    pub variant: Variant,
    /// The reading of the paper.
    pub reading: Reading,
    /// Base width C (64 in the paper): the channels of the fusion sub-network and the unit of
    /// `levels`.
    pub width: usize,
    /// Channels of each level as multiples of the base width, from the full resolution down. The
    /// latent has those of the last level.
    pub levels: [usize; LEVELS],
    /// The head, and the initialisation of a convolution.
    pub head: Head,
    /// Initialisation of the detail map.
    pub detail: Detail,
    /// Size of a U-Net. Absent in files if it is the default, as the guides are: other variants have none.
    #[serde(skip_serializing_if = "UnetSize::is_default")]
    pub size: UnetSize,
    /// Guides of a U-Net.
    #[serde(skip_serializing_if = "Guides::is_default")]
    pub guides: Guides,
}

impl Default for ModelConfig {
    /// The paper's network.
    fn default() -> Self {
        ModelConfig {
            variant: Variant::Demc,
            reading: Reading::Paper,
            width: 64,
            levels: LEVEL_WIDTHS,
            head: Head::Grey,
            detail: Detail::Open,
            size: UnetSize::default(),
            guides: Guides::default(),
        }
    }
}

/// A short description: `demc, paper reading, width 32`, and the levels if they are not the
/// paper's.
impl fmt::Display for ModelConfig {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let (variant, reading) = (self.variant.spec().name, self.reading.spec().name);
        match self.variant {
            Variant::Kpcn => return write!(f, "{variant}, width {}", self.width),
            _ if self.variant.is_unet() => {
                let [size, guides] = [self.size.spec().name, self.guides.name()];
                write!(f, "{variant}, {size}, guides {guides}")?;
                return match self.variant.spec().side {
                    Some(_) => write!(f, ", width {}", self.width),
                    None => Ok(()),
                };
            }
            _ => (),
        }
        write!(f, "{variant}, {reading} reading, width {}", self.width)?;
        match self.levels {
            LEVEL_WIDTHS => Ok(()),
            _ => write!(f, ", levels of {:?}", self.level_channels()),
        }
    }
}

impl ModelConfig {
    /// The U-Net that this one contains: without the second encoder. `None` for other variants.
    pub fn trunk(&self) -> Option<ModelConfig> {
        self.variant.is_unet().then(|| ModelConfig {
            variant: Variant::Unet,
            size: self.size,
            guides: self.guides,
            ..ModelConfig::default()
        })
    }

    /// Whether one of the 12 feature channels has any effect.
    pub fn takes_feature(&self, channel: usize) -> bool {
        match self.variant {
            Variant::Unet => {
                let mut firsts = self.guides.first_channels().iter();
                firsts.any(|first| (*first..first + COLOR_CHANNELS).contains(&channel))
            }
            _ => self.variant.spec().takes_features(),
        }
    }

    /// Whether any feature has an effect.
    pub fn takes_features(&self) -> bool {
        (0..FEATURE_CHANNELS).any(|channel| self.takes_feature(channel))
    }

    /// Channels of each level, from the full resolution down.
    pub fn level_channels(&self) -> [usize; LEVELS] {
        self.levels.map(|factor| factor * self.width)
    }

    /// Channels of the level below `level`, 0 at the full resolution; below the last one is the
    /// latent.
    pub fn channels_below(&self, level: usize) -> usize {
        self.level_channels()[(level + 1).min(LEVELS - 1)]
    }
}

#[cfg(test)]
mod tests;
