//! One optimizer step: batches, forward, loss (Eq. 5), backward, clipping, Adam, the average of the weights.

use burn::module::Module;
use burn::optim::{GradientsAccumulator, GradientsParams};
use burn::tensor::{Device, Tensor, TensorData};
use demc_data::{Batch, FEATURES, Patch};
use demc_model::Denoiser;
use demc_model::loss::{dissimilarity, gamma_from_hdr};

use crate::config::{Config, TrainConfig};
use crate::ema::Ema;
use crate::optimizer::{Adam, grad_norm, scaled};
use crate::running_statistics::RunningStatistics;

/// A network in training.
pub struct Trainer {
    model: Option<Denoiser>,
    adam: Adam,
    ema: Option<Ema>,
    device: Device,
    config: TrainConfig,
    gamma: f32,
}

/// What a step found.
#[derive(Clone, Debug, PartialEq)]
pub struct Step {
    /// Loss before the step, averaged over its patches.
    pub loss: f64,
    /// Norm of the whole gradient, before clipping; NaN where the loss was not finite.
    pub grad_norm: f64,
    /// Every patch of the step, with its loss.
    pub patches: Vec<(Patch, f64)>,
}

impl Step {
    /// Whether loss and gradient were finite: if not, the step was not taken.
    pub fn is_finite(&self) -> bool {
        self.loss.is_finite() && self.grad_norm.is_finite()
    }
}

