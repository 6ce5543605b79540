//! NFOR as a whole: equal to another implementation, and properties of the method.

use rand::RngExt;
use rand_chacha::ChaCha8Rng;
use rand_chacha::rand_core::SeedableRng;
use safetensors::SafeTensors;

use super::{Buffer, Buffers, NforError, features_again};

const EXPECTED: &[u8] = include_bytes!("../../../tests/nfor/expected.safetensors");

/// A tensor of the fixture.
fn tensor(file: &SafeTensors, name: &str) -> Vec<f32> {
    let view = file.tensor(name).expect("a tensor of this name");
    let bytes = view.data().as_chunks::<4>().0;
    bytes
        .iter()
        .map(|bytes| f32::from_le_bytes(*bytes))
        .collect()
}

/// The fixture's inputs.
fn inputs(file: &SafeTensors) -> Buffers {
    let buffer = |name: &str| Buffer {
        halves: ["half1", "half2"].map(|half| tensor(file, &format!("{name}.{half}"))),
        variance: tensor(file, &format!("{name}.variance")),
    };
    let shape = file.tensor("depth.half1").expect("depth");
    Buffers {
        width: shape.shape()[2],
        height: shape.shape()[1],
        color: buffer("color"),
        normal: buffer("normal"),
        albedo: buffer("albedo"),
        depth: buffer("depth"),
    }
}

#[test]
fn numpy_gives_the_same_features() {
    let file = SafeTensors::deserialize(EXPECTED).expect("a safetensors file");
    let found = features_again(inputs(&file).filtered_features());
    let expected = tensor(&file, "features");
    // The depth is 7: ten times its last bit.
    let worst = largest_difference(&found.samples, &expected);
    assert!(worst < 1e-5, "{worst}");
}

#[test]
fn numpy_gives_the_same_image() {
    let file = SafeTensors::deserialize(EXPECTED).expect("a safetensors file");
    let (found, expected) = (
        inputs(&file).denoise().expect("denoised"),
        tensor(&file, "denoised"),
    );
    assert_eq!(found.len(), expected.len());
    // The error of float32 has two places. Where columns hardly differ from others, sums with an error of
    // about 1e-6 are divided by the ridge, 1e-4. Where both bandwidths have equal errors, the choice turns.
    let largest = expected.iter().fold(0.0_f32, |a, b| a.max(*b));
    let differences = found
        .iter()
        .zip(&expected)
        .map(|(a, b)| (a - b).abs() / largest);
    let mut differences: Vec<f32> = differences.collect();
    differences.sort_by(f32::total_cmp);
    let limits = [(50, 5e-5), (90, 2e-3), (100, 0.06)];
    for (percent, limit) in limits {
        let found = differences[(differences.len() - 1) * percent / 100];
        assert!(found < limit, "{percent} %: {found}");
    }
}

/// 50x37 pixels: two surfaces with another normal, albedo, and depth, and a texture. Features have no
/// noise. The colour is `color` of channel and albedo.
fn scene(color: impl Fn(usize, f32) -> f32) -> Buffers {
    let (width, height) = (50, 37);
    let pixels = || (0..height).flat_map(|y| (0..width).map(move |x| (x, y)));
    let buffer = |channels: usize, value: &dyn Fn(usize, (usize, usize)) -> f32| {
        let samples: Vec<f32> = (0..channels)
            .flat_map(|channel| pixels().map(move |pixel| value(channel, pixel)))
            .collect();
        Buffer {
            variance: vec![0.0; samples.len()],
            halves: [samples.clone(), samples],
        }
    };
    let albedo = |channel: usize, (x, y): (usize, usize)| {
        let texture = ((x / 5 + y / 7 + channel) % 3) as f32 / 4.0;
        0.2 + if x > 20 { 0.1 } else { texture }
    };
    Buffers {
        width,
        height,
        color: buffer(3, &|channel, pixel| color(channel, albedo(channel, pixel))),
        normal: buffer(3, &|channel, (x, _)| {
            f32::from(u8::from((channel == 0) == (x > 20)))
        }),
        albedo: buffer(3, &albedo),
        depth: buffer(1, &|_, (x, y)| {
            if x > 20 { 4.0 } else { 5.0 + 0.02 * y as f32 }
        }),
    }
}

/// Adds noise of this deviation to both halves of the colour, and the variance of their mean.
fn add_noise(buffers: &mut Buffers, deviation: f32) {
    let mut rng = ChaCha8Rng::seed_from_u64(5);
    let Buffer { halves, variance } = &mut buffers.color;
    for half in halves {
        for sample in half {
            // Uniform noise of deviation 1 is from -sqrt(3) to sqrt(3).
            let noise: f32 = rng.random_range(-1.0..1.0);
            *sample += 3.0_f32.sqrt() * deviation * noise;
        }
    }
    variance.fill(0.5 * deviation * deviation);
}

