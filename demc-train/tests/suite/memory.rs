//! The memory of a training step, compared with its estimate.
#![cfg(target_os = "linux")]

use std::convert::Infallible;

use burn::tensor::Device;
use demc_data::Batch;
use demc_model::config::{LEVEL_WIDTHS, Reading, Variant};
use demc_model::ops::used_bytes;
use demc_train::Config;
use demc_train::run::initial::random_network;
use demc_train::step::optimizer::Optimizer;
use demc_train::step::trainer::Trainer;

use crate::alone::run_alone;

/// Relative tolerance: the estimate only decides whether a step can fit at all.
const TOLERANCE: f64 = 0.33;

#[test]
fn the_estimate_of_a_step_agrees_with_the_allocations() {
    let name = "memory::the_estimate_of_a_step_agrees_with_the_allocations";
    run_alone(name, check);
}

fn check() {
    let device = Device::flex().autodiff();
    // In the order of their sizes: only the process's peak so far is known.
    let cases = [
        (Variant::Semc, Reading::Paper, 16, 4, 96),
        (Variant::DemcNosn, Reading::Paper, 16, 6, 96),
        (Variant::Demc, Reading::Paper, 16, 8, 128),
        (Variant::Demc, Reading::Released, 16, 12, 128),
        (Variant::Demc, Reading::Paper, 32, 12, 128),
        (Variant::Kpcn, Reading::Paper, 32, 4, 128),
    ];
    for (variant, reading, width, patches, side) in cases {
        let mut config = Config::parse("tiny.toml".as_ref(), "[data]\nroot = \"x\"", &[])
            .expect("a configuration");
        config.model.variant = variant;
        config.model.reading = reading;
        config.model.width = width;
        config.model.levels = LEVEL_WIDTHS;
        config.train.grad_accumulation = 1;
        let [before, _] = used_bytes();
        let model = random_network(&config.model, 0, [0.5; 3], &device);
        let mut trainer = Trainer::new(
            &config,
            model,
            Optimizer::new(&config),
            None,
            device.clone(),
        );
        let batch = Batch::grey(config.inputs(), patches, side);
        for _ in 0..2 {
            trainer
                .step(1e-4, || Ok::<_, Infallible>(batch.clone()))
                .expect("no batch fails");
        }
        let [_, peak] = used_bytes();
        let measured = peak - before;
        let estimate = config.model.step_bytes(patches, side);
        let ratio = estimate as f64 / measured as f64;
        println!(
            "{}: {} MiB estimated, {} MiB measured",
            config.model,
            estimate >> 20,
            measured >> 20
        );
        assert!(
            (ratio - 1.0).abs() <= TOLERANCE,
            "{}: {estimate} bytes estimated, {measured} measured",
            config.model
        );
    }
}
