//! Conversions to the network's input space and back, as pure functions. Colour gets gamma (Eq. 4)
//! and optional albedo demodulation; features get Z-scores (Sec. 4.2). The parameters are measured
//! on the training scenes ([`crate::training::stats`]) or configured, and are stored with the weights.

use serde::{Deserialize, Deserializer, Serialize};

use crate::image::frame::{FEATURES, MAX_ALBEDO, POSITIONS, TEXTURES};
use crate::input::position::{PositionMap, PositionSpace};
use crate::input::transfer::Transfer;

/// Minimum standard deviation of a feature channel, in the channel's own unit (ours: the paper is
/// silent). It makes a constant channel zero instead of 0/0. 1e-3 is half precision's spacing at 1,
/// so smaller deviations of normals or textures are rounding.
pub const STD_FLOOR: f32 = 1e-3;

/// Largest factor on the colour, and the inverse of the smallest.
pub const MAX_INPUT_SCALE: f32 = 1e6;

/// Mean and standard deviation of each feature channel over the training scenes.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct FeatureStats {
    /// Means, in the channels' units.
    pub mean: [f32; FEATURES],
    /// Standard deviations, in the channels' units; at least [`STD_FLOOR`].
    pub std: [f32; FEATURES],
}

impl FeatureStats {
    /// These statistics, or for Open Image Denoise's curve the ranges that its networks expect: normals
    /// from 0 to 1, albedo as it is.
    pub fn with_ranges_of(mut self, transfer: Transfer) -> Self {
        if transfer == Transfer::Pu {
            self.mean[..POSITIONS].fill(-1.0);
            self.std[..POSITIONS].fill(2.0);
            self.mean[TEXTURES..].fill(0.0);
            self.std[TEXTURES..].fill(1.0);
        }
        self
    }
}

/// Converts colour and features to the network's input space and back.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Normalizer {
    /// The exponent of Eq. 4 is `1 / gamma`; 2.2 in the paper.
    pub gamma: f32,
    /// The curve between radiance and the network's colour.
    #[serde(default, skip_serializing_if = "Transfer::is_gamma")]
    pub transfer: Transfer,
    /// Epsilon of the [modulation](Self::modulation); `None`: colour is not divided. Files store it
    /// as `demodulate`, and 0 there means `None` (bundle format 1).
    #[serde(
        rename = "demodulate",
        default,
        deserialize_with = "none_if_zero",
        skip_serializing_if = "Option::is_none"
    )]
    pub albedo_demodulation_epsilon: Option<f32>,
    /// What the origin and the unit of positions are.
    #[serde(default, skip_serializing_if = "PositionSpace::is_scene")]
    pub position: PositionSpace,
    /// The [exposure](Transfer::exposure) that every image is scaled to before the network; the
    /// output is scaled back. `None`: images keep theirs.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub exposure_level: Option<f32>,
    /// Whether the output gets the light of the noisy image back.
    #[serde(default, skip_serializing_if = "std::ops::Not::not")]
    pub restore_light: bool,
    /// Mean and standard deviation for the Z-score.
    pub features: FeatureStats,
    /// The flat output with the least RelMSE (Eq. 5) against the training references, in gamma
    /// space. A grey head starts with it.
    pub flat_color: [f32; 3],
}

fn none_if_zero<'de, D: Deserializer<'de>>(number: D) -> Result<Option<f32>, D::Error> {
    f32::deserialize(number).map(|epsilon| (epsilon != 0.0).then_some(epsilon))
}

impl Normalizer {
    /// The mapping of an image's positions, which comes before the Z-score; `None` for
    /// [`PositionSpace::Scene`].
    ///
    /// # Shapes
    /// `features`, as rendered, is `[12, N]`: the whole image.
    pub fn position_map(&self, features: &[f32]) -> Option<PositionMap> {
        match self.position {
            PositionSpace::Scene => None,
            PositionSpace::Image => Some(PositionMap::of(features)),
        }
    }

    /// The divisor of the network's input colour and the factor on its output, in gamma space:
    /// `(clamp(albedo, 0, 1) + epsilon)^(1/gamma)`, with the albedo of the first hit (albedo
    /// demodulation: Bako et al. 2017 for diffuse light; ours here). `None` without an epsilon.
    ///
    /// # Shapes
    /// `features`, as rendered, is `[12, N]`; returns `[3, N]`.
    ///
    /// # Panics
    /// If the length is not a multiple of 12.
    pub fn modulation(&self, features: &[f32]) -> Option<Vec<f32>> {
        self.albedo_demodulation_epsilon?;
        assert_eq!(
            features.len() % FEATURES,
            0,
            "features must be [{FEATURES}, N]"
        );
        let size = features.len() / FEATURES;
        let mut texture = features[TEXTURES * size..(TEXTURES + 3) * size].to_vec();
        self.modulation_from_albedo(&mut texture);
        Some(texture)
    }

