//! The input of KPCN and back, from the passes of a file (Bako et al. 2017, Sec. 5).
//!
//! Diffuse light is divided by the albedo, specular light becomes its logarithm. Their variances
//! follow: that of `f(x)` is `f'(x)^2` times that of `x`. A variance of three channels becomes that of
//! their luminance, as if they were independent.

use crate::image::frame::{DEPTH, FEATURES, MAX_ALBEDO, TEXTURES};
use crate::input::ranges::LUMINANCE;

pub use crate::image::frame::{LIGHT, PASS_PLANES, PASSES, REFERENCE_PASSES};

/// Added to the albedo before diffuse light is divided by it.
const ALBEDO_EPSILON: f32 = 0.00316;

/// Index of the first variances among the passes.
const VARIANCES: usize = DEPTH + 1;

/// The planes that the network takes as input.
#[derive(Debug, Clone, PartialEq)]
pub struct KpcnInput {
    /// Both parts of the light in the network's space, `[6, N]`.
    pub light: Vec<f32>,
    /// Normal, albedo, and depth; the variances of diffuse and specular light, normal, albedo, and
    /// depth: `[12, N]`.
    pub features: Vec<f32>,
    /// The divisor of diffuse light, `[3, N]`.
    pub divisor: Vec<f32>,
}

impl KpcnInput {
    /// The input for `passes` `[20, N]` in the order of [`PASSES`], and the features `[12, N]` of a
    /// frame, as rendered. `scale` multiplies the light.
    ///
    /// # Panics
    /// If a length does not fit.
    pub fn new(passes: &[f32], features: &[f32], scale: f32) -> Self {
        let pixels = passes.len() / PASS_PLANES;
        assert_eq!(passes.len(), PASS_PLANES * pixels, "passes");
        assert_eq!(features.len(), FEATURES * pixels, "features");
        let plane = |first: usize, count: usize| &passes[first * pixels..(first + count) * pixels];
        let divisor: Vec<f32> = features[TEXTURES * pixels..][..3 * pixels]
            .iter()
            .map(|albedo| albedo.clamp(0.0, MAX_ALBEDO) + ALBEDO_EPSILON)
            .collect();
        let mut light = plane(0, LIGHT).to_vec();
        light_from_radiance(&mut light, &divisor, scale);
        let mut planes = features[..3 * pixels].to_vec();
        planes.extend(divisor.iter().map(|divisor| divisor - ALBEDO_EPSILON));
        planes.extend_from_slice(plane(DEPTH, 1));
        let diffuse = plane(VARIANCES, 3).iter().zip(&divisor);
        let specular = plane(VARIANCES + 3, 3).iter().zip(plane(3, 3));
        let variances: [Vec<f32>; 2] = [
            diffuse
                .map(|(variance, divisor)| variance * (scale / divisor).powi(2))
                .collect(),
            specular
                .map(|(variance, light)| variance * (scale / (1.0 + scale * light)).powi(2))
                .collect(),
        ];
        for variance in &variances {
            planes.extend(variance_of_luminance(variance));
        }
        for first in [VARIANCES + 6, VARIANCES + 9] {
            planes.extend(variance_of_luminance(plane(first, 3)));
        }
        planes.extend_from_slice(plane(VARIANCES + 12, 1));
        Self {
            light,
            features: planes,
            divisor,
        }
    }
}

/// Converts both parts of radiance to the network's space, in place: diffuse light divided by
/// `divisor`, and `ln(1 + x)` of specular light. `scale` multiplies the radiance first.
///
/// # Shapes
/// `light` `[6, N]`, `divisor` `[3, N]`.
pub fn light_from_radiance(light: &mut [f32], divisor: &[f32], scale: f32) {
    let (diffuse, specular) = light.split_at_mut(divisor.len());
    for (value, divisor) in diffuse.iter_mut().zip(divisor) {
        *value = scale * *value / divisor;
    }
    for value in specular {
        *value = (scale * *value).ln_1p();
    }
}

/// The radiance of both parts in the network's space together, divided by `scale`; not negative.
///
/// # Shapes
/// `light` `[6, N]`, `divisor` `[3, N]`, to `[3, N]`.
pub fn radiance_from_light(light: &[f32], divisor: &[f32], scale: f32) -> Vec<f32> {
    let (diffuse, specular) = light.split_at(divisor.len());
    let parts = diffuse.iter().zip(divisor).zip(specular);
    parts
        .map(|((diffuse, divisor), specular)| {
            let sum = diffuse * divisor + specular.exp_m1();
            // NaN stays NaN, so that it is reported.
            if sum < 0.0 { 0.0 } else { sum / scale }
        })
        .collect()
}

/// Of independent channels.
fn variance_of_luminance(variances: &[f32]) -> Vec<f32> {
    let pixels = variances.len() / 3;
    let channels = |i: usize| (0..3).map(move |channel| channel * pixels + i);
    (0..pixels)
        .map(|i| {
            let weighted = channels(i).zip(LUMINANCE);
            weighted.map(|(at, y)| y * y * variances[at]).sum()
        })
        .collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    fn features(albedo: f32) -> Vec<f32> {
        let mut features = vec![0.25; FEATURES];
        features[TEXTURES..TEXTURES + 3].fill(albedo);
        features
    }

    #[test]
    fn the_light_comes_back() {
        let mut passes = vec![0.5; PASS_PLANES];
        passes[..LIGHT].copy_from_slice(&[0.3, 0.0, 9.0, 4.0, 0.0, 1e-3]);
        for scale in [1.0, 4.0] {
            let input = KpcnInput::new(&passes, &features(0.4), scale);
            let back = radiance_from_light(&input.light, &input.divisor, scale);
            for (channel, found) in back.into_iter().enumerate() {
                let expected = passes[channel] + passes[3 + channel];
                assert!(
                    (found - expected).abs() < 1e-5 * (1.0 + expected),
                    "{found}"
                );
            }
        }
    }

    #[test]
    fn planes_agree_with_a_calculation_by_hand() {
        let mut passes = vec![0.0; PASS_PLANES];
        passes[..LIGHT].copy_from_slice(&[1.0, 1.0, 1.0, 3.0, 3.0, 3.0]);
        passes[DEPTH] = 0.7;
        passes[VARIANCES..VARIANCES + 6].fill(2.0);
        passes[VARIANCES + 12] = 0.01;
        let input = KpcnInput::new(&passes, &features(2.0), 1.0);
        let divisor = 1.0 + ALBEDO_EPSILON;
        assert_eq!(input.divisor, [divisor; 3]);
        assert_eq!(input.light[0], 1.0 / divisor);
        assert_eq!(input.light[3], 4f32.ln());
        let squares: f32 = LUMINANCE.iter().map(|y| y * y).sum();
        let expected = [
            0.25,
            0.25,
            0.25,
            1.0,
            1.0,
            1.0,
            0.7,
            2.0 * squares / (divisor * divisor),
            2.0 * squares / 16.0,
            0.0,
            0.0,
            0.01,
        ];
        for (found, expected) in input.features.iter().zip(expected) {
            assert!((found - expected).abs() < 1e-6, "{:?}", input.features);
        }
    }

    #[test]
    fn the_number_of_planes_is_that_of_the_passes() {
        let planes = |passes: &[(&str, usize)]| passes.iter().map(|pass| pass.1).sum::<usize>();
        assert_eq!(planes(&PASSES), PASS_PLANES);
        assert_eq!(planes(&REFERENCE_PASSES), LIGHT);
    }
}
