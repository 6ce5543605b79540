//! The network's input space and the way back, as pure functions: gamma on colour (Eq. 4), Z-score on
//! features (Sec. 4.2). Their numbers are measured on the training scenes ([`crate::stats`]) and live with
//! the weights.

use serde::{Deserialize, Serialize};

use crate::frame::FEATURES;

/// Smallest standard deviation of a feature channel, in the channel's own unit (ours: the paper is silent).
/// A constant channel becomes zero instead of 0/0; 1e-3 is half precision's spacing at 1, so what falls
/// below it in a normal or a texture is rounding, not signal.
pub const STD_FLOOR: f32 = 1e-3;

/// Mean and standard deviation of each feature channel over the training scenes.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct FeatureStats {
    /// Means, in the channels' units.
    pub mean: [f32; FEATURES],
    /// Standard deviations, in the channels' units; at least [`STD_FLOOR`].
    pub std: [f32; FEATURES],
}

/// Takes colour and features to the network's space and back.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Normalizer {
    /// The exponent of Eq. 4 is `1 / gamma`; 2.2 in the paper.
    pub gamma: f32,
    /// What the Z-score subtracts and divides by.
    pub features: FeatureStats,
    /// The flat image with the least RelMSE (Eq. 5) against the training references, in gamma space: where a
    /// grey head starts.
    pub flat_color: [f32; 3],
}

impl Normalizer {
    /// Compresses linear radiance in place: `max(x, 0)^(1/gamma)` (Eq. 4).
    pub fn color_gamma_from_hdr(&self, color: &mut [f32]) {
        gamma_from_hdr(color, self.gamma);
    }

    /// Expands gamma-compressed colour in place: `max(x, 0)^gamma`.
    pub fn color_hdr_from_gamma(&self, color: &mut [f32]) {
        for value in color {
            *value = value.max(0.0).powf(self.gamma);
        }
    }

    /// Z-scores features in place: `(x - mean) / std`.
    ///
    /// # Shapes
    /// `planes` is `[12, N]`.
    ///
    /// # Panics
    /// If the length is no multiple of 12.
    pub fn features_z_from_raw(&self, planes: &mut [f32]) {
        self.for_each_feature(planes, |value, mean, std| (value - mean) / std);
    }

    /// Undoes [`Self::features_z_from_raw`] in place.
    ///
    /// # Shapes
    /// `planes` is `[12, N]`.
    ///
    /// # Panics
    /// If the length is no multiple of 12.
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
        // A size of 0 would have no chunks: an empty slice has none either way.
        let size = (planes.len() / FEATURES).max(1);
        for ((plane, &mean), &std) in planes.chunks_exact_mut(size).zip(mean).zip(std) {
            for value in plane {
                *value = map(*value, mean, std);
            }
        }
    }
}

/// Compresses linear radiance in place: `max(x, 0)^(1/gamma)` (Eq. 4).
pub fn gamma_from_hdr(color: &mut [f32], gamma: f32) {
    let exponent = 1.0 / gamma;
    for value in color {
        *value = value.max(0.0).powf(exponent);
    }
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
            features,
            flat_color: [0.4; 3],
        }
    }

    #[test]
    fn gamma_comes_back_to_the_radiance() {
        let hdr = [0.0, 1e-4, 0.18, 1.0, 9.9, 65504.0];
        let mut color = hdr;
        normalizer().color_gamma_from_hdr(&mut color);
        normalizer().color_hdr_from_gamma(&mut color);
        for (back, hdr) in color.into_iter().zip(hdr) {
            // f32 has 24 bits; two powers lose a few at large exponents.
            assert!((back - hdr).abs() <= 1e-5 * hdr, "{back} is not {hdr}");
        }
    }

    #[test]
    fn gamma_matches_a_hand_computed_value_and_keeps_the_ends() {
        let mut color = [0.5, 0.0, 1.0, -3.0];
        normalizer().color_gamma_from_hdr(&mut color);
        assert!((color[0] - 0.729_740_1).abs() < 1e-6, "{}", color[0]);
        assert_eq!(color[1..], [0.0, 1.0, 0.0]);
    }

    #[test]
    fn z_scores_come_back_to_the_features() {
        let raw: Vec<f32> = (0..FEATURES * 5)
            .map(|i| (i as f32 * 0.37).sin() * 3.0)
            .collect();
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
        // The last channel: mean 5.5, std 3; 8.5 is one deviation above the mean.
        let mut planes = vec![0.0; FEATURES * 2];
        planes[22..].copy_from_slice(&[8.5, 5.5]);
        normalizer().features_z_from_raw(&mut planes);
        assert_eq!(planes[22..], [1.0, 0.0]);
        assert_eq!(planes[0], 5.5 / 0.25);
    }

    #[test]
    fn statistics_survive_json() {
        let json = serde_json::to_string(&normalizer()).expect("plain data");
        assert_eq!(
            serde_json::from_str::<Normalizer>(&json).expect("its own"),
            normalizer()
        );
    }
}
