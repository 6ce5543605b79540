//! The U-Net: its inference against its modules, and what its guides do.

use burn::tensor::{Device, Tensor};
use demc_model::unet::{Guides, UnetSize};
use demc_model::{Denoiser, ModelConfig, Ops, Variant};
use rand::SeedableRng;
use rand_chacha::ChaCha8Rng;

fn network(size: UnetSize, guides: Guides) -> Denoiser {
    let config = ModelConfig {
        variant: Variant::Unet,
        size,
        guides,
        ..ModelConfig::default()
    };
    let mut rng = ChaCha8Rng::seed_from_u64(3);
    config.init(&mut rng, [0.0; 3], &Device::flex())
}

fn noise(channels: usize, [batch, height, width]: [usize; 3]) -> Tensor<4> {
    let shape = [batch, channels, height, width];
    let values: Vec<f32> = (0..shape.iter().product())
        .map(|i: usize| (i as f32 * 12.9898).sin() + 1.0)
        .collect();
    Tensor::<1>::from_floats(values.as_slice(), &Device::flex()).reshape(shape)
}

fn values(tensor: Tensor<4>) -> Vec<f32> {
    tensor.into_data().try_to_vec().expect("float32")
}

/// Bands, doubling in place, and Winograd give what the modules define. 560 rows are several bands.
#[test]
fn inference_agrees_with_burns_operations() {
    let cases = [
        (UnetSize::Small, Guides::None, [2, 16, 48]),
        (UnetSize::Base, Guides::Albedo, [1, 80, 32]),
        (UnetSize::Base, Guides::AlbedoNormal, [1, 560, 1024]),
        (UnetSize::Large, Guides::AlbedoNormal, [1, 32, 48]),
    ];
    for (size, guides, shape) in cases {
        let (color, features) = (noise(3, shape), noise(12, shape));
        let [found, expected] = Ops::ALL.map(|ops| {
            let model = network(size, guides).with_ops(ops);
            values(model.forward(color.clone(), features.clone()))
        });
        let largest = expected.iter().fold(0.0f32, |m, x| m.max(*x));
        assert!(largest > 0.1, "{size:?}: black");
        for (found, expected) in found.iter().zip(&expected) {
            let difference = (found - expected).abs() / largest;
            assert!(difference < 5e-5, "{size:?}: {found} {expected}");
        }
    }
}

/// Normals are channels 0 to 2, the albedo is 6 to 8; nothing else counts.
#[test]
fn only_the_guides_count() {
    let shape = [1, 16, 16];
    let color = noise(3, shape);
    for (guides, taken) in [
        (Guides::None, Vec::new()),
        (Guides::Albedo, vec![6, 7, 8]),
        (Guides::AlbedoNormal, vec![0, 1, 2, 6, 7, 8]),
    ] {
        let model = network(UnetSize::Small, guides);
        let with = |channel: Option<usize>| {
            let mut planes: Vec<Tensor<4>> = noise(12, shape).split(1, 1);
            if let Some(channel) = channel {
                planes[channel] = planes[channel].clone().mul_scalar(0.5);
            }
            values(model.forward(color.clone(), Tensor::cat(planes, 1)))
        };
        let unchanged = with(None);
        for channel in 0..12 {
            let counts = taken.contains(&channel);
            assert_eq!(
                with(Some(channel)) != unchanged,
                counts,
                "{guides:?} {channel}"
            );
            assert_eq!(model.config().takes_feature(channel), counts);
        }
    }
}
