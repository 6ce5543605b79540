use std::convert::Infallible;

use demc_model::{ModelConfig, Reading, WeightSpec, Weights};

use super::*;
use crate::run::initial::random_network;

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
        color: pattern(3, 0.0),
        features: pattern(12, 1.0),
        modulation: None,
        reference_light: None,
        reference_hdr: pattern(3, 2.0),
        patch_size: 32,
        patches: (0..size as u32)
            .map(|x| Patch { scene: 0, y: 0, x })
            .collect(),
    }
}

fn trainer(config: &Config) -> Trainer {
    let device = Device::flex().autodiff();
    let model = random_network(&config.model, 1, [0.3; 3], &device);
    Trainer::new(config, model, Optimizer::new(config), None, device)
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

/// The loss includes the modulation: in L1 in gamma space, doubling output and reference doubles
/// the loss.
#[test]
fn the_output_is_modulated_before_the_loss() {
    let mut config = config(2, 1);
    (config.loss.relmse, config.loss.l1) = (0.0, 1.0);
    let trainer = trainer(&config);
    let plain = batch(2, 0);
    let twice = Batch {
        modulation: Some(vec![2.0; plain.color.len()]),
        reference_hdr: plain
            .reference_hdr
            .iter()
            .map(|r| r * 2f32.powf(2.2))
            .collect(),
        ..plain.clone()
    };
    let mean = |batch: Batch| trainer.mean_loss([batch].into_iter()).expect("one process");
    let [plain, twice] = [plain, twice].map(mean);
    assert!(
        plain > 0.0 && (twice / plain - 2.0).abs() < 1e-5,
        "{plain} {twice}"
    );
}

/// Without batch normalisation (the paper's DEMCnoSN) two half batches equal the whole.
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
    clipped_config.optimizer.max_grad_norm = Some(1e-3);
    let step = |config: &Config| {
        trainer(config)
            .step(1e-3, || Ok::<_, Infallible>(batch(2, 0)))
            .unwrap()
    };
    assert_eq!(step(&clipped_config), step(&config(2, 1)));
    assert!(step(&clipped_config).grad_norm > 1e-3);
}

/// On the kernels a step updates weights in place. It would copy a weight that anything else refers
/// to, such as the graph or a copy of the network.
#[test]
fn a_step_on_kernels_updates_weights_in_place() {
    use burn::backend::Flex;
    use burn::tensor::Tensor;
    let config = config(2, 1);
    let mut trainer = trainer(&config);
    let address = |trainer: &Trainer| {
        let network = trainer.model().dual_encoder().expect("a DEMC has encoders");
        let conv = &network.encoders[0].levels[2].convs[1];
        let weight: Tensor<4> = conv.weight.val().inner();
        let weight = weight.try_into_primitive::<Flex>().expect("flex");
        weight.bytes().as_ptr() as usize
    };
    let before = address(&trainer);
    for _ in 0..2 {
        trainer
            .step(1e-3, || Ok::<_, Infallible>(batch(2, 0)))
            .expect("no batch fails");
        assert_eq!(address(&trainer), before);
    }
}

/// DSSIM and SMAPE are at most 1, so each adds at most its weight. Both together add the sum.
#[test]
fn further_terms_add_to_the_loss_and_change_the_step() {
    let step = |dssim: f32, smape: f32| {
        let mut config = config(2, 1);
        (config.loss.dssim, config.loss.smape) = (dssim, smape);
        let mut trainer = trainer(&config);
        let step = trainer
            .step(1e-3, || Ok::<_, Infallible>(batch(2, 0)))
            .expect("no batch fails");
        (step.loss, trainer.model().weights())
    };
    let (plain, weights) = step(0.0, 0.0);
    let mut sum = 0.0;
    for (dssim, smape) in [(3.0, 0.0), (0.0, 3.0)] {
        let (loss, moved) = step(dssim, smape);
        let added = loss - plain;
        assert!(added > 0.01 && added < 3.0, "{dssim} {smape}: {added}");
        assert!(moved != weights, "{dssim} {smape}");
        sum += added;
    }
    let both = step(3.0, 3.0).0 - plain;
    assert!((both / sum - 1.0).abs() < 1e-5, "{both} {sum}");
}

