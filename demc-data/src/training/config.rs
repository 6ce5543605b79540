//! The `[data]` table of a run's configuration.

use std::path::PathBuf;

use serde::{Deserialize, Serialize};

use crate::input::position::PositionSpace;
use crate::input::preparation::Preparation;
use crate::input::transfer::Transfer;
use crate::training::augment::Augment;
use crate::training::dropout::Dropout;

/// The committed sample data, so that every configuration runs without an edit.
const ROOT: &str = "data/sample";
/// The layout of this project's own files.
const LAYOUT: &str = "demc-exr";
/// "We set patch size as 128 x 128" (Sec. 4.2).
pub(crate) const PATCH_SIZE: usize = 128;
/// "... and stride as 80" (Sec. 4.2).
const STRIDE: usize = 80;
/// Eq. 4.
const GAMMA: f32 = 2.2;
/// Ours: the paper gives none; 64 fits its schedule, time and memory.
const BATCH_SIZE: usize = 64;
/// Ours: a tenth of the base scenes of the training split.
const VALIDATION: f64 = 0.1;
/// Ours: holds the paper's 97 scenes of 1280x720 (3.8 GB) and leaves half of 8 GiB.
const CACHE_MIB: usize = 4096;
/// Ours: one thread is fast enough for training on a CPU.
const WORKERS: usize = 1;

/// A smaller epsilon amplifies the colour of black surfaces; a larger one exceeds the albedo of
/// white.
const ALBEDO_EPSILONS: std::ops::RangeInclusive<f32> = 1e-3..=1.0;
/// Eq. 5 has an epsilon of 0.001 for radiance of order 1; a level outside is a mistake.
const EXPOSURE_LEVELS: std::ops::RangeInclusive<f32> = 1e-3..=10.0;
/// Below 1, `y^gamma` and the loss have an infinite slope at black; a value above 6 is a mistake.
const GAMMAS: std::ops::RangeInclusive<f32> = 1.0..=6.0;
/// The network halves its input five times, so patch sizes are multiples of this (Fig. 3).
pub(crate) const PATCH_MULTIPLE: usize = 32;
/// A longer side is a mistake: the paper's scenes are 1280x720.
pub(crate) const MAX_PATCH_SIZE: usize = 4096;
/// More patches than this are a mistake: at the paper's patch size their features are 52 GB.
const MAX_BATCH_SIZE: usize = 65536;
/// 16 TiB. A larger value is a mistake and could overflow a `usize` in bytes.
const MAX_CACHE_MIB: usize = 1 << 24;
/// More threads than this are a mistake.
const MAX_WORKERS: usize = 64;

/// The training data and its division into patches and batches.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct DataConfig {
    /// Directory of the data set (with `manifest.json`); relative to the current directory.
    pub root: PathBuf,
    /// Channel layout: a preset or a TOML file ([`crate::image::layout::ChannelLayout::resolve`]).
    pub layout: String,
    /// Side of a patch in pixels, a multiple of 32 up to 4096.
    pub patch_size: usize,
    /// Distance between patches in pixels.
    pub stride: usize,
    /// The transfer function's exponent is `1 / gamma` (Eq. 4); from 1 to 6.
    pub gamma: f32,
    /// `"gamma"`: the network's colour is `x^(1/gamma)`, as in the paper; `"pu"`: it has Open Image
    /// Denoise's curve, and normals and albedo have its ranges.
    pub transfer: Transfer,
    /// Albedo demodulation divides the input colour by (albedo + epsilon) and multiplies the output
    /// by it ([`crate::input::transform::Normalizer::modulation`]). From 0.001 to 1; absent: off, as in the paper.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub albedo_demodulation_epsilon: Option<f32>,
    /// `"scene"`: positions as rendered, as in the paper; `"image"`: relative to the image
    /// ([`crate::input::position::PositionMap`]).
    pub position: PositionSpace,
    /// Every image is scaled to this exposure ([`Transfer::exposure`]) before the network, and back
    /// afterwards. From 0.001 to 10; absent: images keep their exposure, as in the paper.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub exposure_level: Option<f32>,
    /// Whether denoising gives the output the light of the noisy image; off in the paper. Training does
    /// not see it, validation does.
    pub restore_light: bool,
    /// Probabilities that a patch lacks a feature buffer; 0 in the paper.
    #[serde(skip_serializing_if = "Dropout::is_off")]
    pub dropout: Dropout,
    /// Patches in a batch, at most 65536.
    pub batch_size: usize,
    /// Share of the training split's base scenes held out for validation, from 0 to below 1.
    pub validation: f64,
    /// Augmentations: a list of `"flip"`, `"transpose"`, `"rgb"`, `"exposure"`, `"axes"`, `"crop"`
    /// and `"noise"`; empty: none, as in the paper.
    pub augment: Augment,
    /// Memory for decoded scenes, in MiB, at most 2^24.
    pub cache_mib: usize,
    /// Threads that decode scenes and cut patches; the batches do not depend on their number.
    pub workers: usize,
}

impl Default for DataConfig {
    /// The paper's settings on the sample data.
    fn default() -> Self {
        Self {
            root: ROOT.into(),
            layout: LAYOUT.to_owned(),
            patch_size: PATCH_SIZE,
            stride: STRIDE,
            gamma: GAMMA,
            transfer: Transfer::Gamma,
            albedo_demodulation_epsilon: None,
            position: PositionSpace::Scene,
            exposure_level: None,
            restore_light: false,
            dropout: Dropout::default(),
            batch_size: BATCH_SIZE,
            validation: VALIDATION,
            augment: Augment::default(),
            cache_mib: CACHE_MIB,
            workers: WORKERS,
        }
    }
}

