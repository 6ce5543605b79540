//! One optimizer step: batches, forward pass, loss (Eq. 5), backward pass, clipping, update,
//! average.

use burn::module::Module;
use burn::optim::GradientsParams;
use burn::tensor::{Device, Tensor, TensorData};
use demc_data::{Batch, FEATURES, Patch, Scene, Transfer};
use demc_model::{Denoiser, LossConfig, kpcn};
use serde::{Deserialize, Serialize};

use crate::config::Config;
use crate::ranks::Reduce;
use crate::ranks::gradients::GradientSum;
use crate::step::ema::Ema;
use crate::step::gradients::{grad_norm, scaled};
use crate::step::optimizer::{DORMANT_STEPS, DormantChannels, Optimizer};
use crate::step::running_statistics::RunningStatistics;
use crate::step::transfer::in_gamma;

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
    /// Steps of the run.
    steps: u64,
    /// Batches per step.
    grad_accumulation: usize,
    max_grad_norm: Option<f32>,
    gamma: f32,
    transfer: Transfer,
    reduce: Reduce,
}

/// What a step needs to know of a micro-batch besides its gradient.
#[derive(Clone, Debug, Serialize, Deserialize)]
struct MicroBatch {
    patches: Vec<Patch>,
    /// Loss of each patch.
    losses: Vec<f32>,
    /// Its share in the running statistics.
    statistics: Vec<f32>,
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
    /// The report of a step on `batches`, without a gradient so far.
    fn of(batches: &[MicroBatch]) -> Self {
        let patches: Vec<(Patch, f64)> = batches
            .iter()
            .flat_map(|batch| batch.patches.iter().zip(&batch.losses))
            .map(|(patch, loss)| (*patch, f64::from(*loss)))
            .collect();
        StepReport {
            loss: patches.iter().map(|(_, loss)| loss).sum::<f64>() / patches.len() as f64,
            grad_norm: f64::NAN,
            patches,
        }
    }

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
        let ema = config
            .train
            .ema_decay
            .map(|decay| Ema::new(decay, average.unwrap_or_else(|| model.valid())));
        Trainer {
            model: Some(model),
            optimizer,
            ema,
            device,
            loss: config.loss,
            steps: config.train.steps,
            grad_accumulation: config.train.grad_accumulation,
            max_grad_norm: config.optimizer.max_grad_norm,
            gamma: config.data.gamma,
            transfer: config.data.transfer,
            reduce: Reduce::default(),
        }
    }

    /// A trainer that takes every step together with those of other processes.
    pub fn with_reduce(self, reduce: Reduce) -> Self {
        Trainer { reduce, ..self }
    }

    /// Takes this many batches per step from now on, for measurements.
    pub(crate) fn set_grad_accumulation(&mut self, batches: usize) {
        self.grad_accumulation = batches;
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

    /// Takes one step at learning rate `lr` on `train.grad_accumulation` batches. `next_batch` gives
    /// those of this process's share.
    ///
    /// If loss or gradient are not finite, the step is skipped: network and running statistics stay
    /// as they were.
    ///
    /// # Errors
    /// Those of `next_batch` in any process; the weights stay as they were.
    pub fn step<E: Into<anyhow::Error>>(
        &mut self,
        lr: f64,
        next_batch: impl FnMut() -> Result<Batch, E>,
    ) -> anyhow::Result<StepReport> {
        let before = RunningStatistics::of(self.model(), self.optimizer.specs());
        let report = self.step_from(&before, lr, next_batch);
        if !report.as_ref().is_ok_and(StepReport::is_finite) {
            self.set_statistics(before);
        }
        report
    }

    /// As [`step`](Self::step), but without its guarantee about the running statistics.
    fn step_from<E: Into<anyhow::Error>>(
        &mut self,
        before: &RunningStatistics,
        lr: f64,
        mut next_batch: impl FnMut() -> Result<Batch, E>,
    ) -> anyhow::Result<StepReport> {
        let mut gradients = GradientSum::default();
        let share = self.reduce.share(self.grad_accumulation);
        let own: anyhow::Result<Vec<MicroBatch>> = share
            .map(|number| {
                let batch = next_batch().map_err(Into::into)?;
                // From zeros, they become this micro-batch's share alone.
                self.set_statistics(before.zeros());
                Ok(self.forward_and_backward(batch, number, &mut gradients))
            })
            .collect();
        let batches = self.reduce.concat(own)?;
        let mut report = StepReport::of(&batches);
        if report.loss.is_finite()
            && let Some(gradient) = self
                .reduce
                .sum(self.model(), gradients, self.grad_accumulation)
        {
            report.grad_norm = grad_norm(self.model(), &gradient);
            if report.is_finite() {
                let shares = batches.iter().map(|batch| batch.statistics.as_slice());
                self.set_statistics(before.updated(shares));
                self.update(lr, gradient, report.grad_norm);
            }
        }
        Ok(report)
    }

    /// Losses of the micro-batch `number`, and its share of the gradient of their mean, which is
    /// added to `gradients` if the losses are finite.
    fn forward_and_backward(
        &self,
        mut batch: Batch,
        number: usize,
        gradients: &mut GradientSum,
    ) -> MicroBatch {
        let patches = std::mem::take(&mut batch.patches);
        let tensor = self.losses(batch);
        let mean = tensor
            .clone()
            .mean()
            .div_scalar(self.grad_accumulation as f32);
        let losses: Vec<f32> = tensor.into_data().try_to_vec().expect("losses are float32");
        assert_eq!(patches.len(), losses.len(), "a place for each loss");
        if losses.iter().all(|loss| loss.is_finite()) {
            let model = self.model();
            let gradient = GradientsParams::from_grads(mean.backward(), model);
            gradients.add(model, number, gradient);
        }
        let statistics = RunningStatistics::of(self.model(), self.optimizer.specs());
        MicroBatch {
            patches,
            losses,
            statistics: statistics.values(),
        }
    }

    fn set_statistics(&mut self, statistics: RunningStatistics) {
        let specs = self.optimizer.specs();
        let model = self.model.take();
        self.model = model.map(|model| statistics.restore(model, specs));
    }

    /// The number of dormant channels. `None` before step 175: no channel can be dormant yet.
    pub fn dormant(&self) -> Option<DormantChannels> {
        let late = self.optimizer.steps() >= DORMANT_STEPS;
        late.then(|| self.optimizer.dormant())
    }

    /// The mean loss of the batches of all processes, of which these are this one's, without a step.
    ///
    /// # Errors
    /// A failed exchange between processes.
    pub fn mean_loss(&self, batches: impl Iterator<Item = Batch>) -> anyhow::Result<f64> {
        let own = batches.map(|batch| self.losses(batch).mean().into_scalar::<f32>());
        let losses = self.reduce.concat(Ok(own.collect()))?;
        let sum: f64 = losses.iter().copied().map(f64::from).sum();
        Ok(sum / losses.len() as f64)
    }

    fn update(&mut self, lr: f64, mut grads: GradientsParams, norm: f64) {
        if let Some(limit) = self.max_grad_norm.map(f64::from)
            && norm > limit
        {
            grads = scaled(self.model(), grads, limit / norm);
        }
        let before = self
            .model
            .take()
            .expect("the network is taken only within a step");
        let model = self.optimizer.step(lr, before, grads);
        if let Some(ema) = &mut self.ema {
            ema.update(&model.valid(), self.optimizer.steps());
        }
        self.model = Some(model);
    }

    /// Whether each network of KPCN has its own loss now.
    fn trains_separately(&self) -> bool {
        (self.optimizer.steps() as f64) < f64::from(self.loss.separate) * self.steps as f64
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
        let model = self.model();
        let colors = model.config().variant.spec().color_channels;
        let color = tensor(batch.color, colors);
        let features = tensor(batch.features, FEATURES);
        let ref_hdr = tensor(batch.reference_hdr, 3);
        let out = model.forward(color, features);
        let modulation = batch.modulation.map(|modulation| tensor(modulation, 3));
        let out_gamma = match (batch.reference_light, modulation) {
            (Some(light), _) if self.trains_separately() => {
                return kpcn::separate_losses(out, tensor(light, colors));
            }
            (Some(_), Some(divisor)) => kpcn::joined_gamma(out, divisor, self.gamma),
            (_, Some(modulation)) => out * modulation,
            (_, None) => in_gamma(out, self.transfer, self.gamma),
        };
        self.loss
            .per_image(self.model().ops(), out_gamma, ref_hdr, self.gamma)
    }
}

#[cfg(test)]
mod tests;
