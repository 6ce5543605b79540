//! Tests of layers with a narrow network on frames with a pattern.

use demc_data::Frame;
use demc_data::Transfer;
use demc_data::image::frame::TEXTURES;
use demc_model::{Ops, Variant, Weights};
use rand::RngExt;
use rand_chacha::ChaCha8Rng;
use rand_chacha::rand_core::SeedableRng;

use super::*;
use crate::bundle::testing::{bundle, filtered, frame, kernel_bundle};

/// Share of the largest value, as documented.
const TOLERANCE: f32 = 1e-4;

/// A model that demodulates, filters albedo, and restores light.
fn model() -> Bundle {
    let mut bundle = kernel_bundle();
    bundle.meta.normalizer.albedo_demodulation_epsilon = Some(0.07);
    bundle.meta.normalizer.restore_light = true;
    bundle.albedo_filter = filtered(Variant::Demc, Variant::DemcNosn).albedo_filter;
    bundle
}

/// A model without kernels that demodulates, filters albedo, and restores light.
fn plain_model() -> Bundle {
    let mut bundle = model();
    let plain = self::bundle(Variant::Demc);
    (bundle.model, bundle.meta.model) = (plain.model, plain.meta.model);
    bundle
}

/// A U-Net with a second encoder, whose image is not black.
fn unet() -> Bundle {
    let mut bundle = bundle(Variant::UnetNosn);
    bundle.meta.normalizer.transfer = Transfer::Pu;
    bundle.meta.normalizer.exposure_level = Some(0.18);
    let mut weights = bundle.model.weights();
    for weight in &mut weights {
        if weight.name.starts_with("head.") {
            let positive = |value: &mut f32| *value = 0.1 * value.abs() + 1e-3;
            weight.data.iter_mut().for_each(positive);
        }
    }
    let loaded = (bundle.meta.model).load(&mut Weights::new(weights), &bundle.device());
    bundle.model = loaded.expect("its own weights");
    bundle
}

/// Three random passes of red, green and blue, and the frame whose colour is their sum.
fn passes(width: usize, height: usize) -> (Frame, Vec<Layer>) {
    let mut rng = ChaCha8Rng::seed_from_u64(4);
    let pixels = width * height;
    let mut frame = frame(width, height);
    frame.color.fill(0.0);
    let mut layers = Vec::new();
    for pass in ["Diffuse", "Glossy", "Emission"] {
        for (color, name) in ["R", "G", "b"].iter().enumerate() {
            let plane = &mut frame.color[color * pixels..(color + 1) * pixels];
            let sample = |sum: &mut f32| {
                let value = rng.random_range(0.0..1.0f32).powi(8) * 5.0;
                *sum += value;
                value
            };
            layers.push(Layer {
                name: format!("ViewLayer.{pass}.{name}"),
                samples: plane.iter_mut().map(sample).collect(),
            });
        }
    }
    (frame, layers)
}

fn run(bundle: &Bundle, frame: &Frame, layers: &[Layer], tiling: Tiling) -> Denoised {
    let options = DenoiseOptions {
        tiling,
        layers: layers.to_vec(),
        ..DenoiseOptions::default()
    };
    let denoised = bundle.denoise_with(frame, &options, unobserved);
    denoised.expect("denoised")
}

/// Largest difference, as a share of the largest expected value.
fn difference(found: &[f32], expected: &[f32]) -> f32 {
    assert_eq!(found.len(), expected.len());
    let largest = |values: &mut dyn Iterator<Item = f32>| values.fold(0.0, f32::max);
    let differences = &mut found.iter().zip(expected).map(|(a, b)| (a - b).abs());
    largest(differences) / largest(&mut expected.iter().map(|x| x.abs()))
}

#[test]
fn layers_that_add_up_to_the_colour_still_do() {
    check_sums(model);
}

#[test]
fn layers_of_a_network_without_kernels_add_up_to_its_image() {
    check_sums(plain_model);
    check_sums(unet);
}

