//! The memory that a pass allocates, compared with its estimate.
#![cfg(target_os = "linux")]

use burn::tensor::{Device, Tensor};
use demc_kernels::memory::used;
use demc_model::config::LEVEL_WIDTHS as PAPER;
use demc_model::inference::pass_bytes;
use demc_model::{Head, ModelConfig, Ops, Reading, Variant};
use rand::SeedableRng;
use rand_chacha::ChaCha8Rng;

use crate::alone::run_alone;

/// Relative tolerance: blocks below 2 MiB are not counted, and threads peak at different times.
const TOLERANCE: f64 = 0.1;

/// Levels whose channels hardly grow.
const EVEN: [usize; 5] = [2, 3, 4, 4, 4];

/// Levels whose channels grow faster than the pixels shrink.
const STEEP: [usize; 5] = [2, 12, 12, 16, 16];

/// On two threads, because bands and working memory grow with the number of threads.
#[test]
fn the_estimate_agrees_with_the_allocations() {
    let threads = rayon::ThreadPoolBuilder::new().num_threads(2).build();
    let name = "memory::the_estimate_agrees_with_the_allocations";
    run_alone(name, || threads.expect("threads").install(check));
}

#[test]
fn the_estimate_of_a_second_encoder_agrees_with_the_allocations() {
    let name = "memory::the_estimate_of_a_second_encoder_agrees_with_the_allocations";
    let threads = rayon::ThreadPoolBuilder::new().num_threads(2).build();
    let config = ModelConfig {
        variant: Variant::UnetDemc,
        width: 16,
        ..ModelConfig::default()
    };
    run_alone(name, || {
        let threads = threads.expect("threads");
        threads.install(|| assert_estimate(config, [1088, 1920], 0));
    });
}

fn check() {
    // In the order of their sizes: only the process's peak so far is known.
    let cases = [
        (Variant::Demc, Reading::Paper, 24, PAPER, [512, 512], 0),
        (Variant::DemcNosn, Reading::Paper, 24, PAPER, [1024, 512], 0),
        (Variant::Demc, Reading::Released, 24, PAPER, [768, 1024], 0),
        (Variant::Semc, Reading::Paper, 32, PAPER, [736, 1280], 0),
        (Variant::Kpcn, Reading::Paper, 32, PAPER, [256, 512], 0),
        (Variant::Unet, Reading::Paper, 64, PAPER, [1088, 1920], 0),
        (Variant::Demc, Reading::Paper, 32, PAPER, [1088, 1920], 0),
        (
            Variant::ColorOnly,
            Reading::Released,
            16,
            EVEN,
            [1536, 2560],
            0,
        ),
        (Variant::Demc, Reading::Paper, 32, EVEN, [1088, 1920], 0),
        (Variant::Demc, Reading::Paper, 32, STEEP, [1088, 1920], 0),
        (Variant::Demc, Reading::Paper, 16, EVEN, [1536, 2560], 9),
    ];
    for (variant, reading, width, levels, [height, columns], layers) in cases {
        let config = ModelConfig {
            variant,
            reading,
            width,
            levels,
            // A network for albedo.
            head: match variant {
                Variant::ColorOnly => Head::Kernel,
                _ if layers > 0 => Head::Kernel,
                _ => Head::Grey,
            },
            ..ModelConfig::default()
        };
        assert_estimate(config, [height, columns], layers);
    }
}

/// Runs a pass, which must have the highest peak of the process so far.
fn assert_estimate(config: ModelConfig, [height, columns]: [usize; 2], layers: usize) {
    let device = Device::flex();
    let mut rng = ChaCha8Rng::seed_from_u64(1);
    let model = config.init(&mut rng, [0.5; 3], &device);
    let [before, _] = used();
    let colors = config.variant.spec().color_channels;
    let image = |channels| Tensor::<4>::ones([1, channels, height, columns], &device);
    let out = match layers {
        0 => model.forward(image(colors), image(12)),
        _ => {
            let shape = [layers, 3, height, columns];
            let images = Tensor::<4>::ones(shape, &device);
            let (out, filtered) = model.forward_with_layers(image(3), image(12), images);
            assert_eq!(filtered.dims(), shape);
            out
        }
    };
    let [_, peak] = used();
    assert_eq!(out.dims(), [1, colors, height, columns]);
    let (measured, estimate) = (
        peak - before,
        pass_bytes(Ops::Kernels, &config, height, columns, layers),
    );
    let ratio = estimate as f64 / measured as f64;
    println!(
        "{config:?} {height}x{columns}, {layers} layers: {} MiB estimated, {} MiB measured",
        estimate >> 20,
        measured >> 20
    );
    assert!(
        (ratio - 1.0).abs() <= TOLERANCE,
        "{config:?}: {estimate} bytes estimated, {measured} measured"
    );
}
