//! Errors relative to the reference's own value, in linear HDR and float64.

use super::image::Image;

/// Epsilon of Eq. 5.
pub const LOSS_EPSILON: f32 = 0.001;

/// Number of pixels at each edge that `relmse@sbmc` leaves out, as SBMC's evaluation does.
const SBMC_BORDER: usize = 21;
/// `relmse-trimmed` leaves out one pixel in this number.
const TRIMMED: usize = 1000;
/// Luminance weights of linear Rec. 709.
const LUMINANCE: [f64; 3] = [0.2126, 0.7152, 0.0722];

/// `relmse` (Eq. 5).
///
/// # Panics
/// If the sizes differ; this holds for all functions of two images here.
pub fn rel_mse(candidate: &Image, reference: &Image) -> f64 {
    candidate.assert_size_of(reference);
    rel_mse_image(candidate.hdr(), reference.hdr())
}

/// `relmse` of an image (Eq. 5, epsilon 0.001), in float64.
///
/// # Shapes
/// Two planar `[3, H, W]` in linear HDR.
///
/// # Panics
/// If the lengths differ or are not three planes.
pub fn rel_mse_image(candidate_hdr: &[f32], reference_hdr: &[f32]) -> f64 {
    assert_eq!(
        candidate_hdr.len(),
        reference_hdr.len(),
        "images of one size"
    );
    assert_eq!(reference_hdr.len() % 3, 0, "three planes");
    3.0 * mean(candidate_hdr, reference_hdr, squared(LOSS_EPSILON.into()))
}

/// `relmse@afgsa`: half the mean over values, epsilon 0.01.
pub fn rel_mse_afgsa(candidate: &Image, reference: &Image) -> f64 {
    candidate.assert_size_of(reference);
    0.5 * mean(candidate.hdr(), reference.hdr(), squared(0.01))
}

/// `relmse@sbmc`: mean over values inside a border of 21 pixels, epsilon 0.0001; `None` if no pixel
/// is inside.
pub fn rel_mse_sbmc(candidate: &Image, reference: &Image) -> Option<f64> {
    candidate.assert_size_of(reference);
    let (height, width) = reference.size();
    let inner = |side: usize| side.checked_sub(2 * SBMC_BORDER).filter(|s| *s > 0);
    let (rows, columns) = (inner(height)?, inner(width)?);
    let term = squared(1e-4);
    let row = |c: usize, y: usize| {
        let start = (c * height + y + SBMC_BORDER) * width + SBMC_BORDER;
        let part = start..start + columns;
        let pairs = candidate.hdr()[part.clone()]
            .iter()
            .zip(&reference.hdr()[part]);
        pairs.map(|(&c, &r)| term(c.into(), r.into())).sum::<f64>()
    };
    let all = (0..3).flat_map(|c| (0..rows).map(move |y| (c, y)));
    let sum: f64 = all.map(|(c, y)| row(c, y)).sum();
    Some(sum / (3 * rows * columns) as f64)
}

/// `mrse@pbrt`: mean over values of `(c - r)^2 / (r + 0.01)^2`. pbrt skips infinite pixels; an
/// [`Image`] has none.
pub fn mrse_pbrt(candidate: &Image, reference: &Image) -> f64 {
    candidate.assert_size_of(reference);
    mean(candidate.hdr(), reference.hdr(), |c, r| {
        ((c - r) / (r + 0.01)).powi(2)
    })
}

/// `relmse-trimmed`: `relmse` without the worst pixels, one in 1000, rounded down.
pub fn rel_mse_trimmed(candidate: &Image, reference: &Image) -> f64 {
    let mut errors: Vec<f64> = rel_mse_map(candidate, reference);
    let kept = errors.len() - errors.len() / TRIMMED;
    if kept < errors.len() {
        errors.select_nth_unstable_by(kept, f64::total_cmp);
    }
    errors[..kept].iter().sum::<f64>() / kept as f64
}

/// `smape`: mean over values of `|c - r| / (|c| + |r| + 0.01)`.
pub fn smape(candidate: &Image, reference: &Image) -> f64 {
    candidate.assert_size_of(reference);
    mean(candidate.hdr(), reference.hdr(), |c, r| {
        (c - r).abs() / (c.abs() + r.abs() + 0.01)
    })
}

/// `energy-bias`: mean luminance divided by that of the reference, minus 1; `None` for a black
/// reference.
pub fn energy_bias(candidate: &Image, reference: &Image) -> Option<f64> {
    candidate.assert_size_of(reference);
    let luminance = |image: &Image| -> f64 {
        let planes = image.hdr().chunks(image.pixels()).zip(LUMINANCE);
        planes
            .map(|(plane, weight)| weight * plane.iter().map(|x| f64::from(*x)).sum::<f64>())
            .sum()
    };
    let expected = luminance(reference);
    (expected > 0.0).then(|| luminance(candidate) / expected - 1.0)
}