    /// As [`modulation`](Self::modulation), in place and for any part of the albedo. Without an epsilon
    /// nothing changes.
    pub fn modulation_from_albedo(&self, albedo: &mut [f32]) {
        let Some(epsilon) = self.albedo_demodulation_epsilon else {
            return;
        };
        for value in &mut *albedo {
            *value = value.clamp(0.0, MAX_ALBEDO) + epsilon;
        }
        Transfer::Gamma.compress(albedo, self.gamma);
    }

    /// Compresses linear radiance in place, in the paper to `max(x, 0)^(1/gamma)` (Eq. 4), and divides
    /// it by the [modulation](Self::modulation).
    pub fn compress(&self, color: &mut [f32], modulation: Option<&[f32]>) {
        self.transfer.compress(color, self.gamma);
        for (value, factor) in color.iter_mut().zip(modulation.into_iter().flatten()) {
            *value /= factor;
        }
    }

    /// Multiplies compressed colour by the [modulation](Self::modulation) and expands it to linear
    /// radiance, in place.
    pub fn expand(&self, color: &mut [f32], modulation: Option<&[f32]>) {
        for (value, factor) in color.iter_mut().zip(modulation.into_iter().flatten()) {
            *value *= factor;
        }
        self.transfer.expand(color, self.gamma);
    }

    /// Converts features to Z-scores in place: `(x - mean) / std`. Albedo above [`MAX_ALBEDO`]
    /// counts as that. With Open Image Denoise's curve, normals count from -1 to 1, albedo from 0.
    ///
    /// # Shapes
    /// `planes` is `[12, N]`.
    ///
    /// # Panics
    /// If the length is not a multiple of 12.
    pub fn features_z_from_raw(&self, planes: &mut [f32]) {
        let pixels = planes.len() / FEATURES;
        for value in &mut planes[TEXTURES * pixels..] {
            *value = value.min(MAX_ALBEDO);
        }
        if self.transfer == Transfer::Pu {
            let (normals, others) = planes.split_at_mut(POSITIONS * pixels);
            normals
                .iter_mut()
                .for_each(|value| *value = value.clamp(-1.0, 1.0));
            let albedo = &mut others[(TEXTURES - POSITIONS) * pixels..];
            albedo.iter_mut().for_each(|value| *value = value.max(0.0));
        }
        self.for_each_feature(planes, |value, mean, std| (value - mean) / std);
    }

    /// Undoes [`Self::features_z_from_raw`] in place.
    ///
    /// # Shapes
    /// `planes` is `[12, N]`.
    ///
    /// # Panics
    /// If the length is not a multiple of 12.
    pub fn features_raw_from_z(&self, planes: &mut [f32]) {
        self.for_each_feature(planes, |value, mean, std| value * std + mean);
    }

    fn for_each_feature(&self, planes: &mut [f32], map: impl Fn(f32, f32, f32) -> f32) {
        assert_eq!(
            planes.len() % FEATURES,
            0,
            "features must be [{FEATURES}, N]"
        );
        let (mean, std) = (&self.features.mean, &self.features.std);
        // A chunk size of 0 would panic; an empty slice has no chunks.
        let size = (planes.len() / FEATURES).max(1);
        for ((plane, &mean), &std) in planes.chunks_exact_mut(size).zip(mean).zip(std) {
            for value in plane {
                *value = map(*value, mean, std);
            }
        }
    }
}

/// The factor that brings an image of this exposure to `level`; 1 for a black image.
pub fn exposure_scale(level: f32, exposure: f64) -> f32 {
    let scale = f64::from(level) / exposure;
    if !scale.is_finite() {
        return 1.0;
    }
    let limit = f64::from(MAX_INPUT_SCALE);
    scale.clamp(1.0 / limit, limit) as f32
}

#[cfg(test)]
mod tests {
    use super::*;

    fn normalizer() -> Normalizer {
        let features = FeatureStats {
            mean: std::array::from_fn(|channel| channel as f32 - 5.5),
            std: std::array::from_fn(|channel| 0.25 * (channel + 1) as f32),
        };
        Normalizer {
            gamma: 2.2,
            albedo_demodulation_epsilon: None,
            position: PositionSpace::Scene,
            transfer: Transfer::Gamma,
            exposure_level: None,
            restore_light: false,
            features,
            flat_color: [0.4; 3],
        }
    }

    #[test]
    fn gamma_comes_back_to_the_radiance() {
        let hdr = [0.0, 1e-4, 0.18, 1.0, 9.9, 65504.0];
        let mut color = hdr;
        normalizer().compress(&mut color, None);
        normalizer().expand(&mut color, None);
        for (back, hdr) in color.into_iter().zip(hdr) {
            // f32 has 24 bits; two powers lose a few bits at large exponents.
            assert!((back - hdr).abs() <= 1e-5 * hdr, "{back} is not {hdr}");
        }
    }

