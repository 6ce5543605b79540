//! A patch with other noise of the same kind: an augmentation for data sets with one noisy image a scene, which a long
//! training learns by heart.
//!
//! A pixel's noise is what its colour is times its reference, and what its light met second. Pixels of one surface in
//! one light have noise of one distribution, and path tracers draw it for each pixel anew: so a pixel may take that of any
//! other nearby whose normal, texture and reference are about its own. What the patch shows stays where it is: a shadow's
//! edge is the reference's. Ours; Neighbor2Neighbor (Huang et al. 2021) draws its pairs from neighbours for the same reason.

use rand::{Rng, RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;

use crate::frame::{FEATURES, TEXTURES};

/// How far away noise is taken from, in pixels along each axis: within it, what is left of the image's own noise is its mean.
const REACH: i32 = 16;
/// A pixel that finds nobody like itself in so many draws keeps its own.
const DRAWS: usize = 8;
/// Most that two normals differ, as a Euclidean distance: 17 degrees, or a mask of 0.7 beside 1.
const NORMAL: f32 = 0.3;
/// Most that the textures differ at the first vertex, as a Euclidean distance over RGB.
const TEXTURE: f32 = 0.15;
/// Most that one reference is times the other.
const LIGHT: f32 = 1.5;
/// Added to references, in radiance: black divides by it.
const BLACK: f32 = 1e-3;

/// Gives each pixel of a square patch the noise of another that is like it, drawn from `seed`.
///
/// # Shapes
/// `color` and `reference` are `[3, size, size]`, linear HDR; `features` `[12, size, size]`, as rendered. Colour and the
/// second texture change.
pub fn resample_noise(
    color: &mut [f32],
    features: &mut [f32],
    reference: &[f32],
    size: usize,
    seed: u64,
) {
    let pixels = size * size;
    assert_eq!(color.len(), 3 * pixels, "colour must be [3, size, size]");
    assert_eq!(
        features.len(),
        FEATURES * pixels,
        "features must be [12, size, size]"
    );
    assert_eq!(
        reference.len(),
        3 * pixels,
        "the reference must be [3, size, size]"
    );
    let (surface, second) = features.split_at_mut((TEXTURES + 3) * pixels);
    let surface = Surface {
        normal: &surface[..3 * pixels],
        texture: &surface[TEXTURES * pixels..],
        reference,
        pixels,
    };
    let (noisy, met) = (color.to_vec(), second.to_vec());
    let mut rng = ChaCha8Rng::seed_from_u64(seed);
    for at in 0..pixels {
        let Some(other) = surface.like(at, size, &mut rng) else {
            continue;
        };
        for plane in 0..3 {
            let (to, from) = (plane * pixels + at, plane * pixels + other);
            color[to] = noisy[from] * ((reference[to] + BLACK) / (reference[from] + BLACK));
            second[to] = met[from];
        }
    }
}

/// What decides whether two pixels have the same kind of noise: planes `[3, pixels]`.
struct Surface<'a> {
    normal: &'a [f32],
    texture: &'a [f32],
    reference: &'a [f32],
    pixels: usize,
}

