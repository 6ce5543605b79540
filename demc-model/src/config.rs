//! What a network is: the variants (Sec. 3, 4.3, 4.4), the readings of the paper, and their two tables.
//!
//! Everything that differs between two networks stands in [`VariantSpec`] or [`ReadingSpec`]; the modules read the
//! tables and hold no branch on a name. A new variant is a new row.

use std::fmt;

use serde::{Deserialize, Serialize};

/// Levels of an encoder and of the decoder (Sec. 3.2: "five down-sampling units").
pub const LEVELS: usize = 5;

/// Factor between the input's and the latent's height and width: 2^5.
pub const DOWNSAMPLING: usize = 1 << LEVELS;

/// The paper's channels of a level as multiples of the base width, from the full resolution down (latent: 512 at C = 64, Sec. 3.2).
pub const LEVEL_WIDTHS: [usize; LEVELS] = [1, 2, 4, 8, 8];

/// Colour channels in and out.
pub const COLOR_CHANNELS: usize = 3;

/// Feature channels: normal, position, texture at the 1st and at the 2nd intersection, three each (Sec. 3.1).
pub const FEATURE_CHANNELS: usize = 12;

/// Channels of the detail map that the fusion sub-network makes of the features (Sec. 3.2).
pub const DETAIL_CHANNELS: usize = 3;

/// Widest base width that a configuration may ask for. Ours: 256 has 686 million parameters, 11 GB with Adam's state and
/// gradients; more is a slip of the keyboard.
pub const MAX_WIDTH: usize = 256;

/// Most channels of a level as a multiple of the base width, for the same reason.
pub const MAX_LEVEL: usize = 16;

/// Which network.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Variant {
    /// The dual-encoder network (Fig. 3).
    Demc,
    /// DEMC without the fusion sub-network: the features go straight to their encoder (Sec. 4.3).
    DemcNosn,
    /// The single-encoder network (Fig. 4, Sec. 4.4).
    Semc,
    /// SEMC without features: an encoder of the noisy colour. Ours, a control: what features bring is what it lacks.
    ColorOnly,
}

/// Which reading of the paper, where its text and its authors' released model differ.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Reading {
    /// The text and Fig. 3.
    Paper,
    /// The model definition that the authors published.
    Released,
}

/// How the output convolution starts. The paper prescribes Xavier for encoders and latent only (Sec. 4.2).
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Hash, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Head {
    /// A nearly flat image: as bias the flat colour with the least loss on the training set, Xavier weights times
    /// [`crate::init::GREY_HEAD_SCALE`]. Ours: with plain Xavier most outputs fall below zero at once, where ReLU and
    /// x^2.2 have no gradient. The set's mean colour is no better a start than that: dark pixels own the loss, and on
    /// the sample it begins at 15 (2.6 for black, 1.7 for the best flat colour) and soon dies.
    #[default]
    Grey,
    /// Xavier weights, zero bias, as everywhere else.
    Xavier,
}

/// How the detail map starts, the output of the fusion sub-network. Its activation is a ReLU: a channel that falls below zero
/// everywhere has no gradient and stays there.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Hash, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Detail {
    /// Above zero nearly everywhere: a bias of [`crate::init::OPEN_BIAS`] for the last convolution. Ours: with a bias of zero two of
    /// the three channels were zero at 97 % of the pixels or more after some hundred steps, whatever the seed.
    #[default]
    Open,
    /// A bias of zero, as everywhere else.
    Xavier,
}

/// One of the images that the network sees.
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

/// A row of the table of variants.
#[derive(Debug)]
pub struct VariantSpec {
    /// Name in configuration files.
    pub name: &'static str,
    /// What each encoder eats, concatenated over channels in this order. The skips enter the fusion in the order of the
    /// encoders (Eq. 2: features, then HDR); the last encoder feeds the latent.
    pub encoders: &'static [&'static [Input]],
}

impl VariantSpec {
    /// Whether the variant has the fusion sub-network: whether somebody eats its detail map.
    pub fn has_fusion(&self) -> bool {
        self.encoders
            .iter()
            .any(|inputs| inputs.contains(&Input::DetailMap))
    }
}

/// A row of the table of readings.
#[derive(Debug)]
pub struct ReadingSpec {
    /// Name in configuration files.
    pub name: &'static str,
    /// 3x3 convolutions of each encoder level.
    pub convolutions: [usize; LEVELS],
    /// After how many convolutions of each level the skip is taken.
    pub skip_after: [usize; LEVELS],
    /// Whether latent and deconvolutions have a batch normalisation before their ReLU.
    pub normalised_decoder: bool,
    /// Whether a ReLU follows the skip fusion (the sigma of Eq. 2).
    pub activated_fusion: bool,
}

impl Variant {
    /// All variants, in the order of the paper, and the control.
    pub const ALL: [Variant; 4] = [
        Variant::Demc,
        Variant::DemcNosn,
        Variant::Semc,
        Variant::ColorOnly,
    ];

