//! The network before its first step: random, or the weights of `train.init`.

use std::collections::BTreeMap;
use std::path::PathBuf;

use anyhow::{Context, bail, ensure};
use burn::tensor::Device;
use demc_data::input::ranges::Ranges;
use demc_infer::bundle::{Bundle, BundleFile, Bundled};
use demc_model::{Denoiser, ModelConfig, Weight, Weights};
use demc_program::checksum::{sha256, sha256_of};
use rand::SeedableRng;
use rand_chacha::ChaCha8Rng;
use serde::{Deserialize, Serialize};

use crate::config::Config;

/// A network before its first step.
pub struct InitialNetwork {
    /// The network.
    pub model: Denoiser,
    /// The albedo filter of `train.init`, without autodiff. The run keeps it unchanged.
    pub albedo_filter: Option<Box<Bundle>>,
    /// The source of its weights; `None` after random initialisation.
    pub weights: Option<InitialWeights>,
}

/// The weights of `train.init`, for `run.json`.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct InitialWeights {
    /// The file that `train.init` names or contains.
    pub file: PathBuf,
    /// Its checksum.
    pub sha256: String,
    /// The step of the run that wrote it.
    pub step: u64,
    /// The `data.albedo_demodulation_epsilon` of that run.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub albedo_demodulation_epsilon: Option<f32>,
    /// The ranges of the scenes of that run, if the file contains them.
    #[serde(skip)]
    pub ranges: Option<Ranges>,
    /// Their licence, if they come from another program.
    #[serde(skip)]
    pub license: Option<String>,
}

/// The notice of changes that Apache-2.0 asks for.
const CHANGED: &str = "; changed by training";

impl InitialWeights {
    /// The licence of weights that are trained from these.
    pub(super) fn license_of_changed(&self) -> Option<String> {
        let license = self.license.as_deref()?;
        let unchanged = license.strip_suffix(CHANGED).unwrap_or(license);
        Some(format!("{unchanged}{CHANGED}"))
    }

    /// A note for the user on these weights in a run of `config`.
    pub fn note(&self, config: &Config) -> String {
        let InitialWeights { file, step, .. } = self;
        let note = format!("train.init: {}, step {step}", file.display());
        let shown = |epsilon: Option<f32>| epsilon.map_or("absent".into(), |e| e.to_string());
        let [before, now] = [
            self.albedo_demodulation_epsilon,
            config.data.albedo_demodulation_epsilon,
        ];
        if before == now {
            note
        } else {
            format!(
                "{note}; data.albedo_demodulation_epsilon: {} instead of {}, so the network adapts to a \
                 different input colour first",
                shown(now),
                shown(before)
            )
        }
    }
}

/// The network of `train.init`, or a random one from the seed.
///
/// Features are normalised by the statistics of this run's scenes, not by those of the initial
/// weights.
///
/// # Errors
/// Those of [`read_init`]; a file whose weights do not fit its network.
pub fn initial_network(
    config: &Config,
    flat_color: [f32; 3],
    device: &Device,
) -> anyhow::Result<InitialNetwork> {
    let Some(file) = read_init(config)? else {
        return Ok(InitialNetwork {
            model: random_network(&config.model, config.train.seed, flat_color, device),
            albedo_filter: None,
            weights: None,
        });
    };
    let bundled = config.train.init.as_deref().and_then(Bundled::named);
    let weights = InitialWeights {
        file: file.path.clone(),
        sha256: match bundled {
            Some(model) => sha256([model.bytes()]),
            None => sha256_of(&file.path)?,
        },
        step: file.meta.step,
        albedo_demodulation_epsilon: file.meta.normalizer.albedo_demodulation_epsilon,
        ranges: file.meta.ranges.clone(),
        license: file.meta.license.clone(),
    };
    let Bundle {
        model,
        albedo_filter,
        ..
    } = file.into_bundle(device).context("train.init")?;
    let model = if *model.config() == config.model {
        model
    } else {
        let seed = config.train.seed;
        grown(
            &model,
            random_network(&config.model, seed, flat_color, device),
            device,
        )
    };
    Ok(InitialNetwork {
        model,
        albedo_filter,
        weights: Some(weights),
    })
}

/// `whole` with the weights of `trunk`, a part of it.
fn grown(trunk: &Denoiser, whole: Denoiser, device: &Device) -> Denoiser {
    let mut weights: BTreeMap<String, Weight> = BTreeMap::new();
    for weight in whole.weights().into_iter().chain(trunk.weights()) {
        weights.insert(weight.name.clone(), weight);
    }
    let mut weights = Weights::new(weights.into_values().collect());
    let grown = whole.config().load(&mut weights, device);
    grown.expect("a trunk has weights of the whole")
}

/// The file of `train.init`, if it is set.
///
/// # Errors
/// A file without a network; a network that differs from `[model]`, `data.gamma`, or `data.transfer`,
/// with each differing key; an albedo filter with another `data.position`.
pub fn read_init(config: &Config) -> anyhow::Result<Option<BundleFile>> {
    let Some(init) = &config.train.init else {
        return Ok(None);
    };
    let file = BundleFile::read(init).context("train.init")?;
    let mut saved = config.clone();
    // Its own initialisation does not matter.
    let theirs = file.meta.model.head;
    saved.model = if config.model.trunk() == Some(file.meta.model) {
        config.model
    } else {
        ModelConfig {
            head: if theirs.has_weights_of(config.model.head) {
                config.model.head
            } else {
                theirs
            },
            detail: config.model.detail,
            ..file.meta.model
        }
    };
    saved.data.gamma = file.meta.normalizer.gamma;
    saved.data.transfer = file.meta.normalizer.transfer;
    let differences = config.differences(&saved);
    ensure!(
        differences.is_empty(),
        "train.init: {}: weights of another network: {}",
        init.display(),
        differences.join("; ")
    );
    let filter = file.albedo_filter.as_deref();
    let problem = filter.and_then(|filter| {
        filter
            .meta
            .filter_problem(config.inputs(), config.data.position)
    });
    if let Some(problem) = problem {
        bail!("train.init: {}: {problem}", init.display());
    }
    Ok(Some(file))
}

/// A network with random weights from a seed; a grey head starts at the best flat image.
pub fn random_network(
    model: &ModelConfig,
    seed: u64,
    flat_color: [f32; 3],
    device: &Device,
) -> Denoiser {
    model.init(&mut ChaCha8Rng::seed_from_u64(seed), flat_color, device)
}
