//! Invariants of every variant in every reading.

use burn::tensor::{Device, Distribution, Tensor, TensorData};
use demc_model::decoder::Decoder;
use demc_model::init::OPEN_BIAS;
use demc_model::{Denoiser, Detail, Head, ModelConfig, Reading, Variant, Weights, WeightsError};
use rand::SeedableRng;
use rand_chacha::ChaCha8Rng;

const GREY: [f32; 3] = [0.3, 0.4, 0.5];

fn config(variant: Variant, reading: Reading, width: usize) -> ModelConfig {
    ModelConfig {
        variant,
        reading,
        width,
        ..ModelConfig::default()
    }
}

fn network(config: ModelConfig, seed: u64, device: &Device) -> Denoiser {
    config.init(&mut ChaCha8Rng::seed_from_u64(seed), GREY, device)
}

fn decoder(model: &Denoiser) -> &Decoder {
    &model.dual_encoder().expect("a DEMC has encoders").decoder
}

fn every_network() -> impl Iterator<Item = (Variant, Reading)> {
    Variant::with_encoders().flat_map(|v| Reading::ALL.map(|r| (v, r)))
}

fn pattern(shape: [usize; 4], phase: f32, device: &Device) -> Tensor<4> {
    let len = shape.iter().product();
    let values: Vec<f32> = (0..len)
        .map(|i| 0.5 + 0.5 * (i as f32 * 0.37 + phase).sin())
        .collect();
    Tensor::from_data(TensorData::new(values, shape), device)
}

fn values(tensor: Tensor<4>) -> Vec<f32> {
    tensor.into_data().try_to_vec().expect("float32")
}

/// Trainable totals, counted from the paper's text and from the authors' model (docs/network.md).
#[test]
fn parameter_totals_are_the_papers() {
    let totals = [
        (Variant::Demc, Reading::Paper, 64, 42_856_390),
        (Variant::DemcNosn, Reading::Paper, 64, 42_778_755),
        (Variant::Semc, Reading::Paper, 77, 42_998_192),
        (Variant::Demc, Reading::Released, 64, 44_852_678),
        (Variant::DemcNosn, Reading::Released, 64, 44_775_043),
        (Variant::Semc, Reading::Released, 79, 44_985_924),
    ];
    for (variant, reading, width, expected) in totals {
        let found = config(variant, reading, width).parameter_count();
        println!("{variant:?} {reading:?} C = {width}: {found} parameters");
        assert_eq!(found, expected, "{variant:?} {reading:?}");
    }
    for (demc, semc) in [(totals[0].3, totals[2].3), (totals[3].3, totals[5].3)] {
        let excess = semc as f64 / demc as f64 - 1.0;
        assert!(
            excess.abs() < 0.005,
            "SEMC is matched within 0.5 %: {excess}"
        );
    }
}

#[test]
fn output_has_the_inputs_size_and_is_not_negative() {
    let device = Device::flex();
    for (variant, reading) in every_network() {
        let model = network(config(variant, reading, 2), 3, &device);
        let out = model.forward(
            pattern([2, 3, 64, 32], 0.0, &device),
            pattern([2, 12, 64, 32], 1.0, &device),
        );
        assert_eq!(out.dims(), [2, 3, 64, 32]);
        assert!(values(out).iter().all(|v| *v >= 0.0));
    }
}

#[test]
fn same_seed_gives_the_same_network_and_another_seed_another() {
    let device = Device::flex();
    let config = config(Variant::Demc, Reading::Paper, 4);
    let weights = |seed| network(config, seed, &device).weights();
    assert_eq!(weights(1), weights(1));
    assert_ne!(weights(1), weights(2));
}

#[test]
fn a_device_with_autodiff_has_the_same_initial_weights() {
    let config = config(Variant::Demc, Reading::Released, 2);
    let plain = network(config, 5, &Device::flex()).weights();
    assert_eq!(
        plain,
        network(config, 5, &Device::flex().autodiff()).weights()
    );
}