impl DataConfig {
    /// What happens to a whole image before patches are cut from it.
    pub fn preparation(&self) -> Preparation {
        Preparation {
            position: self.position,
            exposure_level: self.exposure_level,
            transfer: self.transfer,
        }
    }

    /// Every value out of range, as `data.key = value: must be ...`; empty if all values are valid.
    pub fn validate(&self) -> Vec<String> {
        let mut problems = Vec::new();
        let mut require = |holds: bool, key: &str, value: &dyn std::fmt::Debug, allowed: &str| {
            if !holds {
                problems.push(format!("data.{key} = {value:?}: must be {allowed}"));
            }
        };
        let (has_root, has_layout) = (!self.root.as_os_str().is_empty(), !self.layout.is_empty());
        require(has_root, "root", &self.root, "the directory of a data set");
        require(
            has_layout,
            "layout",
            &self.layout,
            "a preset or a TOML file",
        );
        require(
            (PATCH_MULTIPLE..=MAX_PATCH_SIZE).contains(&self.patch_size)
                && self.patch_size.is_multiple_of(PATCH_MULTIPLE),
            "patch_size",
            &self.patch_size,
            "a positive multiple of 32, at most 4096",
        );
        require(self.stride > 0, "stride", &self.stride, "at least 1");
        require(
            GAMMAS.contains(&self.gamma),
            "gamma",
            &self.gamma,
            "from 1 to 6",
        );
        if let Some(epsilon) = self.albedo_demodulation_epsilon {
            require(
                ALBEDO_EPSILONS.contains(&epsilon),
                "albedo_demodulation_epsilon",
                &epsilon,
                "from 0.001 to 1; remove the key to switch demodulation off",
            );
        }
        require(
            self.transfer.is_gamma() || self.albedo_demodulation_epsilon.is_none(),
            "transfer",
            &self.transfer,
            "\"gamma\" with data.albedo_demodulation_epsilon",
        );
        if let Some(level) = self.exposure_level {
            require(
                EXPOSURE_LEVELS.contains(&level),
                "exposure_level",
                &level,
                "from 0.001 to 10; remove the key to keep each image's exposure",
            );
        }
        for (key, probability) in self.dropout.probabilities() {
            require(
                (0.0..=1.0).contains(&probability),
                key,
                &probability,
                "a probability from 0 to 1",
            );
        }
        require(
            (1..=MAX_BATCH_SIZE).contains(&self.batch_size),
            "batch_size",
            &self.batch_size,
            "from 1 to 65536",
        );
        require(
            (0.0..1.0).contains(&self.validation),
            "validation",
            &self.validation,
            "from 0 to below 1",
        );
        require(
            self.cache_mib <= MAX_CACHE_MIB,
            "cache_mib",
            &self.cache_mib,
            "at most 16777216 (16 TiB)",
        );
        require(
            (1..=MAX_WORKERS).contains(&self.workers),
            "workers",
            &self.workers,
            "from 1 to 64",
        );
        problems
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn defaults_are_the_papers_and_valid() {
        let config: DataConfig = toml::from_str("").expect("every key has a default");
        assert_eq!(config, DataConfig::default());
        assert_eq!(
            (
                config.patch_size,
                config.stride,
                config.gamma,
                config.batch_size
            ),
            (128, 80, 2.2, 64)
        );
        assert!(config.validate().is_empty());
    }

    #[test]
    fn all_problems_are_found_at_once() {
        let config = DataConfig {
            patch_size: 100,
            stride: 0,
            gamma: f32::NAN,
            albedo_demodulation_epsilon: Some(1e-9),
            batch_size: 0,
            validation: 1.0,
            workers: 0,
            ..DataConfig::default()
        };
        let problems = config.validate();
        assert_eq!(problems.len(), 7, "{problems:?}");
        assert_eq!(
            problems[0],
            "data.patch_size = 100: must be a positive multiple of 32, at most 4096"
        );
    }

    #[test]
    fn upper_bounds_hold_and_are_allowed_themselves() {
        let sized = |more: usize| DataConfig {
            patch_size: MAX_PATCH_SIZE + 32 * more,
            batch_size: MAX_BATCH_SIZE + more,
            cache_mib: MAX_CACHE_MIB + more,
            gamma: 6.0 + more as f32,
            albedo_demodulation_epsilon: Some(1.0 + more as f32),
            ..DataConfig::default()
        };
        assert_eq!(sized(0).validate(), Vec::<String>::new());
        let problems = sized(1).validate();
        assert_eq!(problems.len(), 5, "{problems:?}");
    }

    #[test]
    fn unknown_keys_are_refused_and_known_ones_survive() {
        assert!(toml::from_str::<DataConfig>("patchsize = 64").is_err());
        assert!(toml::from_str::<DataConfig>("demodulate = 0.07").is_err());
        let text = "albedo_demodulation_epsilon = 0.07\nroot = \"x\"\nstride = 40\naugment = [\"flip\"]\nvalidation = 0.0";
        let config: DataConfig = toml::from_str(text).expect("known keys");
        assert_eq!(config.stride, 40);
        assert_eq!(config.albedo_demodulation_epsilon, Some(0.07));
        let written = toml::to_string(&config).expect("plain data");
        assert_eq!(
            toml::from_str::<DataConfig>(&written).expect("its own"),
            config
        );
    }
}
