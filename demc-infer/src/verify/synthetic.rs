//! Synthetic inputs of a verification, and this program's output for them.

use burn::tensor::{Device, Tensor, TensorData};
use demc_data::image::frame::FEATURES;
use demc_data::{FeatureStats, Frame};
use demc_model::Denoiser;
use rand::{Rng, RngExt};

use crate::DenoiseError;

/// Share of black pixels of a synthetic frame: paths that found no light.
const BLACK: f32 = 0.3;
const FIREFLIES: f32 = 0.005;
/// Radiance of fireflies, as powers of ten.
const FIREFLY_EXPONENTS: std::ops::Range<f32> = 1.0..3.0;
/// Side of an object in pixels. Features are smooth within an object and jump between objects.
const OBJECT: usize = 11;

/// What Python gets, and what it should return.
pub(super) struct SyntheticBatch {
    pub color: Vec<f32>,
    pub features: Vec<f32>,
    pub output: Vec<f32>,
}

impl SyntheticBatch {
    /// Frames, as rendered, with features of these statistics.
    pub fn of_frames(
        [batch, height, width]: [usize; 3],
        statistics: &FeatureStats,
        denoise: impl Fn(&Frame) -> Result<Vec<f32>, DenoiseError>,
        rng: &mut impl Rng,
    ) -> Result<Self, DenoiseError> {
        let (mut color, mut features, mut output) = (Vec::new(), Vec::new(), Vec::new());
        for _ in 0..batch {
            let frame = synthetic_frame([height, width], statistics, rng);
            output.extend(denoise(&frame)?);
            color.extend(frame.color);
            features.extend(frame.features);
        }
        Ok(Self {
            color,
            features,
            output,
        })
    }

    /// The inputs of KPCN, evenly distributed.
    pub fn of_light(
        [batch, height, width]: [usize; 3],
        model: &Denoiser,
        rng: &mut impl Rng,
    ) -> Self {
        let colors = model.config().variant.spec().color_channels;
        let [color, features] = [colors, FEATURES].map(|channels| -> Vec<f32> {
            let count = batch * channels * height * width;
            (0..count).map(|_| rng.random()).collect()
        });
        let tensor = |values: &[f32], channels: usize| {
            let shape = [batch, channels, height, width];
            Tensor::<4>::from_data(TensorData::new(values.to_vec(), shape), &Device::flex())
        };
        let output = model.forward(tensor(&color, colors), tensor(&features, FEATURES));
        Self {
            output: output.into_data().try_to_vec().expect("float32"),
            color,
            features,
        }
    }
}

/// A frame that resembles a rendering at 4 samples per pixel, without a renderer.
///
/// Radiance is albedo times noise; 30 % of the pixels are black, and some are fireflies. Features
/// spread around the training mean as in training, constant in blocks with noise on top.
fn synthetic_frame(
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
    Frame::new("synthetic", width, height, color, features)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::bundle::testing::bundle;
    use demc_model::Variant;
    use rand::SeedableRng;
    use rand_chacha::ChaCha8Rng;

    #[test]
    fn a_synthetic_frame_resembles_the_training_data() {
        let bundle = bundle(Variant::Demc);
        let statistics = &bundle.meta.normalizer.features;
        let mut rng = ChaCha8Rng::seed_from_u64(1);
        let frame = synthetic_frame([64, 96], statistics, &mut rng);
        assert!(bundle.check_statistics(&frame).is_ok());
        assert_eq!(frame.color.len(), 3 * 64 * 96);
        assert!(frame.color.iter().any(|x| *x > 10.0), "no firefly");
        let black = frame.color.iter().filter(|x| **x == 0.0).count();
        assert!((1500..2200).contains(&(black / 3)), "{black}");
        for (i, plane) in frame.features.chunks_exact(64 * 96).enumerate() {
            let z = |x: &f32| (x - statistics.mean[i]) / statistics.std[i];
            let mean = plane.iter().map(z).sum::<f32>() / (64.0 * 96.0);
            assert!(mean.abs() < 0.6, "channel {i}: {mean}");
        }
    }
}