/// Layers that do not add up to the colour are what the network makes of them as an image.
#[test]
fn layers_of_a_network_without_kernels_are_images_of_their_own() {
    for model in [plain_model(), unet()] {
        let (frame, layers) = passes(50, 70);
        let alone = |color: Vec<f32>, model: &Bundle| {
            let mut frame = frame.clone();
            frame.color = color;
            let options = DenoiseOptions {
                ensemble: Ensemble::Four,
                ..DenoiseOptions::default()
            };
            let denoised = model.denoise_with(&frame, &options, unobserved);
            denoised.expect("denoised").color_hdr
        };
        // A grey layer, then blue, green, and red.
        let chosen: Vec<Layer> = layers[..4].iter().rev().cloned().collect();
        let samples = |layer: &Layer| layer.samples.clone();
        let color: Vec<f32> = layers[..3].iter().flat_map(samples).collect();
        let options = DenoiseOptions {
            ensemble: Ensemble::Four,
            layers: chosen.clone(),
            ..DenoiseOptions::default()
        };
        let found = model.denoise_with(&frame, &options, unobserved);
        let found = found.expect("denoised");
        assert_eq!(found.color_hdr, alone(frame.color.clone(), &model));
        let found: Vec<&[f32]> = found.layers.chunks_exact(50 * 70).collect();
        let expected = alone(color, &model);
        for (index, expected) in expected.chunks_exact(50 * 70).enumerate() {
            assert_eq!(found[3 - index], expected, "{index}");
        }
        let mut plain = model;
        plain.meta.normalizer.albedo_demodulation_epsilon = None;
        let grey = alone(chosen[0].samples.repeat(3), &plain);
        let planes: Vec<&[f32]> = grey.chunks_exact(50 * 70).collect();
        let means = (0..50 * 70).map(|i| planes.iter().map(|plane| plane[i]).sum::<f32>() / 3.0);
        let means: Vec<f32> = means.collect();
        assert_eq!(found[0], means);
    }
}

#[test]
fn a_grey_layer_of_one_value_stays() {
    let (frame, _) = passes(50, 70);
    let alpha = Layer {
        name: "Combined.A".into(),
        samples: vec![0.7; 50 * 70],
    };
    for model in [plain_model(), unet()] {
        let found = run(
            &model,
            &frame,
            std::slice::from_ref(&alpha),
            Tiling::default(),
        );
        assert_eq!(found.layers, alpha.samples);
    }
}

#[test]
fn the_share_grows_once_over_the_passes_of_all_layers() {
    let mut bundle = plain_model();
    bundle.albedo_filter = None;
    let (frame, layers) = passes(490, 70);
    let options = DenoiseOptions {
        tiling: Tiling {
            side: Some(224),
            ..Tiling::default()
        },
        layers,
        ..DenoiseOptions::default()
    };
    let mut shares = Vec::new();
    let denoised = bundle.denoise_with(&frame, &options, |progress| {
        shares.push(progress.share);
        ControlFlow::Continue(())
    });
    assert!(denoised.expect("denoised").tiles.count() > 1);
    assert!(shares.is_sorted() && shares[0] == 0.0, "{shares:?}");
    assert!(shares[shares.len() - 1] > 0.99, "{shares:?}");
    let steps = shares.windows(2).map(|pair| pair[1] - pair[0]);
    assert!(steps.fold(0.0, f64::max) < 0.2, "{shares:?}");
}

/// Whole and in tiles, of sizes with padding, with the kernels and with Burn's operations.
fn check_sums(model: impl Fn() -> Bundle) {
    let tiled = Tiling {
        side: Some(224),
        ..Tiling::default()
    };
    for (size, tiling) in [((50, 70), Tiling::default()), ((490, 70), tiled)] {
        for ops in Ops::ALL {
            let mut bundle = model();
            bundle.model = bundle.model.with_ops(ops);
            let (frame, layers) = passes(size.0, size.1);
            let denoised = run(&bundle, &frame, &layers, tiling);
            let image = denoised.color_hdr.len();
            let mut sum = vec![0.0; image];
            for pass in denoised.layers.chunks_exact(image) {
                sum.iter_mut().zip(pass).for_each(|(sum, x)| *sum += x);
            }
            let error = difference(&sum, &denoised.color_hdr);
            assert!(error <= TOLERANCE, "{size:?} {ops}: {error}");
            let change = difference(&denoised.color_hdr, &frame.color);
            assert!(change > 0.1, "{size:?} {ops}: nothing is filtered");
        }
    }
}