/// The error of each pixel. Its mean is `relmse`.
///
/// # Shapes
/// `[H, W]`.
pub fn rel_mse_map(candidate: &Image, reference: &Image) -> Vec<f64> {
    candidate.assert_size_of(reference);
    let pixels = reference.pixels();
    let term = squared(LOSS_EPSILON.into());
    let (c, r) = (candidate.hdr(), reference.hdr());
    let error = |i: usize| term(c[i].into(), r[i].into());
    (0..pixels)
        .map(|i| error(i) + error(pixels + i) + error(2 * pixels + i))
        .collect()
}

/// `(c - r)^2 / (r^2 + epsilon)`.
fn squared(epsilon: f64) -> impl Fn(f64, f64) -> f64 {
    move |c, r| (c - r).powi(2) / (r * r + epsilon)
}

fn mean(candidate: &[f32], reference: &[f32], term: impl Fn(f64, f64) -> f64) -> f64 {
    let pairs = candidate.iter().zip(reference);
    let sum: f64 = pairs.map(|(&c, &r)| term(c.into(), r.into())).sum();
    sum / reference.len() as f64
}

#[cfg(test)]
mod tests {
    use super::*;

    fn image(hdr: &[f32], height: usize, width: usize) -> Image<'_> {
        Image::new(hdr, height, width).expect("finite")
    }

    #[test]
    fn rel_mse_sums_over_channels_and_divides_by_pixels() {
        // Two pixels with errors of 1 and references of 1: six terms of 1 / 1.001 over two pixels.
        let (candidate, reference) = ([2.0; 6], [1.0; 6]);
        let expected = 3.0 / 1.001;
        assert!((rel_mse_image(&candidate, &reference) - expected).abs() < 1e-6);
    }

    #[test]
    fn relmse_of_a_black_image_is_nearly_three() {
        assert!((rel_mse_image(&[0.0; 12], &[10.0; 12]) - 3.0).abs() < 1e-4);
    }

    #[test]
    fn constant_images_give_hand_computed_values() {
        let (c, r) = ([3.0; 3 * 50 * 50], [1.0; 3 * 50 * 50]);
        let (c, r) = (image(&c, 50, 50), image(&r, 50, 50));
        let near = |found: f64, expected: f64| {
            assert!((found - expected).abs() < 1e-12, "{found} {expected}")
        };
        near(rel_mse_afgsa(&c, &r), 0.5 * 4.0 / 1.01);
        near(rel_mse_sbmc(&c, &r).expect("8 x 8 inside"), 4.0 / 1.0001);
        near(mrse_pbrt(&c, &r), 4.0 / 1.01_f64.powi(2));
        near(smape(&c, &r), 2.0 / 4.01);
        near(energy_bias(&c, &r).expect("not black"), 2.0);
    }

    #[test]
    fn the_border_of_sbmc_is_21_pixels() {
        let reference = vec![1.0; 3 * 44 * 43];
        let mut candidate = reference.clone();
        let r = image(&reference, 44, 43);
        candidate[20 * 43 + 21] = 9.0;
        candidate[21 * 43 + 20] = 9.0;
        candidate[23 * 43 + 21] = 9.0;
        assert_eq!(rel_mse_sbmc(&image(&candidate, 44, 43), &r), Some(0.0));
        candidate[22 * 43 + 21] = 2.0;
        let found = rel_mse_sbmc(&image(&candidate, 44, 43), &r).expect("1 x 2 inside");
        assert!((found - 1.0 / 1.0001 / 6.0).abs() < 1e-12, "{found}");
        let small = vec![1.0; 3 * 42 * 60];
        let small = image(&small, 42, 60);
        assert_eq!(rel_mse_sbmc(&small, &small), None);
    }

    #[test]
    fn trimming_drops_one_pixel_in_a_thousand() {
        let reference = vec![1.0; 3 * 40 * 50];
        let mut candidate = reference.clone();
        for worst in [7, 1234] {
            candidate[worst] = 1e6;
        }
        candidate[99] = 2.0;
        let c = image(&candidate, 40, 50);
        let found = rel_mse_trimmed(&c, &image(&reference, 40, 50));
        assert!((found - 1.0 / 1.001 / 1998.0).abs() < 1e-9, "{found}");
    }

    #[test]
    fn energy_bias_is_undefined_for_a_black_reference() {
        let black = [0.0; 12];
        assert_eq!(
            energy_bias(&image(&[1.0; 12], 2, 2), &image(&black, 2, 2)),
            None
        );
    }
}
