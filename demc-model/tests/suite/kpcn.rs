//! KPCN: its size, its inference, and what its kernels keep.

use burn::tensor::{Device, Tensor};
use demc_model::{ModelConfig, Ops, Variant};
use rand::SeedableRng;
use rand_chacha::ChaCha8Rng;

fn config(width: usize) -> ModelConfig {
    ModelConfig {
        variant: Variant::Kpcn,
        width,
        ..ModelConfig::default()
    }
}

fn images(ops: Ops, color: &Tensor<4>, features: &Tensor<4>) -> Vec<f32> {
    let mut rng = ChaCha8Rng::seed_from_u64(3);
    let model = config(8).init(&mut rng, [0.0; 3], &Device::flex());
    let out = model.with_ops(ops).forward(color.clone(), features.clone());
    assert_eq!(out.dims(), color.dims());
    out.into_data().try_to_vec().expect("float32")
}

fn noise(channels: usize) -> Tensor<4> {
    let shape = [2, channels, 32, 64];
    let count: usize = shape.iter().product();
    let values: Vec<f32> = (0..count)
        .map(|i| (i as f32 * 12.9898).sin() + 1.0)
        .collect();
    Tensor::<1>::from_floats(values.as_slice(), &Device::flex()).reshape(shape)
}

/// The paper's network: 9 layers of 5x5, width 100, 21x21 kernels, 34 channels as input.
#[test]
fn it_has_the_size_of_the_papers() {
    let inner = 100 * 100 * 25 + 100;
    let network = 34 * 100 * 25 + 100 + 7 * inner + 441 * 100 * 25 + 441;
    assert_eq!(config(100).parameter_count(), 2 * network as u64);
    assert_eq!(config(100).parameter_count(), 5_877_482);
}

#[test]
fn kernels_agree_with_burns_operations() {
    let (color, features) = (noise(6), noise(12));
    let [found, expected] = Ops::ALL.map(|ops| images(ops, &color, &features));
    for (found, expected) in found.iter().zip(&expected) {
        assert!((found - expected).abs() < 1e-5, "{found} {expected}");
    }
}

/// The weights of a kernel add up to 1.
#[test]
fn a_flat_image_stays_flat() {
    let color = Tensor::<4>::ones([1, 6, 32, 32], &Device::flex()).mul_scalar(0.7);
    let features = noise(12).slice([0..1, 0..12, 0..32, 0..32]);
    for value in images(Ops::Kernels, &color, &features) {
        assert!((value - 0.7).abs() < 1e-5, "{value}");
    }
}

/// A pixel depends on 18 pixels in each direction through the convolutions, on 10 through its
/// kernel, and on one more through the differences.
#[test]
fn a_pixel_reaches_29_pixels() {
    let (color, features) = (noise(6), noise(12));
    let plain = images(Ops::Kernels, &color, &features);
    let values: Vec<f32> = color.clone().into_data().try_to_vec().expect("float32");
    let mut changed = values;
    changed[0] += 1.0;
    let changed =
        Tensor::<1>::from_floats(changed.as_slice(), &Device::flex()).reshape(color.dims());
    let after = images(Ops::Kernels, &changed, &features);
    let differing = (0..64).filter(|x| plain[*x] != after[*x]).max();
    assert!(
        differing.is_some_and(|x| (11..29).contains(&x)),
        "{differing:?}"
    );
    assert_eq!(plain[3 * 32 * 64..], after[3 * 32 * 64..], "specular light");
}