impl Trainer {
    /// A trainer of `model`, which lives on `device`, with the optimizer's state and the averaged network so far; a new
    /// average starts at `model`.
    ///
    /// # Panics
    /// Where `device` has no autodiff.
    pub fn new(
        config: &Config,
        model: Denoiser,
        adam: Adam,
        average: Option<Denoiser>,
        device: Device,
    ) -> Self {
        assert!(
            device.is_autodiff(),
            "training needs a device with autodiff"
        );
        let decay = config.train.ema;
        let ema = (decay > 0.0).then(|| Ema::new(decay, average.unwrap_or_else(|| model.valid())));
        Trainer {
            model: Some(model),
            adam,
            ema,
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

    /// The network to judge and to ship, on the plain device: the average, where there is one.
    pub fn result(&self) -> Denoiser {
        match &self.ema {
            Some(ema) => ema.model().clone(),
            None => self.model().valid(),
        }
    }

    /// The averaged network, where there is one.
    pub fn average(&self) -> Option<&Denoiser> {
        self.ema.as_ref().map(Ema::model)
    }

    /// The operations that run, in words.
    pub fn operations(&self) -> String {
        self.model().ops().describe(&self.device)
    }

    /// Takes one step at learning rate `lr` on `train.grad_accumulation` batches. Where loss or gradient are not finite, the
    /// network stays as it was, its running statistics too.
    ///
    /// # Errors
    /// Those of `next_batch`; the weights are then as before.
    pub fn step<E>(
        &mut self,
        lr: f64,
        mut next_batch: impl FnMut() -> Result<Batch, E>,
    ) -> Result<Step, E> {
        let parts = self.config.grad_accumulation;
        let statistics = RunningStatistics::of(self.model());
        let mut accumulated = GradientsAccumulator::new();
        let (mut patches, mut losses) = (Vec::new(), Vec::new());
        for _ in 0..parts {
            let batch = next_batch()?;
            let of_batch = self.losses(&batch);
            let part = of_batch.clone().mean().div_scalar(parts as f32);
            let host = of_batch.into_data().try_to_vec::<f32>();
            let host = host.expect("losses are float32").into_iter().map(f64::from);
            patches.extend(batch.patches.into_iter().zip(host.clone()));
            losses.extend(host);
            if losses.iter().all(|loss| loss.is_finite()) {
                let model = self.model();
                let gradients = GradientsParams::from_grads(part.backward(), model);
                accumulated.accumulate(model, gradients);
            }
        }
        let loss = losses.iter().sum::<f64>() / losses.len() as f64;
        let mut step = Step {
            loss,
            grad_norm: f64::NAN,
            patches,
        };
        if loss.is_finite() {
            let grads = accumulated.grads();
            step.grad_norm = grad_norm(self.model(), &grads);
            if step.is_finite() {
                self.descend(lr, grads, step.grad_norm);
                return Ok(step);
            }
        }
        self.model = self.model.take().map(|model| statistics.restore(model));
        Ok(step)
    }

    /// The mean loss of some batches; no step is taken.
    pub fn mean_loss(&self, batches: &[Batch]) -> f64 {
        let losses = batches.iter().map(|batch| {
            let mean = self.losses(batch).mean();
            f64::from(mean.into_scalar::<f32>())
        });
        losses.sum::<f64>() / batches.len() as f64
    }

    /// Clips the gradient of norm `norm`, and moves weights and average.
    fn descend(&mut self, lr: f64, mut grads: GradientsParams, norm: f64) {
        let limit = f64::from(self.config.grad_clip);
        if limit > 0.0 && norm > limit {
            grads = scaled(self.model(), grads, limit / norm);
        }
        let model = self
            .model
            .take()
            .expect("the network is away only within a step");
        let model = self.adam.step(lr, model, grads);
        if let Some(ema) = &mut self.ema {
            ema.update(&model.valid(), self.adam.steps());
        }
        self.model = Some(model);
    }

    /// The loss of each patch of a batch, `[B]`.
    fn losses(&self, batch: &Batch) -> Tensor<1> {
        let side = (batch.color_gamma.len() / (3 * batch.size)).isqrt();
        let tensor = |values: &[f32], channels| {
            let data = TensorData::new(values.to_vec(), [batch.size, channels, side, side]);
            Tensor::<4>::from_data(data, &self.device)
        };
        let color_gamma = tensor(&batch.color_gamma, 3);
        let features_z = tensor(&batch.features_z, FEATURES);
        let ref_hdr = tensor(&batch.reference_hdr, 3);
        let out_gamma = self.model().forward(color_gamma, features_z);
        let TrainConfig {
            loss,
            loss_epsilon,
            ssim,
            ..
        } = self.config;
        let ops = self.model().ops();
        if ssim == 0.0 {
            return loss.per_image(ops, out_gamma, ref_hdr, self.gamma, loss_epsilon);
        }
        let ref_gamma = gamma_from_hdr(ref_hdr.clone(), self.gamma);
        let unlike = dissimilarity(out_gamma.clone(), ref_gamma);
        let relative = loss.per_image(ops, out_gamma, ref_hdr, self.gamma, loss_epsilon);
        relative + unlike.mul_scalar(ssim)
    }
}

#[cfg(test)]
mod tests {
    use std::convert::Infallible;

    use demc_model::ModelConfig;

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
            reference_hdr: pattern(3, 2.0),
            patches: (0..size as u32)
                .map(|x| Patch { scene: 0, y: 0, x })
                .collect(),
        }
    }

    fn trainer(config: &Config) -> Trainer {
        let device = Device::flex().autodiff();
        let model = drawn(&config.model, 1, [0.3; 3], &device);
        Trainer::new(config, model, Adam::new(1e-8), None, device)
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

    /// By no more than the weight: a dissimilarity is at most 1.
    #[test]
    fn the_structural_term_adds_to_the_loss_and_moves_the_weights() {
        let mut weighed = config(2, 1);
        weighed.train.ssim = 3.0;
        let (mut plain, mut structural) = (trainer(&config(2, 1)), trainer(&weighed));
        let loss = |trainer: &mut Trainer| {
            let Ok(step) = trainer.step(1e-3, || Ok::<_, Infallible>(batch(2, 0)));
            step.loss
        };
        let added = loss(&mut structural) - loss(&mut plain);
        assert!(added > 0.01 && added < 3.0, "{added}");
        assert!(structural.model().weights() != plain.model().weights());
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
            (trainer.model().weights(), average, trainer.adam().state())
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
        assert_eq!(trainer.adam().steps(), 1);
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
}
