//! Network, optimizer, and state of a run before the first step of a session.

use std::path::Path;

use anyhow::ensure;
use burn::tensor::Device;
use demc_infer::bundle::Bundle;
use demc_model::Denoiser;

use crate::config::Config;
use crate::run::checkpoint::{Checkpoint, TrainingProgress};
use crate::run::data::TrainingData;
use crate::run::initial::{InitialNetwork, InitialWeights, initial_network};
use crate::step::optimizer::Optimizer;

/// What a session starts from: a new run, or a checkpoint.
pub(super) struct StartingPoint {
    pub(super) model: Denoiser,
    pub(super) albedo_filter: Option<Box<Bundle>>,
    pub(super) average: Option<Denoiser>,
    pub(super) optimizer: Optimizer,
    pub(super) state: TrainingProgress,
    pub(super) initial: Option<InitialWeights>,
}

impl StartingPoint {
    /// Step 0. The ranges of the initial weights' scenes are added to those of `data`.
    pub(super) fn of_new_run(
        config: &Config,
        data: &mut TrainingData,
        device: &Device,
    ) -> anyhow::Result<Self> {
        let InitialNetwork {
            model,
            albedo_filter,
            weights,
        } = initial_network(config, data.normalizer.flat_color, device)?;
        let before = weights.as_ref().and_then(|weights| weights.ranges.as_ref());
        if let Some(before) = before {
            data.ranges = data.ranges.with(before);
        }
        data.license = weights
            .as_ref()
            .and_then(InitialWeights::license_of_changed);
        Ok(StartingPoint {
            model,
            albedo_filter,
            average: None,
            optimizer: Optimizer::new(config),
            state: TrainingProgress::start(),
            initial: weights,
        })
    }

    /// The step of `checkpoint`, which has the ranges of `data`, too. `run` names the run in errors.
    pub(super) fn of_checkpoint(
        checkpoint: Checkpoint,
        config: &Config,
        data: &mut TrainingData,
        run: &Path,
    ) -> anyhow::Result<Self> {
        let Checkpoint {
            bundle,
            average,
            optimizer,
            state,
        } = checkpoint;
        if let Some(ranges) = &bundle.meta.ranges {
            data.ranges = ranges.clone();
        }
        data.license = bundle.meta.license.clone();
        ensure!(
            bundle.meta == data.meta(config.model, state.step),
            "{}: network, layout or statistics of the checkpoint differ from this run's",
            run.display()
        );
        ensure!(
            average.is_some() == config.train.ema_decay.is_some(),
            "{}: either the checkpoint or train.ema_decay has no weight average",
            run.display()
        );
        Ok(StartingPoint {
            model: bundle.model,
            albedo_filter: bundle.albedo_filter,
            average,
            optimizer,
            state,
            initial: None,
        })
    }
}
