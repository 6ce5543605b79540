//! The U-Net: its inference against its modules, and what its guides do.

use burn::tensor::{Device, Tensor};
use demc_model::unet::{Guides, UnetSize};
use demc_model::{Denoiser, ModelConfig, Ops, Variant, Weights};
use rand::SeedableRng;
use rand_chacha::ChaCha8Rng;

fn config(size: UnetSize, guides: Guides) -> ModelConfig {
    ModelConfig {
        variant: Variant::Unet,
        size,
        guides,
        ..ModelConfig::default()
    }
}

fn network(config: ModelConfig) -> Denoiser {
    let mut rng = ChaCha8Rng::seed_from_u64(3);
    config.init(&mut rng, [0.0; 3], &Device::flex())
}

/// The networks that start as a U-Net: second encoders beside it.
fn grown() -> [ModelConfig; 2] {
    [Variant::UnetNosn, Variant::UnetDemc].map(|variant| ModelConfig {
        variant,
        width: 8,
        ..config(UnetSize::Small, Guides::AlbedoNormal)
    })
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
        (config(UnetSize::Small, Guides::None), [2, 16, 48]),
        (config(UnetSize::Base, Guides::Albedo), [1, 80, 32]),
        (config(UnetSize::Base, Guides::AlbedoNormal), [1, 560, 1024]),
        (config(UnetSize::Large, Guides::AlbedoNormal), [1, 32, 48]),
    ];
    let others = grown().into_iter().map(|config| (config, [2, 96, 64]));
    let banded = grown().map(|config| (config, [1, 560, 1024]));
    for (config, shape) in cases.into_iter().chain(others).chain(banded) {
        let (color, features) = (noise(3, shape), noise(12, shape));
        let [found, expected] = Ops::ALL.map(|ops| {
            let model = moved(&network(config)).with_ops(ops);
            values(model.forward(color.clone(), features.clone()))
        });
        let largest = expected.iter().fold(0.0f32, |m, x| m.max(*x));
        assert!(largest > 0.1, "{config}: black");
        for (found, expected) in found.iter().zip(&expected) {
            let difference = (found - expected).abs() / largest;
            assert!(difference < 5e-5, "{config}: {found} {expected}");
        }
    }
}

/// A network whose biases and fusions are not where they start.
fn moved(model: &Denoiser) -> Denoiser {
    let mut weights = model.weights();
    for (index, weight) in weights.iter_mut().enumerate() {
        if weight.name.ends_with("bias") || weight.name.contains("fuses") {
            let values = weight.data.iter_mut().zip(index..);
            values.for_each(|(value, i)| *value += 0.05 * (i as f32).sin());
        }
    }
    let loaded = model
        .config()
        .load(&mut Weights::new(weights), &Device::flex());
    loaded.expect("its own weights")
}

/// A second encoder adds nothing before the first step.
#[test]
fn a_grown_network_starts_as_its_trunk() {
    let shape = [1, 32, 48];
    let (color, features) = (noise(3, shape), noise(12, shape));
    for config in grown() {
        let trunk = network(config.trunk().expect("a U-Net"));
        let whole = network(config);
        let mut weights = whole.weights();
        for weight in &mut weights {
            let own = trunk.weights().into_iter();
            if let Some(own) = own.into_iter().find(|own| own.name == weight.name) {
                *weight = own;
            }
        }
        let whole = config.load(&mut Weights::new(weights), &Device::flex());
        let whole = whole.expect("its own weights");
        let [whole, trunk] = [whole, trunk].map(|model| {
            values(
                model
                    .with_ops(Ops::Burn)
                    .forward(color.clone(), features.clone()),
            )
        });
        assert!(whole.iter().any(|value| *value > 0.1), "{config}: black");
        assert_eq!(whole, trunk, "{config}");
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
        let model = network(config(UnetSize::Small, guides));
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
