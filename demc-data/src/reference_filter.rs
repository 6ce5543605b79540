//! Cleaner references to train on: a joint bilateral filter for references that still have visible noise.
//!
//! Eq. 5 divides by the square of the reference's own pixel. Where that pixel is noisy, the loss is least not at its mean but
//! below it: a network that learns from references of some hundred samples turns out too dark where light is scarce. The filter
//! (Tomasi and Manduchi 1998, Eisemann and Durand 2004 for the joint form) averages a pixel with those around it that have
//! the same normal and texture and about the same radiance. How near "about" is follows the noise that is there, measured
//! block by block, so that a clean reference stays as it is. Ours: the paper's references have 32,000 samples.

use half::f16;

use crate::frame::{FramePlanes, TEXTURES};
use crate::plane::Plane;

/// Half the side of the window: 9x9 pixels.
const RADIUS: isize = 4;
/// Standard deviation in pixels.
const SPACE: f32 = 2.0;
/// Of a difference of normals.
const NORMAL: f32 = 0.25;
/// Of a difference of textures at the first vertex.
const TEXTURE: f32 = 0.1;
/// Of a difference of log radiance, in standard deviations of the noise there; and the least and the most that comes of it.
const RANGE: f32 = 2.5;
const LEAST_RANGE: f32 = 0.01;
const MOST_RANGE: f32 = 1.0;
/// Added to radiance before the logarithm: black has one.
const LOG_OFFSET: f32 = 0.02;
/// Noise is measured once for a block of 16x16 pixels, over it and 8 more on each side.
const BLOCK: usize = 16;
const BLOCK_MARGIN: usize = 8;
/// From the median of absolute values to the standard deviation of a normal distribution.
const MAD: f32 = 1.4826;

/// Filters the reference of `planes`, if it has one.
pub fn filter_reference(planes: &mut FramePlanes) {
    let Some(reference) = planes.reference.take() else {
        return;
    };
    let to_f32 = |planes: &[Plane]| planes.iter().map(Plane::to_f32).collect::<Vec<_>>();
    let radiance = to_f32(&reference);
    let normals = to_f32(&planes.features[..3]);
    let textures = to_f32(&planes.features[TEXTURES..TEXTURES + 3]);
    let guides = [(normals, NORMAL), (textures, TEXTURE)];
    let filtered = filtered(&radiance, &guides, planes.width, planes.height);
    planes.reference = Some(
        filtered
            .into_iter()
            .zip(&reference)
            .map(|(samples, like)| in_precision_of(like, samples))
            .collect(),
    );
}

/// Half stays half: the cache's budget does not depend on the filter. Averages of finite halves are finite halves.
fn in_precision_of(like: &Plane, samples: Vec<f32>) -> Plane {
    match like {
        Plane::Half(_) => Plane::Half(samples.into_iter().map(f16::from_f32).collect()),
        Plane::Float(_) | Plane::Uint(_) => Plane::Float(samples),
    }
}

/// The filter over planes of `width` x `height`; each guide has three planes and a standard deviation.
fn filtered(
    radiance: &[Vec<f32>],
    guides: &[(Vec<Vec<f32>>, f32)],
    width: usize,
    height: usize,
) -> Vec<Vec<f32>> {
    let logs: Vec<Vec<f32>> = radiance
        .iter()
        .map(|plane| plane.iter().map(|x| (x + LOG_OFFSET).ln()).collect())
        .collect();
    let noise = noise(&mean(&logs), width, height);
    let mut out = vec![vec![0.0; width * height]; radiance.len()];
    for y in 0..height {
        for x in 0..width {
            let at = y * width + x;
            let range = (RANGE * noise[at]).clamp(LEAST_RANGE, MOST_RANGE);
            let mut sums = [0.0f32; 3];
            let mut weights = 0.0;
            for dy in -RADIUS..=RADIUS {
                for dx in -RADIUS..=RADIUS {
                    let inside =
                        |v: usize, d: isize, n: usize| v.checked_add_signed(d).filter(|v| *v < n);
                    let (Some(v), Some(u)) = (inside(y, dy, height), inside(x, dx, width)) else {
                        continue;
                    };
                    let other = v * width + u;
                    let mut exponent = (dy * dy + dx * dx) as f32 / (2.0 * SPACE * SPACE);
                    for (planes, deviation) in guides {
                        exponent += squared(planes, at, other) / (2.0 * deviation * deviation);
                    }
                    let channels = logs.len() as f32;
                    exponent += squared(&logs, at, other) / (2.0 * channels * range * range);
                    let weight = (-exponent).exp();
                    weights += weight;
                    for (sum, plane) in sums.iter_mut().zip(radiance) {
                        *sum += weight * plane[other];
                    }
                }
            }
            // The pixel itself weighs 1.
            for (out, sum) in out.iter_mut().zip(sums) {
                out[at] = sum / weights;
            }
        }
    }
    out
}

/// Squared distance of two pixels over all planes.
fn squared(planes: &[Vec<f32>], a: usize, b: usize) -> f32 {
    let differences = planes.iter().map(|plane| plane[a] - plane[b]);
    differences.map(|difference| difference * difference).sum()
}

fn mean(planes: &[Vec<f32>]) -> Vec<f32> {
    let count = planes.len() as f32;
    (0..planes[0].len())
        .map(|i| planes.iter().map(|plane| plane[i]).sum::<f32>() / count)
        .collect()
}