#[test]
fn biases_start_at_zero_except_for_the_grey_head_and_the_open_detail_map() {
    for (variant, reading) in every_network() {
        for weight in network(config(variant, reading, 3), 1, &Device::flex()).weights() {
            if weight.name == "decoder.head.bias" {
                assert_eq!(weight.data, GREY);
            } else if weight.name == "fusion.blocks.3.conv.bias" {
                assert_eq!(weight.data, [OPEN_BIAS; 3]);
            } else if weight.name.ends_with(".bias") {
                assert!(weight.data.iter().all(|v| *v == 0.0), "{}", weight.name);
            }
        }
    }
}

/// The share of zeros in each channel of a new network's detail map.
fn dead_share(detail: Detail, seed: u64) -> Vec<f64> {
    let device = Device::flex();
    let config = ModelConfig {
        detail,
        ..config(Variant::Demc, Reading::Paper, 8)
    };
    let map = network(config, seed, &device).detail_map(pattern([1, 12, 64, 64], 0.5, &device));
    let map = values(map.expect("DEMC has a detail map"));
    let share =
        |plane: &[f32]| plane.iter().filter(|v| **v == 0.0).count() as f64 / plane.len() as f64;
    map.chunks(64 * 64).map(share).collect()
}

#[test]
fn an_open_detail_map_starts_above_zero_nearly_everywhere() {
    let mean_share = |detail| {
        let all: Vec<f64> = (1..=5).flat_map(|seed| dead_share(detail, seed)).collect();
        all.iter().sum::<f64>() / all.len() as f64
    };
    let (open, xavier) = (mean_share(Detail::Open), mean_share(Detail::Xavier));
    assert!(open < 0.2 && xavier > 0.3, "{open} {xavier}");
}

/// Eq. 3: with [I I I] a fusion is the sum of decoder and skips.
#[test]
fn skip_fusion_starts_as_sum_of_parts() {
    let device = Device::flex();
    let model = network(config(Variant::Demc, Reading::Paper, 2), 1, &device);
    let part = |phase| pattern([1, 2, 8, 8], phase, &device);
    let fused = decoder(&model).levels[4]
        .fuse
        .forward(Tensor::cat(vec![part(0.0), part(1.0), part(2.0)], 1));
    let sum = part(0.0) + part(1.0) + part(2.0);
    for (found, expected) in values(fused).into_iter().zip(values(sum)) {
        assert!((found - expected).abs() < 1e-6);
    }
}

/// Sec. 4.2: a bilinear deconvolution keeps a constant image, except at the border, which is padded
/// with zeros.
#[test]
fn deconvolution_starts_as_bilinear_upsampling() {
    let device = Device::flex();
    let model = network(config(Variant::Demc, Reading::Paper, 2), 1, &device);
    let up = decoder(&model).levels[4]
        .deconv
        .forward(Tensor::<4>::ones([1, 4, 4, 4], &device));
    assert_eq!(up.dims(), [1, 2, 8, 8]);
    for y in 1..7 {
        for x in 1..7 {
            let value: f32 = up
                .clone()
                .slice([0..1, 0..1, y..y + 1, x..x + 1])
                .into_scalar();
            assert!((value - 1.0).abs() < 1e-6, "({x}, {y}): {value}");
        }
    }
}

#[test]
fn loaded_weights_are_the_saved_ones() {
    let device = Device::flex();
    for (variant, reading) in every_network() {
        let config = config(variant, reading, 2);
        let weights = network(config, 9, &device).weights();
        let loaded = config
            .load(&mut Weights::new(weights.clone()), &device)
            .unwrap();
        assert_eq!(loaded.weights(), weights);
    }
}

#[test]
fn missing_unknown_and_misshapen_weights_are_refused() {
    let device = Device::flex();
    let config = config(Variant::Demc, Reading::Paper, 2);
    let weights = network(config, 1, &device).weights();

    let missing = config
        .load(&mut Weights::new(weights[1..].to_vec()), &device)
        .unwrap_err();
    assert_eq!(
        missing,
        WeightsError::Missing {
            name: weights[0].name.clone()
        }
    );

    let mut extra = weights.clone();
    extra.push(demc_model::Weight {
        name: "zzz".into(),
        shape: vec![1],
        data: vec![0.0],
    });
    let unknown = config.load(&mut Weights::new(extra), &device).unwrap_err();
    assert_eq!(
        unknown,
        WeightsError::Unknown {
            name: "zzz".into(),
            count: 1
        }
    );

    let wider = ModelConfig { width: 3, ..config };
    let shape = wider.load(&mut Weights::new(weights), &device).unwrap_err();
    assert!(matches!(shape, WeightsError::Shape { .. }), "{shape}");
}

