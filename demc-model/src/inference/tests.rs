//! Bands compared with whole maps. `demc-model/tests/inference.rs` compares with Burn's operations.

use std::ops::ControlFlow;

use burn::tensor::{Device, Tensor, TensorData};
use demc_kernels::conv3x3::Tile;
use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;

use super::forward_with;
use super::pass::BandPlan;
use crate::dual_encoder::DualEncoder;
use crate::{Denoiser, Head, ModelConfig, Ops, Reading, Variant};

/// More rows than any image here, so no bands.
const WHOLE: usize = 4096;

/// Levels that become narrower and wider.
const LEVELS: [usize; 5] = [3, 1, 2, 2, 4];

fn network(variant: Variant, reading: Reading) -> Denoiser {
    initialised(ModelConfig {
        variant,
        reading,
        width: 6,
        head: Head::Xavier,
        ..ModelConfig::default()
    })
}

fn initialised(config: ModelConfig) -> Denoiser {
    let mut rng = ChaCha8Rng::seed_from_u64(7);
    config.init(&mut rng, [0.5; 3], &Device::flex())
}

const SIZES: [[usize; 3]; 3] = [[1, 32, 32], [2, 96, 64], [1, 160, 32]];

fn images([batch, height, width]: [usize; 3]) -> [Tensor<4>; 2] {
    let mut rng = ChaCha8Rng::seed_from_u64(8);
    [3, 12].map(|channels| {
        let shape = [batch, channels, height, width];
        let values: Vec<f32> = (0..shape.iter().product())
            .map(|_| rng.random_range(0.0..1.5f32))
            .collect();
        Tensor::from_data(TensorData::new(values, shape), &Device::flex())
    })
}

fn encoders_of(model: &Denoiser) -> &DualEncoder {
    model.dual_encoder().expect("a variant with encoders")
}

fn plan(band: usize) -> BandPlan {
    BandPlan {
        band,
        ..BandPlan::new(1)
    }
}

fn pass(
    model: &Denoiser,
    images: [Tensor<4>; 2],
    layers: Option<Tensor<4>>,
    tile: Tile,
    band: usize,
) -> (Tensor<4>, Option<Tensor<4>>) {
    let mut observer = |_| ControlFlow::Continue(());
    let done = forward_with(
        encoders_of(model),
        images,
        layers,
        tile,
        plan(band),
        &mut observer,
    );
    done.expect("nobody cancels")
}

fn run(model: &Denoiser, size: [usize; 3], tile: Tile, band: usize) -> Vec<f32> {
    let [color, features] = images(size);
    let (out, _) = pass(model, [color, features], None, tile, band);
    out.into_data().try_to_vec().expect("float32")
}

fn every_network(check: impl Fn(&Denoiser, &str, [usize; 3])) {
    for variant in Variant::with_encoders() {
        for reading in Reading::ALL {
            let model = network(variant, reading);
            let levels = ModelConfig {
                levels: LEVELS,
                ..*model.config()
            };
            for size in SIZES {
                check(&model, &format!("{} {size:?}", model.config()), size);
            }
            check(&initialised(levels), &format!("{levels}"), SIZES[1]);
            let head = Head::Kernel;
            let kernels = initialised(ModelConfig { head, ..levels });
            check(&kernels, &format!("{levels}, kernels"), SIZES[1]);
            check(&kernels, &format!("{levels}, kernels"), SIZES[2]);
        }
    }
}

#[test]
fn bands_give_the_bits_of_whole_maps() {
    every_network(|model, name, size| {
        for tile in [Tile::F2, Tile::F4] {
            let whole = run(model, size, tile, WHOLE);
            for band in [8, 24, 40] {
                assert!(
                    run(model, size, tile, band) == whole,
                    "{name} {tile:?} {band}"
                );
            }
        }
    });
}

#[test]
fn bands_filter_layers_as_whole_maps_do() {
    let model = initialised(ModelConfig {
        width: 6,
        head: Head::Kernel,
        ..ModelConfig::default()
    });
    let run = |band| {
        let [color, features] = images([1, 160, 32]);
        let layers = images([2, 160, 32])[0].clone();
        let (out, layers) = pass(&model, [color, features], Some(layers), Tile::F4, band);
        let host =
            |tensor: Tensor<4>| -> Vec<f32> { tensor.into_data().try_to_vec().expect("float32") };
        (host(out), host(layers.expect("layers")))
    };
    let whole = run(WHOLE);
    for band in [8, 24, 40] {
        assert!(run(band) == whole, "{band}");
    }
}

/// Share of the largest value. Small tiles are as exact as the plain sum; float32 rounds through 27
/// layers.
const TOLERANCE: f32 = 1e-5;

#[test]
fn bands_of_small_tiles_agree_with_burns_operations() {
    every_network(|model, name, size| {
        let found = run(model, size, Tile::F2, 8);
        let [color, features] = images(size);
        let burn = model.clone().with_ops(Ops::Burn);
        let expected: Vec<f32> = burn
            .forward(color, features)
            .into_data()
            .try_to_vec()
            .expect("float32");
        let largest = expected.iter().fold(0.0f32, |m, x| m.max(*x));
        assert!(largest > 0.0, "{name}: black");
        for (f, e) in found.iter().zip(&expected) {
            assert!(
                (f - e).abs() <= TOLERANCE * largest,
                "{name}: {f} instead of {e} of {largest}"
            );
        }
    });
}

#[test]
fn an_image_in_a_batch_has_the_bits_of_the_image_alone() {
    let model = network(Variant::Demc, Reading::Paper);
    let size = [2, 96, 64];
    let both = run(&model, size, Tile::F4, 8);
    let [color, features] = images(size).map(|images| images.narrow(0, 1, 1));
    let (out, _) = pass(&model, [color, features], None, Tile::F4, 8);
    let second: Vec<f32> = out.into_data().try_to_vec().expect("float32");
    assert!(both[second.len()..] == second);
}

#[test]
fn progress_rises_to_the_end_on_whole_maps_and_in_bands() {
    every_network(|model, name, size| {
        for band in [8, WHOLE] {
            let mut shares = Vec::new();
            let mut observer = |share| {
                shares.push(share);
                ControlFlow::Continue(())
            };
            let done = forward_with(
                encoders_of(model),
                images(size),
                None,
                Tile::F4,
                plan(band),
                &mut observer,
            );
            done.expect("nobody cancels");
            assert!(shares.is_sorted(), "{name}: {shares:?}");
            let last = shares.last().expect("several calls");
            assert!((0.99..=1.0).contains(last), "{name}, {band}: {last}");
        }
    });
}

#[test]
fn every_call_of_the_observer_can_cancel() {
    let model = network(Variant::Demc, Reading::Paper);
    let run = |stop: usize| {
        let mut calls = 0;
        let mut observer = |_| {
            calls += 1;
            if calls == stop {
                ControlFlow::Break(())
            } else {
                ControlFlow::Continue(())
            }
        };
        let size = [1, 96, 64];
        let done = forward_with(
            encoders_of(&model),
            images(size),
            None,
            Tile::F4,
            plan(8),
            &mut observer,
        );
        (done.is_ok(), calls)
    };
    let (done, all) = run(usize::MAX);
    assert!(done && all > 20, "{all}");
    for stop in 1..=all {
        assert_eq!(run(stop), (false, stop));
    }
}
