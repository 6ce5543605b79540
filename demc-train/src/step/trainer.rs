//! One optimizer step: batches, forward pass, loss (Eq. 5), backward pass, clipping, update,
//! average.

use burn::module::Module;
use burn::optim::{GradientsAccumulator, GradientsParams};
use burn::tensor::{Device, Tensor, TensorData};
use demc_data::{Batch, FEATURES, Patch, Scene};
use demc_model::{Denoiser, LossConfig};

use crate::config::Config;
use crate::step::ema::Ema;
use crate::step::optimizer::{DORMANT_STEPS, DormantChannels, Optimizer, grad_norm, scaled};
use crate::step::running_statistics::RunningStatistics;

/// Largest number of patches named in a message.
const MAX_NAMED: usize = 8;

/// A network in training.
pub struct Trainer {
    /// `None` only within a step.
    model: Option<Denoiser>,
    optimizer: Optimizer,
    ema: Option<Ema>,
    device: Device,
    loss: LossConfig,
    /// Batches per step.
    grad_accumulation: usize,
    max_grad_norm: Option<f32>,
    gamma: f32,
}

/// The result of one optimizer step.
#[derive(Clone, Debug, PartialEq)]
pub struct StepReport {
    /// Loss before the step, mean over its patches.
    pub loss: f64,
    /// Norm of the whole gradient before clipping; NaN if the loss is not finite.
    pub grad_norm: f64,
    /// Every patch of the step with its loss.
    pub patches: Vec<(Patch, f64)>,
}

impl StepReport {
    /// Whether loss and gradient are finite. Otherwise the step was skipped.
    pub fn is_finite(&self) -> bool {
        self.loss.is_finite() && self.grad_norm.is_finite()
    }

    /// Scene, origin and loss of the patches: of those with a non-finite loss, else of all.
    pub fn describe_patches(&self, scenes: &[Scene]) -> String {
        let any = self.patches.iter().any(|(_, loss)| !loss.is_finite());
        let named = self
            .patches
            .iter()
            .filter(|(_, loss)| !any || !loss.is_finite());
        let mut texts: Vec<String> = named
            .map(|(patch, loss)| {
                let scene = &scenes[patch.scene as usize].name;
                format!("{scene} (x {}, y {}): {loss:.4}", patch.x, patch.y)
            })
            .collect();
        if texts.len() > MAX_NAMED {
            let more = texts.len() - MAX_NAMED;
            texts.truncate(MAX_NAMED);
            texts.push(format!("{more} more"));
        }
        texts.join(", ")
    }
}

