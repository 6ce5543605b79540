//! The bundle: one safetensors file with the weights of a network and all data that its output
//! depends on.
//!
//! The weights are tensors by name ([`Names`]: Burn's or PyTorch's) in f32 or f16 ([`Precision`];
//! batch normalisation stays f32). The header's metadata has one key, `demc`: [`BundleMeta`] as
//! JSON, with the keys `names` and `sha256` added ([`checksum`]). A single key keeps the bytes
//! reproducible, because the `safetensors` crate writes metadata in random order.
//!
//! Statistics are stored with the weights because every output value depends on them. Weights
//! without them do not load, and no flag replaces them. The layout is that of the training data;
//! another file may have another one.
//!
//! A bundle may contain a second network, the albedo filter. Its tensors have the prefix
//! `albedo_filter.`, and the header entry has its [`BundleMeta`] as `albedo_filter`.

mod bundled;
pub mod checksum;
mod encode;
mod error;
mod file;
mod import;
pub mod locate;
mod meta;
mod names;
mod network;
pub mod tensors;

use std::io::Write;
use std::path::Path;

use burn::tensor::Device;
use demc_model::{Weights, WeightsError};
use demc_program::checksum::sha256;

pub use bundled::Bundled;
pub(crate) use encode::Description;
pub use error::BundleError;
pub use file::BundleFile;
pub use meta::{BundleMeta, FORMAT};
pub use names::{Names, Precision};
pub use network::Bundle;
pub(crate) use network::PREFIX;

impl Bundle {
    /// Writes the bundle to `path` atomically, with mode 0644. Equal bundles give equal bytes.
    ///
    /// # Errors
    /// A weight beyond f16's range (nothing is written), or a path that cannot be written.
    pub fn save(&self, path: &Path, names: Names, precision: Precision) -> Result<(), BundleError> {
        let bytes = self.to_bytes(names, precision)?;
        demc_program::file::write_whole(path, |file| file.write_all(&bytes))?;
        Ok(())
    }

    /// The SHA-256 of the bundle's file, in 64 hexadecimal digits: equal for equal bundles.
    ///
    /// # Errors
    /// None for a bundle that was loaded.
    pub(crate) fn checksum(&self) -> Result<String, BundleError> {
        let bytes = self.to_bytes(Names::Burn, Precision::F32)?;
        Ok(sha256([bytes.as_slice()]))
    }

    /// The bytes of the bundle's file. Equal bundles give equal bytes.
    ///
    /// # Errors
    /// A weight beyond f16's range.
    pub fn to_bytes(&self, names: Names, precision: Precision) -> Result<Vec<u8>, BundleError> {
        encode::encode(self, names, precision)
    }

    /// Writes as [`save`](Self::save), reads the file back and compares: metadata and f32 tensors
    /// bit for bit, f16 tensors within rounding.
    ///
    /// # Errors
    /// As `save`, and [`BundleError::ReadBack`] with the first difference.
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
        let back = BundleFile::read(path)?;
        if back.names != names {
            return Err(differs("the header".into()));
        }
        match self.difference(&back, precision) {
            None => Ok(()),
            Some(what) => Err(differs(what)),
        }
    }

    /// The first difference to `back`, which was written with this precision.
    fn difference(&self, back: &BundleFile, precision: Precision) -> Option<String> {
        if back.meta != self.meta {
            return Some("the header".into());
        }
        let specs = self.meta.model.weight_specs().into_iter();
        let roles = specs.map(|spec| spec.role);
        let mut written: Vec<_> = self.model.weights().into_iter().zip(roles).collect();
        written.sort_by(|(a, _), (b, _)| a.name.cmp(&b.name));
        if written.len() != back.weights.len() {
            return Some("the number of tensors".into());
        }
        let mut pairs = written.iter().zip(&back.weights);
        let other = pairs.find(|((weight, role), read)| !precision.preserves(*role, weight, read));
        if let Some(((weight, _), _)) = other {
            return Some(format!("tensor {}", weight.name));
        }
        match (&self.albedo_filter, &back.albedo_filter) {
            (None, None) => None,
            (Some(filter), Some(back)) => {
                let what = filter.difference(back, precision);
                what.map(|what| format!("in the albedo filter, {what}"))
            }
            _ => Some("the albedo filter".into()),
        }
    }

    /// The bundle as a file of this precision holds it: with rounded weights for f16.
    ///
    /// # Errors
    /// A weight beyond f16's range.
    pub fn rounded(&self, precision: Precision) -> Result<Self, BundleError> {
        match precision {
            Precision::F32 => Ok(self.clone()),
            Precision::F16 => {
                let bytes = self.to_bytes(Names::Burn, precision)?;
                BundleFile::parse("memory".into(), &bytes)?.into_bundle(&self.device())
            }
        }
    }

    /// Loads a run directory, a checkpoint directory or a bundle file onto `device`.
    ///
    /// A run directory stands for its best weights, or for those of the latest checkpoint if there
    /// are none. Both sets of names load; f16 tensors become f32.
    ///
    /// # Errors
    /// As [`BundleFile::read`]; a missing, superfluous or misshaped tensor, by name.
    pub fn load(path: &Path, device: &Device) -> Result<Self, BundleError> {
        BundleFile::read(path)?.into_bundle(device)
    }
}

impl BundleFile {
    /// The network that the file describes, with its weights, on `device`. Its albedo filter is on
    /// the device without autodiff, because it is never trained there.
    ///
    /// # Errors
    /// A missing, superfluous or misshaped tensor, by name.
    pub fn into_bundle(self, device: &Device) -> Result<Bundle, BundleError> {
        self.build("", device)
    }

    /// Builds the network. Errors name tensors with `prefix`.
    fn build(self, prefix: &str, device: &Device) -> Result<Bundle, BundleError> {
        let Self {
            path,
            meta,
            weights,
            albedo_filter,
            ..
        } = self;
        let loaded = meta.model.load(&mut Weights::new(weights), device);
        let model = loaded.map_err(|mut source| {
            match &mut source {
                WeightsError::Missing { name }
                | WeightsError::Shape { name, .. }
                | WeightsError::Unknown { name, .. } => name.insert_str(0, prefix),
            }
            BundleError::Weights { path, source }
        })?;
        let mut bundle = Bundle::new(meta, model);
        if let Some(file) = albedo_filter {
            let filter = file.build(PREFIX, &device.clone().without_autodiff())?;
            bundle.albedo_filter = Some(Box::new(filter));
        }
        Ok(bundle)
    }
}

#[cfg(test)]
mod filter_tests;
#[cfg(test)]
mod hostile;
#[cfg(test)]
pub(crate) mod testing;
#[cfg(test)]
mod tests;