    #[test]
    fn gamma_matches_a_hand_computed_value_and_keeps_the_ends() {
        let mut color = [0.5, 0.0, 1.0, -3.0];
        normalizer().compress(&mut color, None);
        assert!((color[0] - 0.729_740_1).abs() < 1e-6, "{}", color[0]);
        assert_eq!(color[1..], [0.0, 1.0, 0.0]);
    }

    /// An albedo of 0.43 under light of 2 becomes light of 2 after demodulation, and is restored
    /// exactly.
    #[test]
    fn an_albedo_is_divided_out_and_restored() {
        let normalizer = Normalizer {
            albedo_demodulation_epsilon: Some(0.07),
            ..normalizer()
        };
        let mut features = vec![9.0; FEATURES * 2];
        features[12..18].copy_from_slice(&[0.43, 0.0, 0.18, -1.0, 0.93, 0.0]);
        let modulation = normalizer.modulation(&features).expect("it is on");
        let light = [2.0, 0.5, 1.0, 0.3, 0.0, 4.0];
        let divisors = [0.5, 0.07, 0.25, 0.07, 1.0, 0.07];
        let hdr: Vec<f32> = light.iter().zip(divisors).map(|(a, b)| a * b).collect();
        let mut color = hdr.clone();
        normalizer.compress(&mut color, Some(&modulation));
        for (color, light) in color.iter().zip(light) {
            let expected = light.powf(1.0 / 2.2);
            assert!((color - expected).abs() < 1e-5, "{color} is not {expected}");
        }
        normalizer.expand(&mut color, Some(&modulation));
        for (back, hdr) in color.iter().zip(hdr) {
            assert!((back - hdr).abs() <= 1e-5 * hdr, "{back} is not {hdr}");
        }
    }

    #[test]
    fn without_demodulation_nothing_is_divided_and_nothing_is_written() {
        assert_eq!(normalizer().modulation(&[0.5; FEATURES]), None);
        let json = serde_json::to_string(&normalizer()).expect("plain data");
        assert!(!json.contains("demodulate"), "{json}");
    }

    #[test]
    fn z_scores_come_back_to_the_features() {
        let raw: Vec<f32> = (0..FEATURES * 5).map(|i| (i as f32 * 0.37).sin()).collect();
        let mut planes = raw.clone();
        normalizer().features_z_from_raw(&mut planes);
        assert_ne!(planes, raw);
        normalizer().features_raw_from_z(&mut planes);
        for (back, raw) in planes.into_iter().zip(raw) {
            assert!((back - raw).abs() < 1e-5, "{back} is not {raw}");
        }
    }

    #[test]
    fn each_channel_has_its_own_mean_and_deviation() {
        // Channel 5 has mean -0.5 and std 1.5, so 1 is one deviation above the mean.
        let mut planes = vec![0.0; FEATURES * 2];
        planes[10..12].copy_from_slice(&[1.0, -0.5]);
        normalizer().features_z_from_raw(&mut planes);
        assert_eq!(planes[10..12], [1.0, 0.0]);
        assert_eq!(planes[0], 5.5 / 0.25);
    }

    #[test]
    fn albedo_above_one_counts_as_one() {
        let normalizer = Normalizer {
            albedo_demodulation_epsilon: Some(0.07),
            ..normalizer()
        };
        let mut planes = vec![0.5; FEATURES];
        let mut bright = planes.clone();
        (planes[7], bright[7]) = (1.0, 91.0);
        assert_eq!(
            normalizer.modulation(&bright),
            normalizer.modulation(&planes)
        );
        for planes in [&mut planes, &mut bright] {
            normalizer.features_z_from_raw(planes);
        }
        assert_eq!(bright, planes);
    }

    #[test]
    fn statistics_survive_json() {
        for albedo_demodulation_epsilon in [None, Some(0.07)] {
            let normalizer = Normalizer {
                albedo_demodulation_epsilon,
                ..normalizer()
            };
            let json = serde_json::to_string(&normalizer).expect("plain data");
            let back = serde_json::from_str::<Normalizer>(&json).expect("its own");
            assert_eq!(back, normalizer);
        }
    }

    #[test]
    fn a_demodulate_of_zero_in_a_file_reads_as_none() {
        let json = serde_json::to_string(&normalizer()).expect("plain data");
        for (number, expected) in [("0.0", None), ("0", None), ("0.07", Some(0.07))] {
            let json = json.replacen('{', &format!("{{\"demodulate\":{number},"), 1);
            let read = serde_json::from_str::<Normalizer>(&json).expect("format 1");
            assert_eq!(read.albedo_demodulation_epsilon, expected);
        }
    }
}