impl Trainer {
    /// A trainer of `model` on `device`, with the optimizer's state and the averaged network so
    /// far. A new average starts at `model`.
    ///
    /// # Panics
    /// If `device` has no autodiff.
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
        let ema = config.train.ema_decay;
        let ema = ema.map(|decay| Ema::new(decay, average.unwrap_or_else(|| model.valid())));
        Trainer {
            model: Some(model),
            optimizer,
            ema,
            device,
            loss: config.loss,
            grad_accumulation: config.train.grad_accumulation,
            max_grad_norm: config.optimizer.max_grad_norm,
            gamma: config.data.gamma,
        }
    }

    /// The network in training.
    pub fn model(&self) -> &Denoiser {
        self.model
            .as_ref()
            .expect("the network is taken only within a step")
    }

    /// The optimizer.
    pub fn optimizer(&self) -> &Optimizer {
        &self.optimizer
    }

    /// The network to validate and to export, without autodiff: the average if there is one.
    pub fn result(&self) -> Denoiser {
        match &self.ema {
            Some(ema) => ema.model().clone(),
            None => self.model().valid(),
        }
    }

    /// The averaged network, without autodiff, if there is one.
    pub fn average(&self) -> Option<&Denoiser> {
        self.ema.as_ref().map(Ema::model)
    }

    /// Description of the implementation that computes the operations.
    pub fn operations(&self) -> String {
        self.model().ops().describe(&self.device)
    }

    /// Takes one step at learning rate `lr` on `train.grad_accumulation` batches.
    ///
    /// If loss or gradient are not finite, the step is skipped: network and running statistics stay
    /// as they were.
    ///
    /// # Errors
    /// Those of `next_batch`; the weights stay as they were.
    pub fn step<E>(
        &mut self,
        lr: f64,
        mut next_batch: impl FnMut() -> Result<Batch, E>,
    ) -> Result<StepReport, E> {
        let parts = self.grad_accumulation;
        let statistics = RunningStatistics::of(self.model(), self.optimizer.specs());
        let mut accumulated = GradientsAccumulator::new();
        let (mut patches, mut losses) = (Vec::new(), Vec::new());
        for _ in 0..parts {
            let mut batch = next_batch()?;
            let batch_patches = std::mem::take(&mut batch.patches);
            let batch_losses = self.losses(batch);
            let part = batch_losses.clone().mean().div_scalar(parts as f32);
            let values = batch_losses.into_data().try_to_vec::<f32>();
            let values = values.expect("losses are float32").into_iter();
            let values = values.map(f64::from);
            patches.extend(batch_patches.into_iter().zip(values.clone()));
            losses.extend(values);
            if losses.iter().all(|loss| loss.is_finite()) {
                let model = self.model();
                let gradients = GradientsParams::from_grads(part.backward(), model);
                accumulated.accumulate(model, gradients);
            }
        }
        let loss = losses.iter().sum::<f64>() / losses.len() as f64;
        let mut report = StepReport {
            loss,
            grad_norm: f64::NAN,
            patches,
        };
        if loss.is_finite() {
            let grads = accumulated.grads();
            report.grad_norm = grad_norm(self.model(), &grads);
            if report.is_finite() {
                self.update(lr, grads, report.grad_norm);
                return Ok(report);
            }
        }
        let specs = self.optimizer.specs();
        let model = self.model.take();
        self.model = model.map(|model| statistics.restore(model, specs));
        Ok(report)
    }

    /// The number of dormant channels. `None` before step 175: no channel can be dormant yet.
    pub fn dormant(&self) -> Option<DormantChannels> {
        let late = self.optimizer.steps() >= DORMANT_STEPS;
        late.then(|| self.optimizer.dormant())
    }

    /// The mean loss of some batches, without a step.
    pub fn mean_loss(&self, batches: impl ExactSizeIterator<Item = Batch>) -> f64 {
        let count = batches.len() as f64;
        let losses = batches.map(|batch| {
            let mean = self.losses(batch).mean();
            f64::from(mean.into_scalar::<f32>())
        });
        losses.sum::<f64>() / count
    }

    fn update(&mut self, lr: f64, mut grads: GradientsParams, norm: f64) {
        if let Some(limit) = self.max_grad_norm.map(f64::from)
            && norm > limit
        {
            grads = scaled(self.model(), grads, limit / norm);
        }
        let model = self
            .model
            .take()
            .expect("the network is taken only within a step");
        let model = self.optimizer.step(lr, model, grads);
        if let Some(ema) = &mut self.ema {
            ema.update(&model.valid(), self.optimizer.steps());
        }
        self.model = Some(model);
    }

    /// The loss of each patch of a batch.
    ///
    /// # Shapes
    /// To `[B]`.
    fn losses(&self, batch: Batch) -> Tensor<1> {
        let (size, side) = (batch.size, batch.patch_size);
        let tensor = |values: Vec<f32>, channels| {
            let data = TensorData::new(values, [size, channels, side, side]);
            Tensor::<4>::from_data(data, &self.device)
        };
        let color_gamma = tensor(batch.color_gamma, 3);
        let features_z = tensor(batch.features_z, FEATURES);
        let ref_hdr = tensor(batch.reference_hdr, 3);
        let out_gamma = self.model().forward(color_gamma, features_z);
        let out_gamma = match batch.modulation {
            Some(modulation) => out_gamma * tensor(modulation, 3),
            None => out_gamma,
        };
        self.loss
            .per_image(self.model().ops(), out_gamma, ref_hdr, self.gamma)
    }
}

#[cfg(test)]
mod tests;
