//! Detects a pixel filter wider than a pixel from the noise of one image.
//!
//! A path tracer with a box filter gives each pixel samples of its own, so the noise of neighbours
//! is independent. A wider filter shares samples between pixels. Denoisers trained on independent
//! noise take shared noise for content.
//!
//! The estimate uses the logarithm of luminance in blocks of 16x16 pixels. A plane is subtracted
//! from each block, and the autocorrelations at lags 1 to 4 are averaged over rows, columns, and
//! blocks. Content is removed in two ways:
//!
//! - Blocks with correlation at lag 4 are left out. Filtered noise has none at that distance.
//! - The correlation of content is about linear in the lag, as at an edge. It is extrapolated from
//!   lags 2 and 3 to lags 0 and 1, and subtracted.
//!
//! Limits were tuned on half of the base scenes of the 108 training and test renders, and checked
//! on the other half. See `docs/data.md`.

use crate::input::ranges::{LUMINANCE, exposure};

/// Smallest correlation that shows a wide pixel filter.
///
/// Ours. Images with a box filter are at most at 0.08. With Mitsuba's filters they are at least at:
/// Lanczos 0.26, Catmull-Rom 0.27, tent 0.30, Mitchell 0.34, Gaussian 0.39.
pub const CORRELATED: f32 = 0.2;

/// Width and height of a block in pixels.
const BLOCK: usize = 16;
/// Number of pixels of a block.
const PIXELS: usize = BLOCK * BLOCK;
/// The largest lag, at which noise does not correlate.
const FAR: usize = 4;
/// Largest correlation at lag 4 of a block without content; its standard error is about 0.05.
const MAX_FAR: f64 = 0.1;
/// Smallest variance of a noisy block, in log luminance: 10 % of the brightness.
const MIN_VARIANCE: f64 = 0.01;
/// Smallest number of such blocks, and their smallest share of all.
const MIN_BLOCKS: usize = 16;
const MIN_SHARE: f64 = 0.25;
/// Smallest share of noise in the variance of the blocks (box: at least 0.65).
const MIN_NOISE: f64 = 0.35;
/// Luminance that is added before the logarithm, in exposures of the image.
const DARK: f64 = 0.05;

/// The correlation of the noise of horizontally and vertically neighbouring pixels: about 0 with a
/// box filter, 0.4 with Mitsuba's default Gaussian. [`CORRELATED`] or more shows a wide filter.
///
/// `None` if there is too little noise to tell: a black image, many samples per pixel, mostly content,
/// or fewer than 16 blocks of 16x16 pixels. The estimate is meant for few samples per pixel, such as
/// 4 to 16. Content may reach 0.3 in references.
///
/// # Shapes
/// `color_hdr` is planar `[3, height, width]`, linear radiance, finite.
///
/// # Panics
/// If `color_hdr` has another length.
pub fn correlation(color_hdr: &[f32], width: usize, height: usize) -> Option<f32> {
    assert_eq!(
        color_hdr.len(),
        3 * width * height,
        "color_hdr must be [3, {height}, {width}]"
    );
    let log = log_luminance(color_hdr)?;
    let mut sums = [0.0; FAR + 1];
    let (mut all, mut noisy) = (0, 0);
    for top in (0..(height + 1).saturating_sub(BLOCK)).step_by(BLOCK) {
        for left in (0..(width + 1).saturating_sub(BLOCK)).step_by(BLOCK) {
            all += 1;
            let block = Block::of(&log, width, (left, top));
            let covariances = block.covariances();
            let [variance, .., far] = covariances;
            if variance >= MIN_VARIANCE && (far / variance).abs() < MAX_FAR {
                noisy += 1;
                for (sum, covariance) in sums.iter_mut().zip(covariances) {
                    *sum += covariance / variance;
                }
            }
        }
    }
    if noisy < MIN_BLOCKS || (noisy as f64) < MIN_SHARE * f64::from(all) {
        return None;
    }
    let [_, one, two, three, _] = sums.map(|sum| sum / noisy as f64);
    // Content on a line through lags 2 and 3 is `3 two - 2 three` at lag 0, `2 two - three` at 1.
    let noise = 1.0 - (3.0 * two - 2.0 * three);
    let shared = one - (2.0 * two - three);
    (noise >= MIN_NOISE).then_some((shared / noise) as f32)
}

/// `ln(luminance + 0.05 exposure)` of each pixel; `None` of a black image.
pub(crate) fn log_luminance(color_hdr: &[f32]) -> Option<Vec<f64>> {
    let dark = DARK * exposure(color_hdr);
    (dark > 0.0 && dark.is_finite()).then(|| log_luminance_above(color_hdr, dark))
}

/// `ln(luminance + dark)` of each pixel.
pub(crate) fn log_luminance_above(color_hdr: &[f32], dark: f64) -> Vec<f64> {
    let pixels = color_hdr.len() / 3;
    let log = (0..pixels).map(|i| {
        let channels = LUMINANCE.iter().enumerate();
        let luminance: f32 = channels.map(|(c, y)| y * color_hdr[c * pixels + i]).sum();
        (f64::from(luminance.max(0.0)) + dark).ln()
    });
    log.collect()
}

/// The differences of a block from a plane through it, row by row.
struct Block([f64; PIXELS]);