/// The standard deviation of the noise around each pixel: from the median, over its block, of how far a pixel is from the mean
/// of its four neighbours, which edges that cover less than half of a block do not move.
fn noise(plane: &[f32], width: usize, height: usize) -> Vec<f32> {
    let at = |y: usize, x: usize| plane[y.min(height - 1) * width + x.min(width - 1)];
    let deviation = |y: usize, x: usize| {
        let vertical = at(y.saturating_sub(1), x) + at(y + 1, x);
        let horizontal = at(y, x.saturating_sub(1)) + at(y, x + 1);
        (at(y, x) - (vertical + horizontal) / 4.0).abs()
    };
    let mut out = vec![0.0; plane.len()];
    for top in (0..height).step_by(BLOCK) {
        for left in (0..width).step_by(BLOCK) {
            let rows = top.saturating_sub(BLOCK_MARGIN)..(top + BLOCK + BLOCK_MARGIN).min(height);
            let columns =
                left.saturating_sub(BLOCK_MARGIN)..(left + BLOCK + BLOCK_MARGIN).min(width);
            let mut deviations: Vec<f32> = rows
                .flat_map(|y| columns.clone().map(move |x| (y, x)))
                .map(|(y, x)| deviation(y, x))
                .collect();
            let middle = deviations.len() / 2;
            let (_, median, _) = deviations.select_nth_unstable_by(middle, f32::total_cmp);
            // A pixel less the mean of four has 5/4 of one pixel's variance.
            let noise = MAD * *median / 1.25f32.sqrt();
            for y in top..(top + BLOCK).min(height) {
                out[y * width + left..y * width + (left + BLOCK).min(width)].fill(noise);
            }
        }
    }
    out
}

#[cfg(test)]
mod tests {
    use super::*;
    use rand::{RngExt, SeedableRng};
    use rand_chacha::ChaCha8Rng;

    const SIDE: usize = 64;

    /// Three equal planes of `of(y, x)`.
    fn planes(mut of: impl FnMut(usize, usize) -> f32) -> Vec<Plane> {
        let pixels = (0..SIDE * SIDE).map(|i| of(i / SIDE, i % SIDE)).collect();
        vec![Plane::Float(pixels); 3]
    }

    /// The filtered red of a frame with this reference and this texture.
    fn red(reference: Vec<Plane>, texture: Vec<Plane>) -> Vec<f32> {
        let mut features = vec![Plane::zeros(SIDE * SIDE); 12];
        features[TEXTURES..TEXTURES + 3].clone_from_slice(&texture);
        let mut frame = FramePlanes {
            width: SIDE,
            height: SIDE,
            color: planes(|_, _| 0.0),
            features,
            reference: Some(reference),
            mask: None,
            clamped: 0,
        };
        filter_reference(&mut frame);
        frame.reference.expect("it had one")[0].to_f32()
    }

    /// Mean and relative standard deviation.
    fn moments(pixels: &[f32]) -> (f32, f32) {
        let count = pixels.len() as f32;
        let mean = pixels.iter().sum::<f32>() / count;
        let variance = pixels.iter().map(|x| (x - mean).powi(2)).sum::<f32>() / count;
        (mean, variance.sqrt() / mean)
    }

    /// Noise of 20 % on 0.3 and on 0.6, which differ in nothing but the texture: most of it goes, means and edge stay.
    #[test]
    fn noise_goes_and_a_textures_edge_stays() {
        let mut rng = ChaCha8Rng::seed_from_u64(1);
        let mut noisy = |_, x| {
            let level = if x < SIDE / 2 { 0.3 } else { 0.6 };
            level * (1.0 + 0.2 * 3f32.sqrt() * rng.random_range(-1.0..1.0f32))
        };
        let reference = planes(&mut noisy);
        let texture = planes(|_, x| if x < SIDE / 2 { 0.2 } else { 0.8 });
        let out = red(reference, texture);
        for (columns, level) in [(0..SIDE / 2, 0.3), (SIDE / 2..SIDE, 0.6)] {
            let half: Vec<f32> = out
                .chunks_exact(SIDE)
                .flat_map(|row| &row[columns.clone()])
                .copied()
                .collect();
            let (mean, deviation) = moments(&half);
            assert!((mean / level - 1.0).abs() < 0.02, "{mean}, not {level}");
            assert!(deviation < 0.06, "{deviation} of 0.2 is left");
        }
    }

    /// Nothing is noisy here: a shadow's edge under one texture, and a smooth slope, stay what they are.
    #[test]
    fn a_clean_reference_stays_as_it_is() {
        let clean = |_, x| if x < 40 { 0.2 + 0.001 * x as f32 } else { 1.0 };
        let out = red(planes(clean), planes(|_, _| 0.5));
        for (i, found) in out.iter().enumerate() {
            let expected = clean(0, i % SIDE);
            assert!(
                (found / expected - 1.0).abs() < 0.005,
                "pixel {i}: {found}, not {expected}"
            );
        }
    }

    #[test]
    fn halves_stay_halves_and_black_stays_black() {
        let black = vec![Plane::zeros(SIDE * SIDE); 3];
        let mut frame = FramePlanes {
            width: SIDE,
            height: SIDE,
            color: black.clone(),
            features: vec![Plane::zeros(SIDE * SIDE); 12],
            reference: Some(black.clone()),
            mask: None,
            clamped: 0,
        };
        filter_reference(&mut frame);
        assert_eq!(frame.reference, Some(black));
    }
}