#[test]
fn every_patch_reports_its_loss() {
    let step = trainer(&config(2, 2))
        .step(1e-3, || Ok::<_, Infallible>(batch(2, 0)))
        .expect("no batch fails");
    assert_eq!(step.patches.len(), 4);
    let mean = step.patches.iter().map(|(_, loss)| loss).sum::<f64>() / 4.0;
    assert_eq!(mean, step.loss);
    assert!(step.patches[0].1 != step.patches[1].1);
}

/// Weights, running statistics, average and optimizer stay as they were.
#[test]
fn a_non_finite_step_is_skipped() {
    let mut config = config(2, 1);
    config.model.variant = demc_model::Variant::Demc;
    config.train.ema_decay = Some(0.9);
    let mut trainer = trainer(&config);
    trainer
        .step(1e-3, || Ok::<_, Infallible>(batch(2, 0)))
        .expect("no batch fails");
    let state = |trainer: &Trainer| {
        let average = trainer.average().expect("an average").weights();
        (
            trainer.model().weights(),
            average,
            trainer.optimizer().state(),
        )
    };
    let before = state(&trainer);
    let specs = trainer.optimizer().specs();
    assert!(specs.iter().any(|spec| !spec.role.is_trainable()));
    let mut bad = batch(2, 0);
    bad.features[40] = f32::NAN;
    let step = trainer
        .step(1e-3, || Ok::<_, Infallible>(bad.clone()))
        .expect("no batch fails");
    assert!(!step.is_finite());
    let unfinished: Vec<bool> = step.patches.iter().map(|(_, l)| l.is_finite()).collect();
    assert_eq!(unfinished, [false, false], "batch normalisation spreads it");
    assert!(state(&trainer) == before);
    assert_eq!(trainer.optimizer().steps(), 1);
    let step = trainer
        .step(1e-3, || Ok::<_, Infallible>(batch(2, 0)))
        .expect("no batch fails");
    assert!(step.is_finite() && state(&trainer) != before);
}

#[test]
fn the_result_is_the_average() {
    let mut config = config(2, 1);
    let mut plain = trainer(&config);
    config.train.ema_decay = Some(0.5);
    let mut averaged = trainer(&config);
    for trainer in [&mut plain, &mut averaged] {
        for _ in 0..3 {
            trainer
                .step(1e-2, || Ok::<_, Infallible>(batch(2, 0)))
                .expect("no batch fails");
        }
    }
    assert!(plain.model().weights() == averaged.model().weights());
    assert!(plain.result().weights() == plain.model().weights());
    assert!(averaged.result().weights() != averaged.model().weights());
}

/// Channels whose bias, or shift of a normalisation, is far below zero get no gradient.
fn dormant_channels_are_counted_once_they_can_be_known(reading: Reading, shift: &str) {
    let mut config = config(2, 1);
    config.model.reading = reading;
    let device = Device::flex().autodiff();
    let mut weights = random_network(&config.model, 1, [0.3; 3], &device).weights();
    let latent = weights.iter_mut().find(|w| w.name == shift);
    latent.expect("a latent").data.fill(-100.0);
    let model = config.model.load(&mut Weights::new(weights), &device);
    let optimizer = Optimizer::new(&config);
    let mut trainer = Trainer::new(&config, model.unwrap(), optimizer, None, device);
    for _ in 1..DORMANT_STEPS {
        trainer
            .step(1e-4, || Ok::<_, Infallible>(batch(2, 0)))
            .expect("no batch fails");
    }
    assert_eq!(trainer.dormant(), None);
    trainer
        .step(1e-4, || Ok::<_, Infallible>(batch(2, 0)))
        .expect("no batch fails");
    let found = trainer.dormant().expect("late enough");
    let biases = trainer
        .optimizer()
        .specs()
        .iter()
        .filter(|spec| spec.name.ends_with(".bias"));
    let channels: usize = biases.map(WeightSpec::len).sum();
    assert_eq!(found.channels, channels - 3, "all but the head's");
    // The latent has 16 channels; others that feed only it lose their gradient with it. A few die by chance.
    assert!((16..=56).contains(&found.dormant), "{found:?}");
}

#[test]
fn dormant_channels_of_biases() {
    dormant_channels_are_counted_once_they_can_be_known(Reading::Paper, "latent.conv.bias");
}

#[test]
fn dormant_channels_of_normalisations() {
    dormant_channels_are_counted_once_they_can_be_known(Reading::Released, "latent.norm.beta");
}
