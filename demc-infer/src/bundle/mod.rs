//! The bundle: one safetensors file with the weights of a network and everything else that its output depends on.
//!
//! The weights are tensors by name ([`Names`]: Burn's or PyTorch's) in f32 or f16 ([`Precision`]; batch normalisation
//! stays f32). The header's metadata has one key, `demc`: [`BundleMeta`] as JSON, with the key `names` added. One key,
//! because the `safetensors` crate keeps metadata in a hash map and writes it in random order: the same bundle
//! gives the same bytes.
//!
//! Statistics and layout live with the weights on purpose: weights without them do not load, and no flag replaces
//! them, since every number of the output depends on them.

mod encode;
mod error;
mod file;
mod import;
pub mod locate;
pub mod tensors;

use std::io::Write;
use std::path::Path;

use burn::tensor::Device;
use demc_data::{ChannelLayout, Normalizer, Ranges};
use demc_model::{Denoiser, ModelConfig, Weights};
use serde::{Deserialize, Serialize};

pub use encode::{Names, Precision};
pub use error::BundleError;
pub use file::BundleFile;

/// The bundle format that this build writes and reads. It goes up when a tensor's name or meaning changes.
pub const FORMAT: u32 = 1;

/// Everything about a network but its weights.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct BundleMeta {
    /// Bundle format, [`FORMAT`].
    pub format: u32,
    /// Variant, reading and width.
    pub model: ModelConfig,
    /// Gamma and the training set's statistics.
    pub normalizer: Normalizer,
    /// Which channels of a renderer's files are the 15 planes.
    pub layout: ChannelLayout,
    /// Optimizer steps that the weights have seen.
    pub step: u64,
    /// What the training scenes were like, one by one; none in a bundle from elsewhere. The network does not need it,
    /// [`guard`](crate::guard) does.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub ranges: Option<Ranges>,
}

impl BundleMeta {
    /// Metadata in the current [`FORMAT`].
    pub fn new(
        model: ModelConfig,
        normalizer: Normalizer,
        layout: ChannelLayout,
        step: u64,
    ) -> Self {
        Self {
            format: FORMAT,
            model,
            normalizer,
            layout,
            step,
            ranges: None,
        }
    }

    /// The same with what the training scenes were like.
    pub fn with_ranges(self, ranges: Ranges) -> Self {
        Self {
            ranges: Some(ranges),
            ..self
        }
    }
}

/// A network ready to denoise, with its metadata.
///
/// The model belongs on a plain device: on one with autodiff, batch normalisation would use the statistics of the
/// image at hand.
#[derive(Debug, Clone)]
pub struct Bundle {
    /// Everything about the network but its weights.
    pub meta: BundleMeta,
    /// The network.
    pub model: Denoiser,
}

impl Bundle {
    /// Writes the bundle to `path`, whole or not at all, mode 0644. Equal bundles give equal bytes.
    ///
    /// # Errors
    /// A weight that f16 cannot hold (before anything is written), or a path that cannot be written.
    pub fn save(&self, path: &Path, names: Names, precision: Precision) -> Result<(), BundleError> {
        let bytes = self.to_bytes(names, precision)?;
        demc_data::file::write_whole(path, |file| file.write_all(&bytes))?;
        Ok(())
    }

    /// The bytes of the bundle's file. Equal bundles give equal bytes.
    ///
    /// # Errors
    /// A weight that f16 cannot hold.
    pub fn to_bytes(&self, names: Names, precision: Precision) -> Result<Vec<u8>, BundleError> {
        encode::encode(&self.meta, self.model.weights(), names, precision)
    }

    /// [`save`](Self::save), then reads the file back and compares: metadata and f32 tensors bit for bit, f16
    /// tensors within their rounding.
    ///
    /// # Errors
    /// As `save`, and [`BundleError::ReadBack`] with the first thing that differs.
    pub fn export(
        &self,
        path: &Path,
        names: Names,
        precision: Precision,
    ) -> Result<(), BundleError> {
        self.save(path, names, precision)?;
        let differs = |what: String| BundleError::ReadBack {
            path: path.into(),
            what,
        };
        let mut back = BundleFile::read(path)?;
        if back.meta != self.meta || back.names != names {
            return Err(differs("the header".into()));
        }
        let mut weights = self.model.weights();
        weights.sort_by(|a, b| a.name.cmp(&b.name));
        back.weights.sort_by(|a, b| a.name.cmp(&b.name));
        if weights.len() != back.weights.len() {
            return Err(differs("the number of tensors".into()));
        }
        match weights
            .iter()
            .zip(&back.weights)
            .find(|(ours, theirs)| !precision.keeps(ours, theirs))
        {
            None => Ok(()),
            Some((ours, _)) => Err(differs(format!("tensor {}", ours.name))),
        }
    }

    /// The bundle that a file of this precision holds: in f16 with its weights rounded.
    ///
    /// # Errors
    /// A weight that f16 cannot hold.
    pub fn rounded(&self, precision: Precision) -> Result<Self, BundleError> {
        match precision {
            Precision::F32 => Ok(self.clone()),
            Precision::F16 => {
                let bytes = self.to_bytes(Names::Burn, precision)?;
                BundleFile::parse("memory".into(), &bytes)?.into_bundle(&self.device())
            }
        }
    }

    /// Loads a run directory (its best weights, else those of the latest checkpoint), a checkpoint directory or a
    /// bundle file, with either set of names, onto `device`. f16 tensors become f32.
    ///
    /// # Errors
    /// Each [`BundleError`] of reading; a tensor that is missing, left over or misshaped is named.
    pub fn load(path: &Path, device: &Device) -> Result<Self, BundleError> {
        BundleFile::read(path)?.into_bundle(device)
    }
}

impl BundleFile {
    /// The network that the file describes, with its weights, on `device`.
    ///
    /// # Errors
    /// A tensor that is missing, left over or misshaped.
    pub fn into_bundle(self, device: &Device) -> Result<Bundle, BundleError> {
        let Self {
            path,
            meta,
            weights,
            ..
        } = self;
        let model = meta
            .model
            .load(&mut Weights::new(weights), device)
            .map_err(|source| BundleError::Weights { path, source })?;
        Ok(Bundle { meta, model })
    }
}

#[cfg(test)]
mod hostile;
#[cfg(test)]
pub(crate) mod testing;
#[cfg(test)]
mod tests;
