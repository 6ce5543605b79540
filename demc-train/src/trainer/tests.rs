use std::convert::Infallible;

use demc_model::{ModelConfig, Weights};
use rand::SeedableRng;
use rand_chacha::ChaCha8Rng;

use super::*;
use crate::initial::drawn;

fn config(batch_size: usize, grad_accumulation: usize) -> Config {
    let mut config = Config::default();
    config.model = ModelConfig {
        width: 2,
        variant: demc_model::Variant::DemcNosn,
        ..config.model
    };
    config.data.batch_size = batch_size;
    config.train.grad_accumulation = grad_accumulation;
    config
}

fn batch(size: usize, first: usize) -> Batch {
    let pattern = |channels: usize, phase: f32| -> Vec<f32> {
        let pixels = channels * 32 * 32;
        (first * pixels..(first + size) * pixels)
            .map(|i| 0.5 + 0.5 * (i as f32 * 0.013 + phase).sin())
            .collect()
    };
    Batch {
        size,
        color_gamma: pattern(3, 0.0),
        features_z: pattern(12, 1.0),
        modulation: None,
        reference_hdr: pattern(3, 2.0),
        patches: (0..size as u32)
            .map(|x| Patch { scene: 0, y: 0, x })
            .collect(),
    }
}

fn trainer(config: &Config) -> Trainer {
    let device = Device::flex().autodiff();
    let model = drawn(&config.model, 1, [0.3; 3], &device);
    Trainer::new(config, model, Optimizer::new(&config.train), None, device)
}

#[test]
fn the_loss_falls() {
    let config = config(2, 1);
    let mut trainer = trainer(&config);
    let mut step = || {
        trainer
            .step(1e-2, || Ok::<_, Infallible>(batch(2, 0)))
            .unwrap()
            .loss
    };
    let first = step();
    let last = (0..20).map(|_| step()).last().unwrap();
    assert!(last < 0.7 * first, "{first} to {last}");
}

/// What modulates the output is in the loss: with L1 in gamma space, twice an output is as far from twice a reference.
#[test]
fn the_output_is_modulated_before_it_is_compared() {
    let mut config = config(2, 1);
    config.train.loss = demc_model::loss::Loss::L1;
    let trainer = trainer(&config);
    let plain = batch(2, 0);
    let twice = Batch {
        modulation: Some(vec![2.0; plain.color_gamma.len()]),
        reference_hdr: plain
            .reference_hdr
            .iter()
            .map(|r| r * 2f32.powf(2.2))
            .collect(),
        ..plain.clone()
    };
    let (plain, twice) = (trainer.mean_loss(&[plain]), trainer.mean_loss(&[twice]));
    assert!(
        plain > 0.0 && (twice / plain - 2.0).abs() < 1e-5,
        "{plain} {twice}"
    );
}

/// Without batch normalisation (DEMCnoSN as the paper has it) two halves make the whole.
#[test]
fn accumulated_batches_step_like_one() {
    let mut whole = trainer(&config(4, 1));
    let mut halves = trainer(&config(2, 2));
    let a = whole
        .step(1e-3, || Ok::<_, Infallible>(batch(4, 0)))
        .unwrap();
    let mut parts = [batch(2, 0), batch(2, 2)].into_iter();
    let b = halves
        .step(1e-3, || Ok::<_, Infallible>(parts.next().unwrap()))
        .unwrap();
    // Sums of float32 in another order.
    assert!((a.loss / b.loss - 1.0).abs() < 1e-5, "{a:?} {b:?}");
    assert!(
        (a.grad_norm / b.grad_norm - 1.0).abs() < 1e-4,
        "{a:?} {b:?}"
    );
}

#[test]
fn clipping_bounds_the_gradient_and_reports_its_true_norm() {
    let mut clipped_config = config(2, 1);
    clipped_config.train.grad_clip = 1e-3;
    let step = |config: &Config| {
        trainer(config)
            .step(1e-3, || Ok::<_, Infallible>(batch(2, 0)))
            .unwrap()
    };
    assert_eq!(step(&clipped_config), step(&config(2, 1)));
    assert!(step(&clipped_config).grad_norm > 1e-3);
}

/// On the kernels a step writes weights where they lie: had anything kept a reference to one (the graph, a copy of the
/// network), it would have been copied.
#[test]
fn a_step_on_kernels_leaves_weights_in_their_place() {
    use burn::backend::Flex;
    use burn::tensor::Tensor;
    let config = config(2, 1);
    let mut trainer = trainer(&config);
    let place = |trainer: &Trainer| {
        let conv = &trainer.model().encoders[0].levels[2].convs[1];
        let weight: Tensor<4> = conv.weight.val().inner();
        let weight = weight.try_into_primitive::<Flex>().expect("flex");
        weight.bytes().as_ptr() as usize
    };
    let before = place(&trainer);
    for _ in 0..2 {
        let Ok(_) = trainer.step(1e-3, || Ok::<_, Infallible>(batch(2, 0)));
        assert_eq!(place(&trainer), before);
    }
}

