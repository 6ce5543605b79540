//! Bands compared with whole maps. `demc-model/tests/inference.rs` compares with Burn's operations.

use burn::tensor::{Device, Tensor, TensorData};
use demc_kernels::conv3x3::Tile;
use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;

use super::{BandPlan, forward_with};
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

fn plan(band: usize) -> BandPlan {
    BandPlan {
        band,
        ..BandPlan::new(1)
    }
}

fn run(model: &Denoiser, size: [usize; 3], tile: Tile, band: usize) -> Vec<f32> {
    let [color, features] = images(size);
    let (out, _) = forward_with(model, color, features, None, tile, plan(band));
    out.into_data().try_to_vec().expect("float32")
}

fn every_network(check: impl Fn(&Denoiser, &str, [usize; 3])) {
    for variant in Variant::ALL {
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
        let (out, layers) =
            forward_with(&model, color, features, Some(layers), Tile::F4, plan(band));
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
    let (out, _) = forward_with(&model, color, features, None, Tile::F4, plan(8));
    let second: Vec<f32> = out.into_data().try_to_vec().expect("float32");
    assert!(both[second.len()..] == second);
}