/// The mean squared distance of two images.
fn error(a: &[f32], b: &[f32]) -> f32 {
    let squares = a.iter().zip(b).map(|(a, b)| (a - b) * (a - b));
    squares.sum::<f32>() / a.len() as f32
}

fn largest_difference(a: &[f32], b: &[f32]) -> f32 {
    a.iter()
        .zip(b)
        .fold(0.0, |worst, (a, b)| worst.max((a - b).abs()))
}

#[test]
fn a_flat_image_stays_flat() {
    let mut flat = scene(|_, _| 0.7);
    flat.color.variance.fill(0.1);
    let found = flat.denoise().expect("denoised");
    assert!(largest_difference(&found, &flat.color.halves[0]) < 1e-5);
}

#[test]
fn a_linear_function_of_a_feature_is_reproduced() {
    // Variances make weights large across the texture, which a mean would blur.
    let mut textured = scene(|channel, albedo| 0.1 + (channel + 1) as f32 * albedo);
    textured.color.variance.fill(1.0);
    let found = textured.denoise().expect("denoised");
    assert!(largest_difference(&found, &textured.color.halves[0]) < 2e-4);
}

#[test]
fn noise_is_removed_and_the_texture_kept() {
    let clean = scene(|channel, albedo| 0.5 + (channel + 1) as f32 * albedo);
    let mut noisy = clean.clone();
    add_noise(&mut noisy, 0.3);
    let [first, second] = &noisy.color.halves;
    let mean: Vec<f32> = first
        .iter()
        .zip(second)
        .map(|(a, b)| 0.5 * (a + b))
        .collect();
    let truth = &clean.color.halves[0];
    let (before, after) = (
        error(&mean, truth),
        error(&noisy.denoise().expect("denoised"), truth),
    );
    // The mean of 19x19 pixels alone would leave an error of the texture.
    assert!(after < 0.02 * before, "{before} {after}");
}

#[test]
fn extreme_buffers_give_finite_light() {
    let mut extreme = scene(|_, _| 0.0);
    add_noise(&mut extreme, 1.0);
    for (i, sample) in extreme.color.halves[0].iter_mut().enumerate() {
        // Single bright samples beside black, with their variance, and without it.
        *sample = if i % 97 == 0 { 65504.0 } else { 0.0 };
        extreme.color.variance[i] = if i % 194 == 0 {
            65504.0_f32.powi(2)
        } else {
            0.0
        };
    }
    extreme.depth.variance.fill(1e9);
    extreme.depth.halves[1][40] = 1e9;
    let found = extreme.denoise().expect("denoised");
    assert!(
        found
            .iter()
            .all(|sample| sample.is_finite() && *sample >= 0.0)
    );
}

#[test]
fn any_number_of_threads_gives_the_same_bits() {
    let mut noisy = scene(|channel, albedo| 0.5 + (channel + 1) as f32 * albedo);
    add_noise(&mut noisy, 0.3);
    let on = |threads: usize| {
        let pool = rayon::ThreadPoolBuilder::new().num_threads(threads);
        let pool = pool.build().expect("threads");
        pool.install(|| noisy.denoise().expect("denoised"))
    };
    let one = on(1);
    assert!(one == on(2) && one == on(5));
}

#[test]
fn a_buffer_of_another_size_is_named() {
    let mut wrong = scene(|_, _| 0.5);
    wrong.albedo.variance.pop();
    let error = wrong.denoise().expect_err("a wrong size").to_string();
    assert_eq!(error, "albedo has 5549 samples instead of 5550");
}

#[test]
fn depths_of_misses_and_samples_out_of_range_do_not_blacken_the_image() {
    let mut buffers = scene(|_, _| 0.7);
    for samples in &mut buffers.depth.halves {
        samples[..40].fill(1e30);
    }
    assert!(matches!(
        buffers.denoise(),
        Err(NforError::Large {
            buffer: "depth",
            ..
        })
    ));
    buffers.depth.forget_misses();
    let image = buffers.denoise().expect("in range");
    assert!(image.iter().all(|sample| (sample - 0.7).abs() < 1e-3));
    buffers.color.variance[7] = 1e38;
    let error = buffers.denoise().expect_err("out of range").to_string();
    assert_eq!(error, "color has a sample of 1e38; NFOR takes up to 1e15");
}
