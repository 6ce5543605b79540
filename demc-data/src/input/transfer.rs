//! Transfer functions: linear radiance to the network's colour and back.
//!
//! Open Image Denoise (OIDN) 2 compresses radiance with a perceptually uniform curve (PU), after it has
//! scaled the image to an exposure. Its networks expect both.

use demc_kernels::pu::{self, PEAK};
use serde::{Deserialize, Serialize};

use crate::input::ranges;

/// Sides of the bins, in pixels, over which OIDN averages the luminance. They are a little smaller where
/// they do not divide the image.
const BIN: usize = 16;
/// OIDN leaves out darker bins.
const BLACK: f64 = 1e-8;
/// OIDN's luminance of red, green, and blue.
const LUMINANCE: [f32; 3] = [0.212_671, 0.715_160, 0.072_169];

/// The curve between linear radiance and the network's colour.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Transfer {
    /// `x^(1/gamma)` (Eq. 4).
    #[default]
    Gamma,
    /// OIDN's curve, which is 1 at 65504.
    Pu,
}

impl Transfer {
    /// Whether this is the paper's.
    pub fn is_gamma(&self) -> bool {
        *self == Transfer::Gamma
    }

    /// The exposure of planar colour `[3, H, W]`, linear HDR, as [`Normalizer::exposure_level`](crate::Normalizer)
    /// counts it. It is that of [`ranges::exposure`], or OIDN's: the geometric mean of the luminance of bins.
    /// A black image has 0.
    ///
    /// # Panics
    /// If the colour does not have `height` x `width` pixels.
    pub fn exposure(self, color_hdr: &[f32], height: usize, width: usize) -> f64 {
        assert_eq!(
            color_hdr.len(),
            3 * height * width,
            "[3, {height}, {width}]"
        );
        match self {
            Transfer::Gamma => ranges::exposure(color_hdr),
            Transfer::Pu => exposure_of_bins(color_hdr, height, width),
        }
    }

    /// Compresses linear radiance in place. What is below 0 counts as 0.
    pub fn compress(self, color: &mut [f32], gamma: f32) {
        match self {
            Transfer::Gamma => {
                let exponent = 1.0 / gamma;
                for value in color {
                    *value = value.max(0.0).powf(exponent);
                }
            }
            Transfer::Pu => {
                let scale = 1.0 / pu::value(PEAK);
                for value in color {
                    *value = scale * pu::value(value.max(0.0));
                }
            }
        }
    }

    /// The compressed value of one radiance that is not negative.
    pub(crate) fn compressed(self, radiance: f64, gamma: f32) -> f32 {
        match self {
            Transfer::Gamma => radiance.powf(1.0 / f64::from(gamma)) as f32,
            Transfer::Pu => pu::value(radiance as f32) / pu::value(PEAK),
        }
    }

    /// Undoes [`compress`](Self::compress) in place. What is below 0 counts as 0.
    pub fn expand(self, color: &mut [f32], gamma: f32) {
        match self {
            Transfer::Gamma => {
                for value in color {
                    *value = value.max(0.0).powf(gamma);
                }
            }
            Transfer::Pu => {
                let scale = pu::value(PEAK);
                for value in color {
                    *value = pu::inverse(scale * value.max(0.0));
                }
            }
        }
    }
}

fn exposure_of_bins(color_hdr: &[f32], height: usize, width: usize) -> f64 {
    let pixels = height * width;
    let luminance = |pixel: usize| {
        let channels = LUMINANCE.iter().enumerate();
        let sum: f32 = channels
            .map(|(channel, share)| share * color_hdr[channel * pixels + pixel].max(0.0))
            .sum();
        f64::from(sum)
    };
    let edges = |length: usize| {
        let count = length.div_ceil(BIN);
        (0..count).map(move |bin| bin * length / count..(bin + 1) * length / count)
    };
    let (mut sum, mut count) = (0.0, 0);
    for rows in edges(height) {
        for columns in edges(width) {
            let pixels = rows.clone().flat_map(|y| {
                let row = y * width;
                columns.clone().map(move |x| row + x)
            });
            let mean = pixels.map(luminance).sum::<f64>() / (rows.len() * columns.len()) as f64;
            if mean > BLACK {
                sum += mean.log2();
                count += 1;
            }
        }
    }
    if count == 0 {
        0.0
    } else {
        (sum / f64::from(count)).exp2()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Values of `pu(y) / pu(65504)` from OIDN's formula in double precision.
    #[test]
    fn the_curve_has_oidns_values_and_comes_back() {
        let radiance = [0.0, 1e-6, 1e-3, 0.02, 0.18, 1.0, 40.0, 65504.0];
        let mut color = radiance;
        Transfer::Pu.compress(&mut color, 2.2);
        let expected = [
            0.0,
            0.000450648806,
            0.0257305521,
            0.0961681427,
            0.215253423,
            0.318910523,
            0.545218511,
            1.0,
        ];
        for (found, expected) in color.into_iter().zip(expected) {
            assert!(
                (f64::from(found) - expected).abs() < 1e-6,
                "{found} {expected}"
            );
        }
        Transfer::Pu.expand(&mut color, 2.2);
        for (back, radiance) in color.into_iter().zip(radiance) {
            assert!(
                (back - radiance).abs() <= 2e-5 * radiance,
                "{back} {radiance}"
            );
        }
    }

    #[test]
    fn the_exposure_is_the_geometric_mean_of_bins() {
        // Two bins of 16x16: luminance 0.5 and 2, so 1.
        let plane: Vec<f32> = (0..16 * 32)
            .map(|i| if i % 32 < 16 { 0.5 } else { 2.0 })
            .collect();
        let found = Transfer::Pu.exposure(&plane.repeat(3), 16, 32);
        assert!((found - 1.0).abs() < 1e-6, "{found}");
        // A black bin does not count.
        let plane: Vec<f32> = plane
            .iter()
            .map(|v| if *v > 1.0 { 0.0 } else { *v })
            .collect();
        let found = Transfer::Pu.exposure(&plane.repeat(3), 16, 32);
        assert!((found - 0.5).abs() < 1e-6, "{found}");
        assert_eq!(Transfer::Pu.exposure(&[0.0; 3 * 5 * 7], 5, 7), 0.0);
    }

    /// 20 rows are two bins of 10.
    #[test]
    fn bins_share_the_pixels_evenly() {
        let plane: Vec<f32> = (0..20 * 3)
            .map(|i| if i < 10 * 3 { 0.25 } else { 4.0 })
            .collect();
        let found = Transfer::Pu.exposure(&plane.repeat(3), 20, 3);
        assert!((found - 1.0).abs() < 1e-6, "{found}");
    }
}
