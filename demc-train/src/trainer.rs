//! One optimizer step: batches, forward, loss (Eq. 5), backward, clipping, Adam or Muon, the average of the weights.

use burn::module::Module;
use burn::optim::{GradientsAccumulator, GradientsParams};
use burn::tensor::{Device, Tensor, TensorData};
use demc_data::{Batch, FEATURES, Patch};
use demc_model::Denoiser;
use demc_model::dormant::Renewal;
use demc_model::loss::{Loss, dissimilarity, gamma_from_hdr};
use rand::Rng;

use crate::census::Census;
use crate::config::{Config, TrainConfig};
use crate::ema::Ema;
use crate::optimizer::{DORMANT_STEPS, Optimizer, grad_norm, scaled};
use crate::rate::Rate;
use crate::running_statistics::RunningStatistics;

/// A network in training.
pub struct Trainer {
    model: Option<Denoiser>,
    optimizer: Optimizer,
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
        optimizer: Optimizer,
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
            optimizer,
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
    pub fn optimizer(&self) -> &Optimizer {
        &self.optimizer
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

    /// How many channels are dormant; `None` before step 175, when no channel can have lain still for as long.
    pub fn dormant(&self) -> Option<Census> {
        let late = self.optimizer.steps() >= DORMANT_STEPS;
        late.then(|| Census::of(&self.optimizer.dormant()))
    }

    /// Lets dormant channels begin anew, in network, optimizer and average; what the network computes stays as it is.
    pub fn recycle(&mut self, rng: &mut impl Rng) -> Census {
        let dormant = self.optimizer.dormant();
        let census = Census::of(&dormant);
        if census.dormant > 0 {
            let model = self.model();
            let renewal = Renewal::draw(model.config(), &model.weights(), &dormant, rng);
            self.model = Some(renewal.apply(self.model(), &self.device));
            self.optimizer.forget(&renewal);
            if let Some(ema) = &mut self.ema {
                let plain = self.device.clone().without_autodiff();
                ema.replace(renewal.apply(ema.model(), &plain));
            }
        }
        census
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
        let rate = Rate {
            lr,
            fan_in: self.config.lr_fan_in,
        };
        let model = self.optimizer.step(rate, model, grads);
        if let Some(ema) = &mut self.ema {
            ema.update(&model.valid(), self.optimizer.steps());
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
        let out_gamma = match &batch.modulation {
            Some(modulation) => out_gamma * tensor(modulation, 3),
            None => out_gamma,
        };
        let TrainConfig {
            loss,
            loss_epsilon,
            ssim,
            smape,
            ..
        } = self.config;
        let of = |loss: Loss| {
            let (out_gamma, ref_hdr) = (out_gamma.clone(), ref_hdr.clone());
            loss.per_image(
                self.model().ops(),
                out_gamma,
                ref_hdr,
                self.gamma,
                loss_epsilon,
            )
        };
        let mut losses = of(loss);
        if smape > 0.0 {
            losses = losses + of(Loss::Smape).mul_scalar(smape);
        }
        if ssim > 0.0 {
            let ref_gamma = gamma_from_hdr(ref_hdr.clone(), self.gamma);
            losses = losses + dissimilarity(out_gamma.clone(), ref_gamma).mul_scalar(ssim);
        }
        losses
    }
}

#[cfg(test)]
mod tests;
