//! One optimizer step: batches, forward, loss (Eq. 5), backward, clipping, Adam.

use burn::optim::{GradientsAccumulator, GradientsParams};
use burn::tensor::{Device, Tensor, TensorData};
use demc_data::{Batch, FEATURES};
use demc_model::metrics;
use demc_model::{Denoiser, ModelConfig};
use rand::SeedableRng;
use rand_chacha::ChaCha8Rng;

use crate::config::{Config, TrainConfig};
use crate::optimizer::{Adam, grad_norm, scaled};

/// A network in training.
pub struct Trainer {
    model: Option<Denoiser>,
    adam: Adam,
    device: Device,
    config: TrainConfig,
    gamma: f32,
}

/// What a step found.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Step {
    /// Loss before the step, averaged over its batches.
    pub loss: f64,
    /// Norm of the whole gradient, before clipping.
    pub grad_norm: f64,
}

/// The network that a run starts with: drawn from the run's seed, its grey head at the best flat image.
pub fn initial_model(
    model: &ModelConfig,
    seed: u64,
    flat_color: [f32; 3],
    device: &Device,
) -> Denoiser {
    model.init(&mut ChaCha8Rng::seed_from_u64(seed), flat_color, device)
}

impl Trainer {
    /// A trainer of `model`, which lives on `device`, with the optimizer's state so far.
    ///
    /// # Panics
    /// Where `device` has no autodiff.
    pub fn new(config: &Config, model: Denoiser, adam: Adam, device: Device) -> Self {
        assert!(
            device.is_autodiff(),
            "training needs a device with autodiff"
        );
        Trainer {
            model: Some(model),
            adam,
            device,
            config: config.train.clone(),
            gamma: config.data.gamma,
        }
    }

    /// The network as it stands.
    pub fn model(&self) -> &Denoiser {
        self.model
            .as_ref()
            .expect("the network is away only within a step")
    }

    /// The optimizer as it stands.
    pub fn adam(&self) -> &Adam {
        &self.adam
    }

    /// The operations that run, in words.
    pub fn operations(&self) -> String {
        self.model().ops().describe(&self.device)
    }

    /// Takes one step at learning rate `lr` on `train.grad_accumulation` batches.
    ///
    /// # Errors
    /// Those of `next_batch`; the network is then as before.
    pub fn step<E>(
        &mut self,
        lr: f64,
        mut next_batch: impl FnMut() -> Result<Batch, E>,
    ) -> Result<Step, E> {
        let parts = self.config.grad_accumulation;
        let mut accumulated = GradientsAccumulator::new();
        let mut loss = 0.0;
        for _ in 0..parts {
            let part = self.loss(&next_batch()?).div_scalar(parts as f32);
            let gradients = part.backward();
            loss += f64::from(part.into_scalar::<f32>());
            let model = self.model();
            accumulated.accumulate(model, GradientsParams::from_grads(gradients, model));
        }
        let mut grads = accumulated.grads();
        let norm = grad_norm(self.model(), &grads);
        let limit = f64::from(self.config.grad_clip);
        if limit > 0.0 && norm > limit {
            grads = scaled(self.model(), grads, limit / norm);
        }
        let model = self
            .model
            .take()
            .expect("the network is away only within a step");
        self.model = Some(self.adam.step(lr, model, grads));
        Ok(Step {
            loss,
            grad_norm: norm,
        })
    }

    /// The loss of a batch (Eq. 5), `[1]`.
    fn loss(&self, batch: &Batch) -> Tensor<1> {
        let side = (batch.color_gamma.len() / (3 * batch.size)).isqrt();
        let tensor = |values: &[f32], channels| {
            let data = TensorData::new(values.to_vec(), [batch.size, channels, side, side]);
            Tensor::<4>::from_data(data, &self.device)
        };
        let color_gamma = tensor(&batch.color_gamma, 3);
        let features_z = tensor(&batch.features_z, FEATURES);
        let ref_hdr = tensor(&batch.reference_hdr, 3);
        let out_gamma = self.model().forward(color_gamma, features_z);
        metrics::loss(
            self.model().ops(),
            out_gamma,
            ref_hdr,
            self.gamma,
            self.config.loss_epsilon,
        )
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::convert::Infallible;

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
            reference_hdr: pattern(3, 2.0),
            patches: Vec::new(),
        }
    }

    fn trainer(config: &Config) -> Trainer {
        let device = Device::flex().autodiff();
        let model = initial_model(&config.model, 1, [0.3; 3], &device);
        Trainer::new(config, model, Adam::new(1e-8), device)
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
}
