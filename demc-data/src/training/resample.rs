//! Noise resampling: an augmentation for data sets with one noisy image per scene, whose noise a
//! long training would memorise.
//!
//! A pixel's noise is the ratio of its colour to its reference, together with its second texture.
//! Path tracers draw noise independently for each pixel. Pixels of one surface in the same light
//! share the same noise distribution. So a pixel may take the noise of a nearby pixel with similar
//! normal, texture and reference. The content of the patch stays: a shadow's edge comes from the
//! reference.
//!
//! Ours; Neighbor2Neighbor (Huang et al. 2021) pairs neighbouring pixels for the same reason.

use rand::{Rng, RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;

use crate::image::frame::{FEATURES, TEXTURES};

/// Maximum distance of the noise's source along each axis, in pixels.
const REACH: i32 = 16;
/// A pixel keeps its own noise after this many draws without a similar pixel.
const DRAWS: usize = 8;
/// Maximum Euclidean distance of two normals: 17 degrees, or a mask of 0.7 beside 1.
const NORMAL: f32 = 0.3;
/// Maximum Euclidean distance over RGB of two textures at the first vertex.
const TEXTURE: f32 = 0.15;
/// Maximum ratio of two references.
const LIGHT: f32 = 1.5;
/// Added to references, in radiance, to avoid division by zero.
const BLACK: f32 = 1e-3;

/// Replaces the noise of each pixel of a square patch by that of a similar pixel, drawn from
/// `seed`.
///
/// # Shapes
/// `color` and `reference` are `[3, size, size]`, linear HDR; `features` is `[12, size, size]`, as
/// rendered. Changes colour and the second texture.
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
    let (first, second) = features.split_at_mut((TEXTURES + 3) * pixels);
    let surface = Surface {
        normal: &first[..3 * pixels],
        texture: &first[TEXTURES * pixels..],
        reference,
        pixels,
    };
    let (noisy_color, second_texture) = (color.to_vec(), second.to_vec());
    let mut rng = ChaCha8Rng::seed_from_u64(seed);
    for pixel in 0..pixels {
        let Some(other) = surface.like(pixel, size, &mut rng) else {
            continue;
        };
        for plane in 0..3 {
            let (target, source) = (plane * pixels + pixel, plane * pixels + other);
            color[target] =
                noisy_color[source] * ((reference[target] + BLACK) / (reference[source] + BLACK));
            second[target] = second_texture[source];
        }
    }
}

/// The planes `[3, pixels]` that decide whether two pixels have the same kind of noise.
struct Surface<'a> {
    normal: &'a [f32],
    texture: &'a [f32],
    reference: &'a [f32],
    pixels: usize,
}