#[test]
fn tiles_of_layers_are_those_of_the_whole_image() {
    let bundle = model();
    let (frame, layers) = passes(490, 450);
    let whole = run(&bundle, &frame, &layers[..4], Tiling::default());
    let tiling = Tiling {
        side: Some(224),
        ..Tiling::default()
    };
    let tiled = run(&bundle, &frame, &layers[..4], tiling);
    assert!(tiled.tiles.count() >= 4);
    assert_eq!(whole.tiles.count(), 1);
    let difference = difference(&tiled.layers, &whole.layers);
    assert!(difference <= 4e-6, "{difference}");
}

#[test]
fn colour_and_alpha_are_the_same_with_layers_and_without() {
    let bundle = model();
    let (mut frame, layers) = passes(50, 70);
    frame.alpha = Some((0..50 * 70).map(|i| (i % 7) as f32 / 7.0).collect());
    let with = run(&bundle, &frame, &layers, Tiling::default());
    let without = run(&bundle, &frame, &[], Tiling::default());
    assert_eq!(with.color_hdr, without.color_hdr);
    assert_eq!(with.alpha, without.alpha);
    assert!(without.layers.is_empty());
}

/// A red layer of constant light on the albedo, and a flat alpha and a negative depth.
#[test]
fn each_layer_has_the_albedo_of_its_own_colour() {
    let mut bundle = model();
    bundle.albedo_filter = None;
    bundle.meta.normalizer.restore_light = false;
    let frame = frame(50, 70);
    let pixels = 50 * 70;
    let albedo = |color: usize| &frame.features[(TEXTURES + color) * pixels..][..pixels];
    let layer = |name: &str, samples: Vec<f32>| Layer {
        name: name.into(),
        samples,
    };
    let lit = |color: usize| albedo(color).iter().map(|a| 0.8 * (a + 0.07)).collect();
    let layers = [
        layer("lamp.R", lit(0)),
        layer("lamp.b", lit(2)),
        layer("Combined.A", vec![0.6; pixels]),
        layer("depth.Z", vec![-3.0; pixels]),
    ];
    let denoised = run(&bundle, &frame, &layers, Tiling::default());
    for (layer, found) in layers.iter().zip(denoised.layers.chunks_exact(pixels)) {
        let error = difference(found, &layer.samples);
        assert!(error <= 1e-5, "{}: {error}", layer.name);
    }
    let other = [layer("lamp.G", lit(0))];
    let denoised = run(&bundle, &frame, &other, Tiling::default());
    assert!(difference(&denoised.layers, &other[0].samples) > 1e-2);
}

#[test]
fn the_tile_plan_counts_the_layers() {
    let bundle = kernel_bundle();
    let (frame, layers) = passes(450, 900);
    let layers = &layers[..3];
    let tiling = Tiling {
        memory: Some(bundle.pass_bytes(928, 480)),
        ..Tiling::default()
    };
    assert_eq!(run(&bundle, &frame, &[], tiling).tiles.count(), 1);
    assert!(run(&bundle, &frame, layers, tiling).tiles.count() > 1);
}

#[test]
fn layers_that_cannot_be_filtered_are_refused() {
    let frame = frame(8, 8);
    let refuse = |bundle: &Bundle, samples: usize, ensemble: Ensemble| {
        let options = DenoiseOptions {
            ensemble,
            layers: vec![Layer {
                name: "lamp.R".into(),
                samples: vec![0.5; samples],
            }],
            ..DenoiseOptions::default()
        };
        match bundle.denoise_with(&frame, &options, unobserved) {
            Err(DenoiseError::Layers { source, .. }) => source,
            other => panic!("{other:?}"),
        }
    };
    assert_eq!(
        refuse(&bundle(Variant::Kpcn), 64, Ensemble::One),
        LayersError::Kpcn
    );
    assert_eq!(
        refuse(&model(), 64, Ensemble::Four),
        LayersError::Ensemble { count: 4 }
    );
    for model in [model(), bundle(Variant::Demc)] {
        let error = refuse(&model, 63, Ensemble::One);
        assert_eq!(
            error.to_string(),
            "layer lamp.R holds 63 values; the image has 64 pixels"
        );
    }
}