impl Surface<'_> {
    /// A pixel near `at` that is like it, maybe `at` itself; `None` if none was drawn.
    fn like(&self, at: usize, size: usize, rng: &mut impl Rng) -> Option<usize> {
        let inside = |v: usize, d: i32| v.checked_add_signed(d as isize).filter(|v| *v < size);
        (0..DRAWS).find_map(|_| {
            let (dy, dx) = (
                rng.random_range(-REACH..=REACH),
                rng.random_range(-REACH..=REACH),
            );
            let other = inside(at / size, dy)? * size + inside(at % size, dx)?;
            self.are_alike(at, other).then_some(other)
        })
    }

    fn are_alike(&self, a: usize, b: usize) -> bool {
        let pair = |planes: &[f32]| {
            let of = |pixel| [0, 1, 2].map(|plane| planes[plane * self.pixels + pixel]);
            (of(a), of(b))
        };
        let near = |(a, b): ([f32; 3], [f32; 3]), most: f32| {
            let squares = a.into_iter().zip(b).map(|(a, b)| (a - b) * (a - b));
            squares.sum::<f32>() <= most * most
        };
        let (r, q) = pair(self.reference);
        let (r, q) = (r.iter().sum::<f32>() + BLACK, q.iter().sum::<f32>() + BLACK);
        near(pair(self.normal), NORMAL)
            && near(pair(self.texture), TEXTURE)
            && r.max(q) <= LIGHT * r.min(q)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const SIZE: usize = 64;
    const PIXELS: usize = SIZE * SIZE;

    /// Colour, features and reference of a wall that is lit four times as much on its right half as on its left, beside
    /// (from row 48 on) a floor in the wall's light. One pixel in four has light, four times as much as the reference; the
    /// floor has noise of half that size. The second texture is the noise's own number.
    fn room() -> (Vec<f32>, Vec<f32>, Vec<f32>) {
        let mut rng = ChaCha8Rng::seed_from_u64(3);
        let mut features = vec![0.0; FEATURES * PIXELS];
        let mut color = vec![0.0; 3 * PIXELS];
        let mut reference = vec![0.0; 3 * PIXELS];
        for at in 0..PIXELS {
            let (floor, right) = (at / SIZE >= 48, at % SIZE >= SIZE / 2);
            features[if floor { 1 } else { 2 } * PIXELS + at] = 1.0;
            let level = if right { 0.8 } else { 0.2 };
            let noise = if rng.random_range(0..4) == 0 {
                4.0
            } else {
                0.0
            };
            let noise = if floor { 0.5 * noise + 0.5 } else { noise };
            for plane in 0..3 {
                reference[plane * PIXELS + at] = level;
                color[plane * PIXELS + at] = noise * level;
                features[(TEXTURES + 3 + plane) * PIXELS + at] = noise;
            }
        }
        (color, features, reference)
    }

    #[test]
    fn noise_is_another_of_the_same_surface_in_the_same_light() {
        let (color, features, reference) = room();
        let (mut varied, mut with) = (color.clone(), features.clone());
        resample_noise(&mut varied, &mut with, &reference, SIZE, 1);
        let moved = (0..PIXELS).filter(|at| varied[*at] != color[*at]).count();
        // 2 x 1/4 x 3/4 of the pixels draw another value than theirs.
        let share = moved as f32 / PIXELS as f32;
        assert!((share - 0.375).abs() < 0.03, "{share} moved");
        for at in 0..PIXELS {
            let noise = varied[at] / reference[at];
            let own = if at / SIZE >= 48 {
                [0.5, 2.5]
            } else {
                [0.0, 4.0]
            };
            assert!(
                own.iter().any(|own| (own - noise).abs() < 0.05),
                "pixel {at}: {noise}"
            );
            // The second texture came along.
            let met = with[(TEXTURES + 3) * PIXELS + at];
            assert!(
                (met - noise).abs() < 0.05,
                "pixel {at}: {met} beside {noise}"
            );
        }
        assert_eq!(
            with[..(TEXTURES + 3) * PIXELS],
            features[..(TEXTURES + 3) * PIXELS]
        );
        // As much light as before, as far as 4096 draws from noise of variance 3 tell: 0.03 is a deviation.
        let light = |color: &[f32]| {
            let ratios = color.iter().zip(&reference).map(|(c, r)| c / r);
            ratios.sum::<f32>() / color.len() as f32
        };
        assert!((light(&varied) - light(&color)).abs() < 0.1);
    }

    #[test]
    fn a_seed_draws_one_noise() {
        let (color, features, reference) = room();
        let drawn = |seed| {
            let (mut color, mut features) = (color.clone(), features.clone());
            resample_noise(&mut color, &mut features, &reference, SIZE, seed);
            (color, features)
        };
        assert_eq!(drawn(1), drawn(1));
        assert_ne!(drawn(1), drawn(2));
    }

    /// Columns differ in light, rows in texture, as far as noise is taken from.
    #[test]
    fn a_pixel_that_is_like_no_other_keeps_its_noise() {
        let (mut color, mut features, mut reference) = room();
        let steps = 2 * REACH as usize + 1;
        for at in 0..PIXELS {
            features[TEXTURES * PIXELS + at] = 0.2 * (at / SIZE % steps) as f32;
            for plane in 0..3 {
                reference[plane * PIXELS + at] = 1.6f32.powi((at % SIZE % steps) as i32);
            }
        }
        let before = (color.clone(), features.clone());
        resample_noise(&mut color, &mut features, &reference, SIZE, 1);
        assert_eq!((color, features), before);
    }
}