    /// THE table of variants.
    pub fn spec(self) -> &'static VariantSpec {
        match self {
            Variant::Demc => &VariantSpec {
                name: "demc",
                encoders: &[&[Input::DetailMap], &[Input::Color]],
            },
            Variant::DemcNosn => &VariantSpec {
                name: "demc-nosn",
                encoders: &[&[Input::Features], &[Input::Color]],
            },
            Variant::Semc => &VariantSpec {
                name: "semc",
                encoders: &[&[Input::DetailMap, Input::Color]],
            },
            Variant::ColorOnly => &VariantSpec {
                name: "color-only",
                encoders: &[&[Input::Color]],
            },
        }
    }
}

impl Reading {
    /// Both readings.
    pub const ALL: [Reading; 2] = [Reading::Paper, Reading::Released];

    /// THE table of readings.
    pub fn spec(self) -> &'static ReadingSpec {
        match self {
            Reading::Paper => &ReadingSpec {
                name: "paper",
                convolutions: [3, 3, 3, 3, 3],
                skip_after: [2, 2, 2, 2, 2],
                normalised_decoder: false,
                activated_fusion: true,
            },
            Reading::Released => &ReadingSpec {
                name: "released",
                convolutions: [2, 2, 3, 3, 3],
                skip_after: [2, 2, 3, 3, 3],
                normalised_decoder: true,
                activated_fusion: false,
            },
        }
    }
}

/// The `[model]` table: everything that decides a network's shape and start.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct ModelConfig {
    /// Which network.
    pub variant: Variant,
    /// Which reading of the paper.
    pub reading: Reading,
    /// Base width C (64 in the paper): channels of the fusion sub-network, and the unit of `levels`.
    pub width: usize,
    /// Channels of each level as multiples of the base width, from the full resolution down; the latent has the last level's.
    pub levels: [usize; LEVELS],
    /// How the output convolution starts.
    pub head: Head,
    /// How the detail map starts.
    pub detail: Detail,
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
        }
    }
}

/// What a person calls it: `demc, paper reading, width 32`, and the levels where they are not the paper's.
impl fmt::Display for ModelConfig {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let (variant, reading) = (self.variant.spec().name, self.reading.spec().name);
        write!(f, "{variant}, {reading} reading, width {}", self.width)?;
        match self.levels {
            LEVEL_WIDTHS => Ok(()),
            _ => write!(f, ", levels of {:?}", self.level_channels()),
        }
    }
}

impl ModelConfig {
    /// Channels of each level, from the full resolution down.
    pub fn level_channels(&self) -> [usize; LEVELS] {
        self.levels.map(|factor| factor * self.width)
    }

    /// Every problem of the values, each as one line that begins with the key.
    pub fn validate(&self) -> Vec<String> {
        let mut problems = Vec::new();
        if !(1..=MAX_WIDTH).contains(&self.width) {
            let width = self.width;
            problems.push(format!(
                "model.width = {width}: must be from 1 to {MAX_WIDTH}"
            ));
        }
        if self.levels.iter().any(|of| !(1..=MAX_LEVEL).contains(of)) {
            let levels = self.levels;
            problems.push(format!(
                "model.levels = {levels:?}: each must be from 1 to {MAX_LEVEL}"
            ));
        }
        problems
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn names_in_files_are_those_of_the_tables() {
        for variant in Variant::ALL {
            let name = serde_json::to_value(variant).unwrap();
            assert_eq!(name, variant.spec().name);
        }
        for reading in Reading::ALL {
            let name = serde_json::to_value(reading).unwrap();
            assert_eq!(name, reading.spec().name);
        }
    }

    #[test]
    fn only_those_that_eat_a_detail_map_make_one() {
        let with: Vec<bool> = Variant::ALL.map(|v| v.spec().has_fusion()).to_vec();
        assert_eq!(with, [true, false, true, false]);
    }

    #[test]
    fn width_zero_is_a_problem() {
        let config = ModelConfig {
            width: 0,
            ..ModelConfig::default()
        };
        assert_eq!(config.validate().len(), 1);
    }

    #[test]
    fn its_name_tells_levels_that_are_not_the_papers() {
        let paper = ModelConfig::default();
        assert_eq!(paper.to_string(), "demc, paper reading, width 64");
        let narrow = ModelConfig {
            width: 3,
            levels: [1, 2, 2, 4, 1],
            ..paper
        };
        let expected = "demc, paper reading, width 3, levels of [3, 6, 6, 12, 3]";
        assert_eq!(narrow.to_string(), expected);
    }

    #[test]
    fn a_level_without_channels_is_a_problem() {
        for levels in [[1, 2, 0, 8, 8], [1, 2, 4, 8, 17]] {
            let config = ModelConfig {
                levels,
                ..ModelConfig::default()
            };
            let problems = config.validate();
            assert!(problems.len() == 1 && problems[0].starts_with("model.levels = ["));
        }
    }
}
