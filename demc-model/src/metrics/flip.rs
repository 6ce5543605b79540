//! LDR-FLIP: "FLIP: A Difference Evaluator for Alternating Images", Andersson et al., HPG 2020.
//!
//! Both images are filtered by the contrast sensitivity of an eye at 67 pixels per degree and
//! compared by colour. Edges and points that appear or vanish raise the difference.
//!
//! The crate around NVIDIA's C++ (`nv-flip` 0.1.2) takes 8 bits per channel and needs a C++17
//! compiler, so this is an implementation of ours. The tests compare it with NVIDIA's Python
//! package.

use rayon::prelude::*;

use super::color::{hunt_lab_from_linear, hyab};
use super::image::Image;

/// Exponent of the colour difference. The exponent of the feature difference is 1/2.
const COLOR_POWER: f32 = 0.7;
/// Colour differences up to this share of the largest map to errors up to [`KNEE_VALUE`].
const KNEE: f32 = 0.4;
/// The error at [`KNEE`].
const KNEE_VALUE: f32 = 0.95;

/// Mean `flip` of an image, 0 to 1.
///
/// # Panics
/// If the sizes differ.
pub fn flip(candidate: &Image, reference: &Image) -> f64 {
    candidate.assert_size_of(reference);
    let (a, b) = (candidate.appearance(), reference.appearance());
    let largest = hyab(
        hunt_lab_from_linear([0.0, 1.0, 0.0]),
        hunt_lab_from_linear([0.0, 0.0, 1.0]),
    )
    .powf(COLOR_POWER);
    let knee = KNEE * largest;
    let colors = a.lab.par_iter().zip(&b.lab);
    let features = a.features.par_iter().zip(&b.features);
    let errors: Vec<f32> = colors
        .zip(features)
        .map(|((&x, &y), (&[edge_x, point_x], &[edge_y, point_y]))| {
            let distance = hyab(x, y).powf(COLOR_POWER);
            let color = if distance < knee {
                distance * KNEE_VALUE / knee
            } else {
                KNEE_VALUE + (distance - knee) / (largest - knee) * (1.0 - KNEE_VALUE)
            };
            let difference = (edge_x - edge_y).abs().max((point_x - point_y).abs());
            let feature = (difference / 2.0_f32.sqrt()).sqrt();
            color.powf(1.0 - feature)
        })
        .collect();
    errors.iter().map(|e| f64::from(*e)).sum::<f64>() / errors.len() as f64
}

#[cfg(test)]
mod tests {
    use super::*;

    fn constant(value: f32) -> Vec<f32> {
        vec![value; 3 * 30 * 40]
    }

    #[test]
    fn flip_is_zero_for_equal_images_and_nearly_one_for_black_and_white() {
        let (black, white) = (constant(0.0), constant(1.0));
        let image = |hdr| Image::new(hdr, 30, 40).expect("finite");
        let (black, white) = (image(&black), image(&white));
        assert_eq!(flip(&white, &white), 0.0);
        // 100^0.7 = 25.1 of 41.3, above the knee of 0.4: 0.95 + (25.1 - 16.5) / 24.8 * 0.05 =
        // 0.967.
        let found = flip(&black, &white);
        assert!((found - 0.967).abs() < 0.002, "{found}");
        assert!((flip(&white, &black) - found).abs() < 1e-6);
    }
}