/// A trap of Burn that `Denoiser::weights` avoids: an update of running statistics is merged only
/// at the next one.
#[test]
fn running_statistics_include_the_last_batch() {
    let device = Device::flex().autodiff();
    let model = network(config(Variant::Demc, Reading::Paper, 2), 1, &device);
    let mean = |model: &Denoiser| {
        let weights = model.weights();
        weights
            .into_iter()
            .find(|w| w.name == "fusion.blocks.1.norm.running_mean")
            .unwrap()
            .data
    };
    assert!(mean(&model).iter().all(|v| *v == 0.0));
    model.forward(
        pattern([1, 3, 32, 32], 0.0, &device),
        pattern([1, 12, 32, 32], 1.0, &device),
    );
    assert!(mean(&model).iter().any(|v| *v != 0.0));
}

#[test]
fn every_trainable_weight_gets_a_gradient() {
    let device = Device::flex().autodiff();
    for (variant, reading) in every_network() {
        let model = network(config(variant, reading, 2), 1, &device);
        let color = Tensor::random([2, 3, 64, 64], Distribution::Uniform(0.0, 1.0), &device);
        let features = Tensor::random([2, 12, 64, 64], Distribution::Normal(0.0, 1.0), &device);
        let grads = model.forward(color, features).sum().backward();
        let grads = burn::optim::GradientsParams::from_grads(grads, &model);
        let specs = model.config().weight_specs().into_iter();
        let trainable = specs.filter(|spec| spec.is_trainable()).count();
        assert_eq!(grads.len(), trainable, "{variant:?} {reading:?}");
    }
}

#[test]
#[should_panic(expected = "multiples of 32")]
fn odd_sizes_are_refused() {
    let device = Device::flex();
    let model = network(config(Variant::Demc, Reading::Paper, 1), 1, &device);
    model.forward(
        pattern([1, 3, 48, 32], 0.0, &device),
        pattern([1, 12, 48, 32], 0.0, &device),
    );
}

/// For given features, a kernel head keeps a flat image and scales with the colour.
#[test]
fn a_kernel_head_keeps_flat_images() {
    for (variant, reading) in every_network() {
        for device in [Device::flex(), Device::flex().autodiff()] {
            let head = Head::Kernel;
            let model = network(
                ModelConfig {
                    head,
                    ..config(variant, reading, 2)
                },
                3,
                &device,
            );
            let flat = Tensor::<4>::full([1, 3, 64, 64], 0.6, &device);
            let out = values(model.forward(flat, pattern([1, 12, 64, 64], 1.0, &device)));
            assert!(out.iter().all(|v| (v - 0.6).abs() < 1e-5), "{variant:?}");
        }
    }
}

/// The first pixel depends on nothing beyond 188 pixels of colour and 192 of features, as with the
/// other heads, so tiles stay exact.
#[test]
fn a_kernel_head_has_the_receptive_field_of_the_network() {
    let device = Device::flex();
    let model = network(
        ModelConfig {
            head: Head::Kernel,
            ..config(Variant::Demc, Reading::Paper, 2)
        },
        3,
        &device,
    );
    let run = |color: Tensor<4>, features: Tensor<4>| values(model.forward(color, features));
    let color = pattern([1, 3, 32, 256], 0.0, &device);
    let features = pattern([1, 12, 32, 256], 1.0, &device);
    let expected = run(color.clone(), features.clone());
    let other = |x: Tensor<4>, channels| {
        let far = Tensor::<4>::full([1, channels, 32, 64], 3.0, &device);
        Tensor::cat(vec![x.narrow(3, 0, 192), far], 3)
    };
    let found = run(other(color, 3), other(features, 12));
    assert_ne!(found, expected);
    for channel in 0..3 {
        for row in 0..32 {
            let pixel = (channel * 32 + row) * 256;
            assert_eq!(found[pixel], expected[pixel]);
        }
    }
}
