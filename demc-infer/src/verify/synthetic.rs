//! Frames that no renderer made: what is hard about rendered ones, at any size, around a model's own statistics.

use demc_data::frame::FEATURES;
use demc_data::{FeatureStats, Frame};
use rand::{Rng, RngExt};

/// Share of pixels that are black: paths that found no light.
const BLACK: f32 = 0.3;
/// Share of pixels that are fireflies.
const FIREFLIES: f32 = 0.005;
/// Their radiance, as powers of ten.
const FIREFLY_EXPONENTS: std::ops::Range<f32> = 1.0..3.0;
/// Pixels of an object's side: features are smooth within one and jump between two.
const OBJECT: usize = 11;

/// A frame of 4 samples a pixel, so to say: radiance in [0, 1) times noise, a third of it black, with fireflies; features that
/// spread around the training mean as they do in training, flat in blocks with noise on top.
pub(super) fn frame(
    [height, width]: [usize; 2],
    statistics: &FeatureStats,
    rng: &mut impl Rng,
) -> Frame {
    let pixels = height * width;
    let objects = width.div_ceil(OBJECT) * height.div_ceil(OBJECT);
    let object = |pixel: usize| {
        let (y, x) = (pixel / width / OBJECT, pixel % width / OBJECT);
        y * width.div_ceil(OBJECT) + x
    };
    let mut color = vec![0.0; 3 * pixels];
    let albedo: Vec<[f32; 3]> = (0..objects).map(|_| rng.random()).collect();
    for pixel in 0..pixels {
        let light = match rng.random::<f32>() {
            share if share < FIREFLIES => 10f32.powf(rng.random_range(FIREFLY_EXPONENTS)),
            share if share < FIREFLIES + BLACK => 0.0,
            _ => rng.random_range(0.0..1.5f32).powi(2),
        };
        for (channel, albedo) in albedo[object(pixel)].into_iter().enumerate() {
            color[channel * pixels + pixel] = light * albedo;
        }
    }
    let mut features = Vec::with_capacity(FEATURES * pixels);
    for (mean, std) in statistics.mean.into_iter().zip(statistics.std) {
        let flat: Vec<f32> = (0..objects).map(|_| rng.random_range(-1.7..1.7)).collect();
        features.extend((0..pixels).map(|pixel| {
            let z = flat[object(pixel)] + rng.random_range(-0.3..0.3f32);
            mean + std * z
        }));
    }
    Frame {
        name: "synthetic".into(),
        width,
        height,
        color,
        features,
        reference: None,
        mask: None,
        clamped: 0,
    }
}