impl Surface<'_> {
    /// A random pixel near `pixel` that is similar to it, possibly the pixel itself; `None` if no
    /// draw succeeds.
    fn like(&self, pixel: usize, size: usize, rng: &mut impl Rng) -> Option<usize> {
        let inside = |v: usize, d: i32| v.checked_add_signed(d as isize).filter(|v| *v < size);
        (0..DRAWS).find_map(|_| {
            let (dy, dx) = (
                rng.random_range(-REACH..=REACH),
                rng.random_range(-REACH..=REACH),
            );
            let other = inside(pixel / size, dy)? * size + inside(pixel % size, dx)?;
            self.are_alike(pixel, other).then_some(other)
        })
    }

    fn are_alike(&self, a: usize, b: usize) -> bool {
        let pair = |planes: &[f32]| {
            let rgb = |pixel| [0, 1, 2].map(|plane| planes[plane * self.pixels + pixel]);
            (rgb(a), rgb(b))
        };
        let near = |(a, b): ([f32; 3], [f32; 3]), limit: f32| {
            let squares = a.into_iter().zip(b).map(|(a, b)| (a - b) * (a - b));
            squares.sum::<f32>() <= limit * limit
        };
        let light = |rgb: [f32; 3]| rgb.iter().sum::<f32>() + BLACK;
        let (of_a, of_b) = pair(self.reference);
        let (light_a, light_b) = (light(of_a), light(of_b));
        near(pair(self.normal), NORMAL)
            && near(pair(self.texture), TEXTURE)
            && light_a.max(light_b) <= LIGHT * light_a.min(light_b)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const SIZE: usize = 64;
    const PIXELS: usize = SIZE * SIZE;

    struct Room {
        color: Vec<f32>,
        features: Vec<f32>,
        reference: Vec<f32>,
    }

    /// A wall and a floor. The right half is lit four times as much as the left half; the floor
    /// starts at row 48. One pixel in four has light, four times its reference. The noise of the
    /// floor is half as strong. The second texture holds the number of the noise.
    fn room() -> Room {
        let mut rng = ChaCha8Rng::seed_from_u64(3);
        let mut features = vec![0.0; FEATURES * PIXELS];
        let mut color = vec![0.0; 3 * PIXELS];
        let mut reference = vec![0.0; 3 * PIXELS];
        for pixel in 0..PIXELS {
            let (floor, right) = (pixel / SIZE >= 48, pixel % SIZE >= SIZE / 2);
            features[if floor { 1 } else { 2 } * PIXELS + pixel] = 1.0;
            let level = if right { 0.8 } else { 0.2 };
            let lit = if rng.random_range(0..4) == 0 {
                4.0
            } else {
                0.0
            };
            let noise = if floor { 0.5 * lit + 0.5 } else { lit };
            for plane in 0..3 {
                reference[plane * PIXELS + pixel] = level;
                color[plane * PIXELS + pixel] = noise * level;
                features[(TEXTURES + 3 + plane) * PIXELS + pixel] = noise;
            }
        }
        Room {
            color,
            features,
            reference,
        }
    }

    #[test]
    fn noise_is_another_of_the_same_surface_in_the_same_light() {
        let Room {
            color,
            features,
            reference,
        } = room();
        let (mut varied, mut varied_features) = (color.clone(), features.clone());
        resample_noise(&mut varied, &mut varied_features, &reference, SIZE, 1);
        let moved = (0..PIXELS)
            .filter(|pixel| varied[*pixel] != color[*pixel])
            .count();
        // 2 x 1/4 x 3/4 of the pixels draw a different value.
        let share = moved as f32 / PIXELS as f32;
        assert!((share - 0.375).abs() < 0.03, "{share} moved");
        for pixel in 0..PIXELS {
            let noise = varied[pixel] / reference[pixel];
            let own = if pixel / SIZE >= 48 {
                [0.5, 2.5]
            } else {
                [0.0, 4.0]
            };
            assert!(
                own.iter().any(|own| (own - noise).abs() < 0.05),
                "pixel {pixel}: {noise}"
            );
            // The second texture moves together with the noise.
            let second_texture = varied_features[(TEXTURES + 3) * PIXELS + pixel];
            assert!(
                (second_texture - noise).abs() < 0.05,
                "pixel {pixel}: {second_texture} beside {noise}"
            );
        }
        assert_eq!(
            varied_features[..(TEXTURES + 3) * PIXELS],
            features[..(TEXTURES + 3) * PIXELS]
        );
        // The total light stays, within the precision of 4096 draws with variance 3 (standard
        // deviation 0.03).
        let light = |color: &[f32]| {
            let ratios = color.iter().zip(&reference).map(|(c, r)| c / r);
            ratios.sum::<f32>() / color.len() as f32
        };
        assert!((light(&varied) - light(&color)).abs() < 0.1);
    }

    #[test]
    fn a_seed_draws_one_noise() {
        let room = room();
        let drawn = |seed| {
            let (mut color, mut features) = (room.color.clone(), room.features.clone());
            resample_noise(&mut color, &mut features, &room.reference, SIZE, seed);
            (color, features)
        };
        assert_eq!(drawn(1), drawn(1));
        assert_ne!(drawn(1), drawn(2));
    }

    /// Columns differ in light and rows in texture, over the maximum distance of the noise's
    /// source.
    #[test]
    fn a_pixel_that_is_like_no_other_keeps_its_noise() {
        let Room {
            mut color,
            mut features,
            mut reference,
        } = room();
        let steps = 2 * REACH as usize + 1;
        for pixel in 0..PIXELS {
            features[TEXTURES * PIXELS + pixel] = 0.2 * (pixel / SIZE % steps) as f32;
            for plane in 0..3 {
                reference[plane * PIXELS + pixel] = 1.6f32.powi((pixel % SIZE % steps) as i32);
            }
        }
        let before = (color.clone(), features.clone());
        resample_noise(&mut color, &mut features, &reference, SIZE, 1);
        assert_eq!((color, features), before);
    }
}
