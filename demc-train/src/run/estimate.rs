//! Estimates the duration of a run, from a few discarded training steps, and the memory of a step.

use std::convert::Infallible;
use std::fmt;
use std::time::Instant;

use anyhow::ensure;
use burn::tensor::Device;
use demc_data::{Batch, FEATURES};
use demc_infer::memory;
use demc_model::config::COLOR_CHANNELS;
use demc_program::message::duration;

use crate::config::Config;
use crate::run::data::TrainingData;
use crate::run::initial::random_network;
use crate::step::optimizer::Optimizer;
use crate::step::trainer::Trainer;

/// Share of the forward pass in a step. Ours: measured between 0.2 and 0.4.
const FORWARD_SHARE: f64 = 0.3;

/// Patches in the larger of two timed batches. Ours: enough to fill the kernels.
const LARGE_BATCH: usize = 4;

/// A step of more seconds than this is timed once. Ours: work done once, such as compiling shaders,
/// is a small part of it.
const LONG_STEP: f64 = 30.0;

const REPETITIONS: u32 = 6;
/// Seconds after which timing stops, so that the run starts soon (ours).
const TIME_LIMIT: f64 = 1.0;

/// Estimated duration of a run.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct DurationEstimate {
    /// Seconds per step.
    pub step: f64,
    /// Seconds per validation.
    pub validation: f64,
    /// Seconds for the remaining steps and validations.
    pub remaining: f64,
}

impl DurationEstimate {
    /// Estimates the time of the steps after `first_step` if `processes` share them, without their
    /// exchanges.
    ///
    /// It times steps on one patch and on four, which gives the time per patch and the constant
    /// time per step. With `data.batch_size = 1` the four are micro-batches.
    pub fn measure(
        config: &Config,
        data: &TrainingData,
        first_step: u64,
        device: &Device,
        processes: usize,
    ) -> Self {
        let mut single = config.clone();
        single.train.grad_accumulation = 1;
        let model = random_network(&config.model, 0, data.normalizer.flat_color, device);
        let mut trainer = Trainer::new(
            &single,
            model,
            Optimizer::new(&single),
            None,
            device.clone(),
        );
        let mut time_step = |batches: usize, batch: &Batch| {
            trainer.set_grad_accumulation(batches);
            let started = Instant::now();
            trainer
                .step(0.0, || Ok::<_, Infallible>(batch.clone()))
                .expect("no batch fails");
            started.elapsed().as_secs_f64()
        };
        let mut time = |batches: usize, patches: usize| {
            let batch = Batch::grey(config.inputs(), patches, config.data.patch_size);
            let (mut least, mut spent, mut times) = (f64::INFINITY, 0.0, 0);
            while times < 2 && spent < LONG_STEP || times < REPETITIONS && spent < TIME_LIMIT {
                let time = time_step(batches, &batch);
                (least, spent, times) = (least.min(time), spent + time, times + 1);
            }
            least
        };
        // At most a batch of the run: memory may not suffice for more.
        let large = LARGE_BATCH.min(config.data.batch_size);
        let one = time(1, 1);
        let patch_time = match config.train.grad_accumulation {
            _ if large > 1 => patch_time(one, large, time(1, large)),
            1 => one,
            batches => patch_time(
                one,
                LARGE_BATCH.min(batches),
                time(LARGE_BATCH.min(batches), 1),
            ),
        };
        let pixels: usize = data
            .validation
            .iter()
            .map(|scene| scene.width * scene.height)
            .sum();
        let patches = pixels as f64 / (config.data.patch_size * config.data.patch_size) as f64;
        let own_patches = config.patches_per_step() / processes as u64;
        let step = one + patch_time * (own_patches - 1) as f64;
        let validation = patch_time * patches * FORWARD_SHARE / processes as f64;
        let steps = config.train.steps.saturating_sub(first_step) as f64;
        let remaining = steps * (step + validation / config.run.validate_every as f64);
        DurationEstimate {
            step,
            validation,
            remaining,
        }
    }
}

/// Seconds per additional patch, from the times of steps with one patch and with several.
fn patch_time(one: f64, patches: usize, time: f64) -> f64 {
    match patches {
        0 | 1 => one,
        // Timings are noisy: a patch takes some time, but no more than a step of one patch.
        _ => ((time - one) / (patches - 1) as f64).clamp(0.1 * one, one),
    }
}

/// Refuses a configuration whose steps need clearly more than the available memory, which `processes`
/// processes share.
///
/// `device` has no autodiff. On a device other than the CPU, the memory is unknown and not checked.
///
/// # Errors
/// The step does not fit, even if the estimate is a third too large.
pub fn check_memory(config: &Config, device: &Device, processes: usize) -> anyhow::Result<()> {
    if *device != Device::flex() {
        return Ok(());
    }
    let Some(available) = memory::available() else {
        return Ok(());
    };
    let available = available / processes as u64;
    let needed = step_bytes(config);
    let batch = config.data.batch_size;
    ensure!(
        needed / 4 * 3 <= available,
        "data.batch_size = {batch}: a training step needs about {} MiB; {} MiB are available; lower it and \
         raise train.grad_accumulation",
        needed >> 20,
        available >> 20
    );
    Ok(())
}

/// Estimated bytes of a training step: the network's, and the batches that wait.
fn step_bytes(config: &Config) -> u64 {
    let data = &config.data;
    // Of each worker, one batch waits while it makes the next. One is in use.
    let batches = (2 * data.workers + 1) as u64;
    let planes = FEATURES + 2 * COLOR_CHANNELS;
    let patch = (planes * data.patch_size * data.patch_size * size_of::<f32>()) as u64;
    let waiting = batches * data.batch_size as u64 * patch;
    config.model.step_bytes(data.batch_size, data.patch_size) + waiting
}

impl fmt::Display for DurationEstimate {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(
            f,
            "about {} ({} per step)",
            duration(self.remaining),
            duration(self.step)
        )
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn patch_time_is_the_increase_per_patch() {
        // 100 ms per step and 50 ms per patch.
        assert!((patch_time(0.15, 4, 0.3) - 0.05).abs() < 1e-12);
        assert_eq!(patch_time(0.15, 1, 0.15), 0.15);
        assert_eq!(patch_time(0.2, 4, 0.1), 0.1 * 0.2);
        assert_eq!(patch_time(0.2, 2, 0.9), 0.2);
    }
}