/// By no more than the weight: a dissimilarity is at most 1, and so is SMAPE. Both together add what each adds.
#[test]
fn terms_beside_the_loss_add_to_it_and_move_the_weights() {
    let step = |ssim: f32, smape: f32| {
        let mut config = config(2, 1);
        (config.train.ssim, config.train.smape) = (ssim, smape);
        let mut trainer = trainer(&config);
        let Ok(step) = trainer.step(1e-3, || Ok::<_, Infallible>(batch(2, 0)));
        (step.loss, trainer.model().weights())
    };
    let (plain, weights) = step(0.0, 0.0);
    let mut sum = 0.0;
    for (ssim, smape) in [(3.0, 0.0), (0.0, 3.0)] {
        let (loss, moved) = step(ssim, smape);
        let added = loss - plain;
        assert!(added > 0.01 && added < 3.0, "{ssim} {smape}: {added}");
        assert!(moved != weights, "{ssim} {smape}");
        sum += added;
    }
    let both = step(3.0, 3.0).0 - plain;
    assert!((both / sum - 1.0).abs() < 1e-5, "{both} {sum}");
}

#[test]
fn every_patch_reports_its_loss() {
    let step = trainer(&config(2, 2)).step(1e-3, || Ok::<_, Infallible>(batch(2, 0)));
    let Ok(step) = step;
    assert_eq!(step.patches.len(), 4);
    let mean = step.patches.iter().map(|(_, loss)| loss).sum::<f64>() / 4.0;
    assert_eq!(mean, step.loss);
    assert!(step.patches[0].1 != step.patches[1].1);
}

/// Weights, running statistics, average and optimizer: a step along NaN leaves no trace.
#[test]
fn a_step_that_is_not_finite_is_not_taken() {
    let mut config = config(2, 1);
    config.model.variant = demc_model::Variant::Demc;
    config.train.ema = 0.9;
    let mut trainer = trainer(&config);
    let Ok(_) = trainer.step(1e-3, || Ok::<_, Infallible>(batch(2, 0)));
    let state = |trainer: &Trainer| {
        let average = trainer.average().expect("an average").weights();
        (
            trainer.model().weights(),
            average,
            trainer.optimizer().state(),
        )
    };
    let before = state(&trainer);
    assert!(before.0.iter().any(|weight| !weight.is_trainable()));
    let mut bad = batch(2, 0);
    bad.features_z[40] = f32::NAN;
    let Ok(step) = trainer.step(1e-3, || Ok::<_, Infallible>(bad.clone()));
    assert!(!step.is_finite());
    let unfinished: Vec<bool> = step.patches.iter().map(|(_, l)| l.is_finite()).collect();
    assert_eq!(unfinished, [false, false], "batch normalisation spreads it");
    assert!(state(&trainer) == before);
    assert_eq!(trainer.optimizer().steps(), 1);
    let Ok(step) = trainer.step(1e-3, || Ok::<_, Infallible>(batch(2, 0)));
    assert!(step.is_finite() && state(&trainer) != before);
}

#[test]
fn the_average_is_what_ships() {
    let mut config = config(2, 1);
    let mut plain = trainer(&config);
    config.train.ema = 0.5;
    let mut averaged = trainer(&config);
    for trainer in [&mut plain, &mut averaged] {
        for _ in 0..3 {
            let Ok(_) = trainer.step(1e-2, || Ok::<_, Infallible>(batch(2, 0)));
        }
    }
    assert!(plain.model().weights() == averaged.model().weights());
    assert!(plain.result().weights() == plain.model().weights());
    assert!(averaged.result().weights() != averaged.model().weights());
}

/// Channels far below zero are found after as many steps as it takes, begin anew without a change of the loss, in network
/// and average, and learn again.
#[test]
fn dormant_channels_begin_anew() {
    let mut config = config(2, 1);
    config.train.ema = 0.9;
    let device = Device::flex().autodiff();
    let mut weights = drawn(&config.model, 1, [0.3; 3], &device).weights();
    let latent = weights.iter_mut().find(|w| w.name == "latent.conv.bias");
    latent.expect("a latent").data.fill(-100.0);
    let model = config.model.load(&mut Weights::new(weights), &device);
    let mut trainer = Trainer::new(
        &config,
        model.unwrap(),
        Optimizer::new(&config.train),
        None,
        device,
    );
    let steps = |trainer: &mut Trainer, count: u64| {
        for _ in 0..count {
            let Ok(_) = trainer.step(1e-4, || Ok::<_, Infallible>(batch(2, 0)));
        }
    };
    let of_latent = |trainer: &Trainer| {
        let flags = &trainer.optimizer().dormant()["latent.conv"];
        flags.iter().filter(|dormant| **dormant).count()
    };
    steps(&mut trainer, DORMANT_STEPS - 1);
    assert_eq!(trainer.dormant(), None);
    steps(&mut trainer, 1);
    let found = trainer.dormant().expect("late enough");
    assert!(of_latent(&trainer) == 16 && found.dormant < found.channels);
    let (loss, average) = (
        trainer.mean_loss(&[batch(2, 0)]),
        trainer.result().weights(),
    );
    let recycled = trainer.recycle(&mut ChaCha8Rng::seed_from_u64(1));
    assert_eq!(recycled, found);
    let after = trainer.mean_loss(&[batch(2, 0)]);
    assert!((after / loss - 1.0).abs() < 1e-5, "{loss} {after}");
    assert!(trainer.result().weights() != average);
    steps(&mut trainer, DORMANT_STEPS);
    assert!(of_latent(&trainer) < 8);
}
