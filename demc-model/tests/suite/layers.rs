//! Layers that a kernel head filters beside the colour, with the kernels and with Burn's operations.

use burn::tensor::{Device, Tensor, TensorData};
use demc_model::{Denoiser, Head, ModelConfig, Ops, Reading, Variant, Weights};
use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;

/// Share of the largest value: float32 rounds in sums of 25 products on four scales, and in the
/// powers of gamma.
const TOLERANCE: f32 = 2e-6;

const SIZE: [usize; 2] = [96, 64];

/// A network with a kernel head whose kernels differ from pixel to pixel.
fn network(reading: Reading) -> Denoiser {
    let config = ModelConfig {
        variant: Variant::Demc,
        reading,
        width: 4,
        head: Head::Kernel,
        ..ModelConfig::default()
    };
    let mut rng = ChaCha8Rng::seed_from_u64(5);
    let model = config.init(&mut rng, [0.5; 3], &Device::flex());
    let mut weights = model.weights();
    for weight in &mut weights {
        if weight.name.contains("kernels") {
            let random = |value: &mut f32| *value = rng.random_range(-1.0..1.0);
            weight.data.iter_mut().for_each(random);
        }
    }
    let mut weights = Weights::new(weights);
    config
        .load(&mut weights, &Device::flex())
        .expect("its own weights")
}

/// Random values, as planes and as a tensor.
fn images(seed: u64, [batch, channels]: [usize; 2], low: f32) -> (Vec<f32>, Tensor<4>) {
    let mut rng = ChaCha8Rng::seed_from_u64(seed);
    let shape = [batch, channels, SIZE[0], SIZE[1]];
    let values: Vec<f32> = (0..shape.iter().product())
        .map(|_| rng.random_range(low..2.0f32))
        .collect();
    (values.clone(), tensor(values, [batch, channels]))
}

fn tensor(values: Vec<f32>, [batch, channels]: [usize; 2]) -> Tensor<4> {
    let shape = [batch, channels, SIZE[0], SIZE[1]];
    Tensor::from_data(TensorData::new(values, shape), &Device::flex())
}

fn host(tensor: Tensor<4>) -> Vec<f32> {
    tensor.into_data().try_to_vec().expect("float32")
}

fn gamma(values: &[f32]) -> Vec<f32> {
    values.iter().map(|x| x.powf(1.0 / 2.2)).collect()
}

fn assert_near(what: &str, found: &[f32], expected: &[f32]) {
    assert_eq!(found.len(), expected.len());
    let largest = expected.iter().fold(0.0f32, |m, x| m.max(x.abs()));
    for (i, (f, e)) in found.iter().zip(expected).enumerate() {
        let error = (f - e).abs();
        assert!(
            error <= TOLERANCE * largest,
            "{what}: value {i}: {f} instead of {e}, largest {largest}"
        );
    }
}

#[test]
fn layers_that_add_up_to_the_colour_still_do() {
    for reading in Reading::ALL {
        for ops in Ops::ALL {
            let model = network(reading).with_ops(ops);
            let (values, layers) = images(1, [3, 3], 0.0);
            let image = values.len() / 3;
            let sum = |values: &[f32]| -> Vec<f32> {
                let of_pixel = |i| values[i] + values[image + i] + values[2 * image + i];
                (0..image).map(of_pixel).collect()
            };
            let color = tensor(gamma(&sum(&values)), [1, 3]);
            let (_, features) = images(2, [1, 12], -1.0);
            let (denoised, layers) = model.forward_with_layers(color, features, layers);
            let denoised: Vec<f32> = host(denoised).iter().map(|x| x.powf(2.2)).collect();
            let layers = host(layers);
            assert_near(&format!("{reading:?} {ops}"), &sum(&layers), &denoised);
            let changed = layers.iter().zip(&values).any(|(a, b)| (a - b).abs() > 0.1);
            assert!(changed, "{reading:?} {ops}: the layers are not filtered");
        }
    }
}

#[test]
fn the_colour_is_the_same_with_layers_and_without() {
    for ops in Ops::ALL {
        let model = network(Reading::Paper).with_ops(ops);
        let inputs = || (images(3, [1, 3], 0.0).1, images(2, [1, 12], -1.0).1);
        let (color, features) = inputs();
        let alone = model.forward(color, features);
        let (color, features) = inputs();
        let (_, layers) = images(4, [2, 3], -1.0);
        let (beside, _) = model.forward_with_layers(color, features, layers);
        assert_eq!(host(alone), host(beside), "{ops}");
    }
}

#[test]
fn a_flat_layer_of_either_sign_stays_flat() {
    for ops in Ops::ALL {
        let model = network(Reading::Released).with_ops(ops);
        let (_, color) = images(3, [1, 3], 0.0);
        let (_, features) = images(2, [1, 12], -1.0);
        let flat: Vec<f32> = [0.7, -0.4]
            .iter()
            .flat_map(|x| vec![*x; 3 * SIZE[0] * SIZE[1]])
            .collect();
        let layers = tensor(flat.clone(), [2, 3]);
        let (_, filtered) = model.forward_with_layers(color, features, layers);
        assert_near(ops.name(), &host(filtered), &flat);
    }
}

#[test]
fn the_kernels_filter_layers_as_burns_operations_do() {
    let filtered = Ops::ALL.map(|ops| {
        let model = network(Reading::Paper).with_ops(ops);
        let (_, color) = images(3, [1, 3], 0.0);
        let (_, features) = images(2, [1, 12], -1.0);
        let (_, layers) = images(4, [4, 3], -1.0);
        host(model.forward_with_layers(color, features, layers).1)
    });
    let [found, expected] = &filtered;
    // The logits also differ by the rounding of 27 layers (F(4x4, 3x3): 2e-5).
    let largest = expected.iter().fold(0.0f32, |m, x| m.max(x.abs()));
    for (f, e) in found.iter().zip(expected) {
        assert!((f - e).abs() <= 2e-4 * largest, "{f} instead of {e}");
    }
}

#[test]
#[should_panic(expected = "layers need kernels")]
fn a_head_that_makes_colour_filters_no_layers() {
    let config = ModelConfig {
        width: 1,
        ..ModelConfig::default()
    };
    let mut rng = ChaCha8Rng::seed_from_u64(5);
    let model = config.init(&mut rng, [0.5; 3], &Device::flex());
    let (_, color) = images(3, [1, 3], 0.0);
    let (_, features) = images(2, [1, 12], 0.0);
    let (_, layers) = images(4, [1, 3], 0.0);
    model.forward_with_layers(color, features, layers);
}
