//! Whether a training step fits into memory, estimated before the first one.

use anyhow::ensure;
use burn::tensor::Device;
use demc_data::FEATURES;
use demc_infer::memory;
use demc_model::config::COLOR_CHANNELS;

use crate::config::Config;

/// Refuses a configuration whose steps need clearly more than the available memory.
///
/// `device` has no autodiff. On a device other than the CPU, the memory is unknown and not checked.
///
/// # Errors
/// The step does not fit, even if the estimate is a third too large.
pub fn check(config: &Config, device: &Device) -> anyhow::Result<()> {
    if *device != Device::flex() {
        return Ok(());
    }
    let Some(available) = memory::available() else {
        return Ok(());
    };
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
pub fn step_bytes(config: &Config) -> u64 {
    let data = &config.data;
    // Of each worker, one batch waits while it makes the next. One is in use.
    let batches = (2 * data.workers + 1) as u64;
    let planes = FEATURES + 2 * COLOR_CHANNELS;
    let patch = (planes * data.patch_size * data.patch_size * size_of::<f32>()) as u64;
    let waiting = batches * data.batch_size as u64 * patch;
    config.model.step_bytes(data.batch_size, data.patch_size) + waiting
}
