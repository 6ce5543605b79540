//! What a pass really allocates, against what is said before.
//!
//! A file of its own, with one test: all that runs in its process is counted.

use burn::tensor::{Device, Tensor};
use demc_kernels::memory::{Recycler, used};
use demc_model::config::LEVEL_WIDTHS as PAPERS;
use demc_model::inference::peak_bytes;
use demc_model::{ModelConfig, Reading, Variant};
use rand::SeedableRng;
use rand_chacha::ChaCha8Rng;

#[global_allocator]
static ALLOCATOR: Recycler = Recycler;

/// Blocks below 2 MiB are not counted, and threads reach their peaks at different times.
const TOLERANCE: f64 = 0.1;

/// Channels of the levels that hardly grow.
#[cfg(target_os = "linux")]
const EVEN: [usize; 5] = [2, 3, 4, 4, 4];

/// Channels of the levels that grow more than the pixels become fewer.
#[cfg(target_os = "linux")]
const STEEP: [usize; 5] = [2, 12, 12, 16, 16];

/// On two threads: with more, bands and what threads work in are larger.
#[test]
#[cfg(target_os = "linux")]
fn the_estimate_is_what_a_pass_allocates() {
    let threads = rayon::ThreadPoolBuilder::new().num_threads(2).build();
    threads.expect("threads").install(check);
}

#[cfg(target_os = "linux")]
fn check() {
    let device = Device::flex();
    // In the order of their sizes: the most so far is what can be told.
    let cases = [
        (Variant::Demc, Reading::Paper, 24, PAPERS, [512, 512]),
        (Variant::DemcNosn, Reading::Paper, 24, PAPERS, [1024, 512]),
        (Variant::Demc, Reading::Released, 24, PAPERS, [768, 1024]),
        (Variant::Semc, Reading::Paper, 32, PAPERS, [736, 1280]),
        (Variant::Demc, Reading::Paper, 32, PAPERS, [1088, 1920]),
        (Variant::Demc, Reading::Paper, 32, EVEN, [1088, 1920]),
        (Variant::Demc, Reading::Paper, 32, STEEP, [1088, 1920]),
    ];
    for (variant, reading, width, levels, [height, columns]) in cases {
        let config = ModelConfig {
            variant,
            reading,
            width,
            levels,
            ..ModelConfig::default()
        };
        let mut rng = ChaCha8Rng::seed_from_u64(1);
        let model = config.init(&mut rng, [0.5; 3], &device);
        let [before, _] = used();
        let image = |channels| Tensor::<4>::ones([1, channels, height, columns], &device);
        let out = model.forward(image(3), image(12));
        let [_, most] = used();
        assert_eq!(out.dims(), [1, 3, height, columns]);
        let (found, said) = (most - before, peak_bytes(&config, height, columns));
        let ratio = said as f64 / found as f64;
        println!(
            "{config:?} {height}x{columns}: {} MiB said, {} MiB found",
            said >> 20,
            found >> 20
        );
        assert!(
            (ratio - 1.0).abs() <= TOLERANCE,
            "{config:?}: {said} bytes said, {found} found"
        );
    }
}