impl Block {
    fn of(image: &[f64], width: usize, (left, top): (usize, usize)) -> Self {
        let mut block = [0.0; PIXELS];
        for (y, row) in block.chunks_exact_mut(BLOCK).enumerate() {
            let start = (top + y) * width + left;
            row.copy_from_slice(&image[start..start + BLOCK]);
        }
        let mean = block.iter().sum::<f64>() / PIXELS as f64;
        let slope = |axis: fn(usize) -> usize| {
            let values = block.iter().enumerate();
            let product: f64 = values.map(|(i, value)| centred(axis(i)) * value).sum();
            product / (PIXELS as f64 * mean_square())
        };
        let (across, down) = (slope(|i| i % BLOCK), slope(|i| i / BLOCK));
        for (i, value) in block.iter_mut().enumerate() {
            *value -= mean + across * centred(i % BLOCK) + down * centred(i / BLOCK);
        }
        Self(block)
    }

    /// Variance and covariances at lags 1 to 4. Their expectation for white noise is exactly 0: what
    /// subtracting a plane takes from them is added.
    fn covariances(&self) -> [f64; FAR + 1] {
        let Self(block) = self;
        let pixels = PIXELS as f64;
        // Three degrees of freedom of the plane.
        let variance = block.iter().map(|x| x * x).sum::<f64>() / (pixels - 3.0);
        std::array::from_fn(|lag| {
            if lag == 0 {
                return variance;
            }
            let count = BLOCK - lag;
            let rows = block.chunks_exact(BLOCK);
            let across: f64 = rows
                .flat_map(|row| row.iter().zip(&row[lag..]))
                .map(|(a, b)| a * b)
                .sum();
            let below = block.iter().zip(&block[lag * BLOCK..]);
            let down: f64 = below.map(|(a, b)| a * b).sum();
            let positions = (0..count).map(|x| centred(x) * centred(x + lag));
            let along = positions.sum::<f64>() / count as f64;
            let taken = (1.0 + along / mean_square() + 1.0) / pixels;
            (across + down) / (2 * count * BLOCK) as f64 + variance * taken
        })
    }
}

/// Distance of a column or row from the centre of its block.
fn centred(position: usize) -> f64 {
    position as f64 - (BLOCK - 1) as f64 / 2.0
}

/// Mean of the squared distances from the centre.
fn mean_square() -> f64 {
    (PIXELS - 1) as f64 / 12.0
}

#[cfg(test)]
mod tests {
    use rand::{RngExt, SeedableRng};
    use rand_chacha::ChaCha8Rng;

    use super::*;

    const SIDE: usize = 96;

    /// An image of these values with noise of this relative size, filtered by `[a, 1 - 2 a, a]`.
    fn noisy(value: impl Fn(usize, usize) -> f32, size: f32, a: f32) -> Vec<f32> {
        let mut random = ChaCha8Rng::seed_from_u64(3);
        let mut noise = || 1.0 + size * (random.random::<f32>() - 0.5);
        let samples: Vec<f32> = (0..SIDE * SIDE)
            .map(|i| value(i % SIDE, i / SIDE) * noise())
            .collect();
        let at = |x: usize, y: usize| samples[y.min(SIDE - 1) * SIDE + x.min(SIDE - 1)];
        let across = |x: usize, y| {
            a * at(x.saturating_sub(1), y) + (1.0 - 2.0 * a) * at(x, y) + a * at(x + 1, y)
        };
        let filtered = (0..SIDE * SIDE).map(|i| {
            let (x, y) = (i % SIDE, i / SIDE);
            let down = a * across(x, y.saturating_sub(1)) + a * across(x, y + 1);
            down + (1.0 - 2.0 * a) * across(x, y)
        });
        filtered.collect::<Vec<f32>>().repeat(3)
    }

    fn measured(image: &[f32]) -> f32 {
        correlation(image, SIDE, SIDE).expect("enough noise")
    }

    #[test]
    fn white_noise_has_none_and_filtered_noise_its_own() {
        let flat = |_, _| 0.5;
        // 96^2 pixels have a standard error of 0.02.
        assert!(measured(&noisy(flat, 1.0, 0.0)).abs() < 0.05);
        for a in [0.08_f32, 0.14] {
            let expected = 2.0 * a * (1.0 - 2.0 * a) / ((1.0 - 2.0 * a).powi(2) + 2.0 * a * a);
            let found = measured(&noisy(flat, 1.0, a));
            assert!((found - expected).abs() < 0.06, "{found}, not {expected}");
        }
    }

    #[test]
    fn gradients_and_edges_are_no_noise() {
        let content = |x: usize, y: usize| {
            let edge = if (x + 2 * y) % 60 < 30 { 1.0 } else { 2.0 };
            edge * (1.0 + x as f32 / 30.0)
        };
        assert!(measured(&noisy(content, 1.0, 0.0)).abs() < CORRELATED / 2.0);
        assert!(measured(&noisy(content, 1.0, 0.14)) > 1.5 * CORRELATED);
    }

    #[test]
    fn exposure_does_not_matter() {
        let image = noisy(|_, _| 0.5, 1.0, 0.14);
        let bright: Vec<f32> = image.iter().map(|x| 1024.0 * x).collect();
        assert!((measured(&image) - measured(&bright)).abs() < 1e-4);
    }

    #[test]
    fn too_little_noise_does_not_tell() {
        let flat = |_, _| 0.5;
        let none = |image: &[f32], side| correlation(image, side, side).is_none();
        assert!(none(&[0.0; 3 * SIDE * SIDE], SIDE), "black");
        assert!(none(&noisy(flat, 0.1, 0.0), SIDE), "many samples per pixel");
        assert!(none(&noisy(flat, 1.0, 0.0)[..3 * 32 * 32], 32), "small");
        assert!(none(&[], 0), "empty");
    }
}
