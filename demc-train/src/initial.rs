//! The network that a run starts with.

use anyhow::{Context, ensure};
use burn::tensor::Device;
use demc_data::ranges::Ranges;
use demc_infer::Bundle;
use demc_model::{Denoiser, ModelConfig};
use rand::SeedableRng;
use rand_chacha::ChaCha8Rng;

use crate::config::Config;

/// A network before its first step.
pub struct Initial {
    /// The network.
    pub model: Denoiser,
    /// Where the scenes lie that it was trained on before, if it was and its file knows.
    pub ranges: Option<Ranges>,
}

/// The network of `train.init`, or one [`drawn`] from the run's seed.
///
/// The statistics of that network's training set are not taken over: features are scaled by those of the run's own scenes.
///
/// # Errors
/// A file that holds no network, or another one than `[model]` and `data.gamma` describe: each key that differs is named.
pub fn initial_model(
    config: &Config,
    flat_color: [f32; 3],
    device: &Device,
) -> anyhow::Result<Initial> {
    let init = &config.train.init;
    if init.as_os_str().is_empty() {
        return Ok(Initial {
            model: drawn(&config.model, config.train.seed, flat_color, device),
            ranges: None,
        });
    }
    let Bundle { meta, model } = Bundle::load(init, device).context("train.init")?;
    let mut there = config.clone();
    // How it was drawn is all the same.
    there.model = ModelConfig {
        head: config.model.head,
        detail: config.model.detail,
        ..meta.model
    };
    there.data.gamma = meta.normalizer.gamma;
    let differences = config.differences(&there);
    ensure!(
        differences.is_empty(),
        "train.init: {}: another network: {}",
        init.display(),
        differences.join("; ")
    );
    Ok(Initial {
        model,
        ranges: meta.ranges,
    })
}

/// A network drawn from a seed, its grey head at the best flat image.
pub fn drawn(model: &ModelConfig, seed: u64, flat_color: [f32; 3], device: &Device) -> Denoiser {
    model.init(&mut ChaCha8Rng::seed_from_u64(seed), flat_color, device)
}
