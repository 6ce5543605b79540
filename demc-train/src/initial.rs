//! The network that a run starts with.

use std::path::PathBuf;

use anyhow::{Context, ensure};
use burn::tensor::Device;
use demc_data::ranges::Ranges;
use demc_infer::bundle::BundleFile;
use demc_model::{Denoiser, ModelConfig};
use rand::SeedableRng;
use rand_chacha::ChaCha8Rng;
use serde::{Deserialize, Serialize};

use crate::checkpoint;
use crate::config::Config;

/// A network before its first step.
pub struct Initial {
    /// The network.
    pub model: Denoiser,
    /// Where it comes from, if it was trained before.
    pub origin: Option<Origin>,
}

/// The trained network that a run begins with, for `run.json`.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Origin {
    /// The file that `train.init` stands for.
    pub file: PathBuf,
    /// Its checksum.
    pub sha256: String,
    /// The last step of the run that it is from.
    pub step: u64,
    /// Its `data.demodulate`.
    pub demodulate: f32,
    /// Where the scenes lie that it was trained on before, if its file knows.
    #[serde(skip)]
    pub ranges: Option<Ranges>,
}

impl Origin {
    /// What the user of `config` should know of it.
    pub fn note(&self, config: &Config) -> String {
        let Origin { file, step, .. } = self;
        let begun = format!("train.init: {}, step {step}", file.display());
        let (there, here) = (self.demodulate, config.data.demodulate);
        match there == here {
            true => begun,
            false => format!(
                "{begun}, of data.demodulate = {there}: with {here} its input is another colour, which it has to learn first"
            ),
        }
    }
}

/// The network of `train.init`, or one [`drawn`] from the run's seed.
///
/// The statistics of that network's training set are not taken over: features are scaled by those of the run's own scenes.
///
/// # Errors
/// Those of [`read_init`]; weights that are not those of the network.
pub fn initial_model(
    config: &Config,
    flat_color: [f32; 3],
    device: &Device,
) -> anyhow::Result<Initial> {
    let Some(file) = read_init(config)? else {
        return Ok(Initial {
            model: drawn(&config.model, config.train.seed, flat_color, device),
            origin: None,
        });
    };
    let origin = Origin {
        file: file.path.clone(),
        sha256: checkpoint::sha256_of(&file.path)?,
        step: file.meta.step,
        demodulate: file.meta.normalizer.demodulate,
        ranges: file.meta.ranges.clone(),
    };
    Ok(Initial {
        model: file.into_bundle(device).context("train.init")?.model,
        origin: Some(origin),
    })
}

/// What `train.init` stands for, if it is set.
///
/// # Errors
/// A file that holds no network, or another one than `[model]` and `data.gamma` describe: each key that differs is named.
pub fn read_init(config: &Config) -> anyhow::Result<Option<BundleFile>> {
    let init = &config.train.init;
    if init.as_os_str().is_empty() {
        return Ok(None);
    }
    let file = BundleFile::read(init).context("train.init")?;
    let mut there = config.clone();
    // How it was drawn is all the same.
    there.model = ModelConfig {
        head: config.model.head,
        detail: config.model.detail,
        ..file.meta.model
    };
    there.data.gamma = file.meta.normalizer.gamma;
    let differences = config.differences(&there);
    ensure!(
        differences.is_empty(),
        "train.init: {}: another network: {}",
        init.display(),
        differences.join("; ")
    );
    Ok(Some(file))
}

/// A network drawn from a seed, its grey head at the best flat image.
pub fn drawn(model: &ModelConfig, seed: u64, flat_color: [f32; 3], device: &Device) -> Denoiser {
    model.init(&mut ChaCha8Rng::seed_from_u64(seed), flat_color, device)
}
