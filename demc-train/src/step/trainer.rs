//! One optimizer step: batches, forward pass, loss (Eq. 5), backward pass, clipping, update,
//! average.

use burn::module::Module;
use burn::optim::GradientsParams;
use burn::tensor::{Device, Tensor, TensorData};
use demc_data::{Batch, FEATURES, Patch, Scene};
use demc_model::{Denoiser, LossConfig};
use serde::{Deserialize, Serialize};

use crate::config::Config;
use crate::ranks::Ranks;
use crate::ranks::tree::{Block, PairwiseSum};
use crate::step::ema::Ema;
use crate::step::gradients::{added, flattened, grad_norm, scaled, with_values};
use crate::step::optimizer::{DORMANT_STEPS, DormantChannels, Optimizer};
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
    ranks: Ranks,
}

/// What every rank needs to know of a micro-batch.
#[derive(Clone, Debug, Serialize, Deserialize)]
struct MicroBatch {
    /// Scene, y and x of each patch.
    patches: Vec<(u32, u32, u32)>,
    /// Loss of each patch, as bits: a loss may be infinite or NaN.
    losses: Vec<u32>,
    /// Its share in the running statistics, as bits.
    statistics: Vec<u32>,
}

/// This rank's part of a step.
struct OwnPart {
    batches: Vec<MicroBatch>,
    gradients: PairwiseSum<GradientsParams>,
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
        let patches = batches.iter().flat_map(|batch| {
            let losses = batch.losses.iter().map(|bits| f32::from_bits(*bits));
            let patches = batch.patches.iter();
            patches
                .map(|&(scene, y, x)| Patch { scene, y, x })
                .zip(losses.map(f64::from))
        });
        let patches: Vec<_> = patches.collect();
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
            ranks: Ranks::default(),
        }
    }

    /// The trainer of one of `ranks`, which take every step together.
    pub fn on(self, ranks: Ranks) -> Self {
        Trainer { ranks, ..self }
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
    /// those of this rank's share.
    ///
    /// If loss or gradient are not finite, the step is skipped: network and running statistics stay
    /// as they were.
    ///
    /// # Errors
    /// Those of `next_batch` on any rank; the weights stay as they were.
    pub fn step<E: Into<anyhow::Error>>(
        &mut self,
        lr: f64,
        next_batch: impl FnMut() -> Result<Batch, E>,
    ) -> anyhow::Result<StepReport> {
        let before = RunningStatistics::of(self.model(), self.optimizer.specs());
        let own = self.own_part(&before, next_batch);
        let (batches, gradients) = match own {
            Ok(part) => (Ok(part.batches), Some(part.gradients)),
            Err(error) => (Err(error), None),
        };
        let batches = match self.ranks.gather(batches) {
            Ok(batches) => batches.into_iter().flatten().collect::<Vec<_>>(),
            Err(error) => {
                self.set_statistics(before);
                return Err(error);
            }
        };
        let mut report = StepReport::of(&batches);
        if report.loss.is_finite()
            && let Some(gradients) = gradients.and_then(|own| self.summed(own))
        {
            report.grad_norm = grad_norm(self.model(), &gradients);
            if report.is_finite() {
                let shares = batches.iter().map(|batch| batch.statistics.as_slice());
                self.set_statistics(before.updated(shares));
                self.update(lr, gradients, report.grad_norm);
                return Ok(report);
            }
        }
        self.set_statistics(before);
        Ok(report)
    }

    /// Forward and backward pass of this rank's micro-batches.
    fn own_part<E: Into<anyhow::Error>>(
        &mut self,
        before: &RunningStatistics,
        mut next_batch: impl FnMut() -> Result<Batch, E>,
    ) -> anyhow::Result<OwnPart> {
        let mut part = OwnPart {
            batches: Vec::new(),
            gradients: PairwiseSum::default(),
        };
        let mut is_finite = true;
        for number in self.ranks.share(self.grad_accumulation) {
            let mut batch = next_batch().map_err(Into::into)?;
            let patches = std::mem::take(&mut batch.patches);
            // From zero, they become this batch's share alone.
            self.set_statistics(before.zeros());
            let batch_losses = self.losses(batch);
            let mean = batch_losses
                .clone()
                .mean()
                .div_scalar(self.grad_accumulation as f32);
            let losses = batch_losses.into_data().try_to_vec::<f32>();
            let losses = losses.expect("losses are float32");
            assert_eq!(patches.len(), losses.len(), "a place for each loss");
            is_finite &= losses.iter().all(|loss| loss.is_finite());
            if is_finite {
                let model = self.model();
                let block = Block {
                    first: number,
                    terms: 1,
                    sum: GradientsParams::from_grads(mean.backward(), model),
                };
                part.gradients
                    .push(block, |left, right| added(model, left, right));
            }
            let statistics = RunningStatistics::of(self.model(), self.optimizer.specs());
            part.batches.push(MicroBatch {
                patches: patches.iter().map(|p| (p.scene, p.y, p.x)).collect(),
                losses: losses.into_iter().map(f32::to_bits).collect(),
                statistics: statistics.bits(),
            });
        }
        Ok(part)
    }

    /// The sum of the gradients of all micro-batches of all ranks.
    fn summed(&self, own: PairwiseSum<GradientsParams>) -> Option<GradientsParams> {
        let model = self.model();
        if self.ranks.count() == 1 {
            return own.total(|left, right| added(model, left, right));
        }
        let mut shape = None;
        let blocks = own.into_blocks().into_iter().map(|block| {
            let Block { first, terms, sum } = block;
            let values = flattened(model, &sum);
            shape.get_or_insert(sum);
            Block {
                first,
                terms,
                sum: values,
            }
        });
        let blocks = blocks.collect();
        let values = self.ranks.sum(blocks, self.grad_accumulation)?;
        Some(with_values(model, shape?, &values))
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

    /// The mean loss of this rank's batches and those of the other ranks, without a step.
    ///
    /// # Errors
    /// A failed exchange between ranks.
    pub fn mean_loss(&self, batches: impl Iterator<Item = Batch>) -> anyhow::Result<f64> {
        let losses = batches.map(|batch| self.losses(batch).mean().into_scalar::<f32>().to_bits());
        let losses = self
            .ranks
            .gather(Ok(losses.collect::<Vec<u32>>()))?
            .concat();
        let sum: f64 = losses
            .iter()
            .map(|bits| f64::from(f32::from_bits(*bits)))
            .sum();
        Ok(sum / losses.len() as f64)
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
