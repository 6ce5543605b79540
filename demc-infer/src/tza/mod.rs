//! Weights of Open Image Denoise (OIDN): finds them in a library or a TZA file, makes a bundle of them, and
//! writes a bundle as a TZA file.
//!
//! OIDN's library holds a TZA file per network, as data with an exported name such as
//! `oidn::blobs::weights::rt_hdr_alb_nrm`.

mod format;
mod network;

use std::io::{self, Read, Write};
use std::path::{Path, PathBuf};

use burn::tensor::Device;
use demc_data::{ChannelLayout, FEATURES, FeatureStats, Normalizer, PositionSpace, Transfer};
use demc_model::unet::{Guides, UnetSize};
use demc_model::{ModelConfig, Variant, Weight, Weights};
use object::{Object, ObjectSymbol};
use thiserror::Error;

pub use format::TzaError;

use crate::{Bundle, BundleError, BundleMeta, Precision};

/// OIDN's target for the exposure of an image.
const EXPOSURE_LEVEL: f32 = 0.18;

/// Name of the weights that `high` quality takes with noisy albedo and normal.
pub const DEFAULT_WEIGHTS: &str = "rt_hdr_alb_nrm";

/// Most sets of weights that are read from a library; OIDN 2.5 has 23.
const MOST_SETS: usize = 100;

/// The licence of the weights that OIDN ships.
const LICENSE: &str =
    "Apache-2.0; from the weights of Open Image Denoise, Copyright Intel Corporation";

/// A set of weights in a file of OIDN.
#[derive(Clone, Debug, PartialEq)]
pub struct WeightSet {
    /// The name in OIDN's library, such as `rt_hdr_alb_nrm`; `None` for a TZA file, and for a library
    /// without names.
    pub name: Option<String>,
    /// The size of the network.
    pub size: UnetSize,
    /// What the network takes beside the colour.
    pub guides: Guides,
    weights: Vec<Weight>,
}

impl WeightSet {
    /// Whether the network denoises HDR colour. Others expect another curve, or denoise a guide alone.
    pub fn is_hdr(&self) -> bool {
        let name = self.name.as_deref();
        name.is_none_or(|name| name.starts_with("rt_hdr"))
    }

    /// The configuration of the network.
    pub fn model(&self) -> ModelConfig {
        ModelConfig {
            variant: Variant::Unet,
            size: self.size,
            guides: self.guides,
            ..ModelConfig::default()
        }
    }
}

/// Why weights of OIDN cannot be imported or written.
#[derive(Debug, Error)]
#[non_exhaustive]
#[allow(missing_docs, reason = "the messages explain the fields")]
pub enum OidnError {
    /// The file cannot be read.
    #[error("cannot read {}", path.display())]
    Read { path: PathBuf, source: io::Error },
    /// A TZA file that is damaged.
    #[error("{}: {source}", path.display())]
    Tza { path: PathBuf, source: TzaError },
    /// Neither a library with weights nor a TZA file.
    #[error("{}: neither a library of Open Image Denoise 2 nor a TZA file", path.display())]
    NoWeights { path: PathBuf },
    /// A TZA file with another network.
    #[error("{}: the tensors are those of no network of Open Image Denoise 2", path.display())]
    OtherNetwork { path: PathBuf },
    /// No weights of this name or number.
    #[error("{}: no weights `{wanted}`; it has {known}", path.display())]
    Unknown {
        path: PathBuf,
        wanted: String,
        known: String,
    },
    /// Weights for another kind of image.
    #[error(
        "{name}: weights for other images than HDR colour; only those named rt_hdr are imported"
    )]
    NotHdr { name: String },
    /// A network that OIDN does not have.
    #[error(
        "{model}: Open Image Denoise has only networks of variant unet with data.transfer = \"pu\""
    )]
    NotUnet { model: String },
    /// A network with an albedo filter.
    #[error("Open Image Denoise has no albedo filter; remove it with --albedo-filter none")]
    AlbedoFilter,
    /// The weights cannot be rounded or written.
    #[error(transparent)]
    Bundle(#[from] BundleError),
}

/// All weights in a library of OIDN, or the ones of a TZA file.
///
/// # Errors
/// The file cannot be read; it holds no weights.
pub fn weight_sets(path: &Path) -> Result<Vec<WeightSet>, OidnError> {
    let mut bytes = Vec::new();
    demc_program::file::open_regular(path)
        .and_then(|mut file| file.read_to_end(&mut bytes))
        .map_err(|source| OidnError::Read {
            path: path.into(),
            source,
        })?;
    parse(path, &bytes)
}

/// As [`weight_sets`], of the bytes of a file. `path` is its name in errors.
///
/// # Errors
/// The bytes hold no weights.
pub fn parse(path: &Path, bytes: &[u8]) -> Result<Vec<WeightSet>, OidnError> {
    if bytes.starts_with(&format::START) {
        let tensors = format::read(bytes).map_err(|source| OidnError::Tza {
            path: path.into(),
            source,
        })?;
        let set = network::identify(tensors, None);
        return Ok(vec![
            set.ok_or_else(|| OidnError::OtherNetwork { path: path.into() })?,
        ]);
    }
    let names = names(bytes);
    let starts = memchr::memmem::find_iter(bytes, &format::START);
    let sets: Vec<WeightSet> = starts
        .take(MOST_SETS)
        .filter_map(|at| {
            // The bytes may be there by chance.
            let tensors = format::read(&bytes[at..]).ok()?;
            let name = names.iter().find(|(place, _)| *place == at);
            network::identify(tensors, name.map(|(_, name)| name.clone()))
        })
        .collect();
    if sets.is_empty() {
        return Err(OidnError::NoWeights { path: path.into() });
    }
    Ok(sets)
}

/// The places of weights in a library, and their names; empty for other files.
fn names(library: &[u8]) -> Vec<(usize, String)> {
    let Ok(file) = object::File::parse(library) else {
        return Vec::new();
    };
    let symbols = file.dynamic_symbols().chain(file.symbols());
    let named = symbols.filter_map(|symbol| {
        let name = short_name(symbol.name().ok()?)?;
        Some((place(&file, symbol.address())?, name))
    });
    named.collect()
}

/// The name in a symbol: `rt_hdr` of `_ZN4oidn5blobs7weights6rt_hdrE`, or of the same with Microsoft's
/// mangling, `?rt_hdr@weights@blobs@oidn@@`.
fn short_name(symbol: &str) -> Option<String> {
    let itanium = || {
        let (_, rest) = symbol.split_once("7weights")?;
        let digits = rest.find(|c: char| !c.is_ascii_digit())?;
        let length = rest[..digits].parse::<usize>().ok()?;
        rest.get(digits..digits.checked_add(length)?)
    };
    let microsoft = || {
        let (name, _) = symbol
            .strip_prefix('?')?
            .split_once("@weights@blobs@oidn")?;
        Some(name)
    };
    itanium().or_else(microsoft).map(str::to_owned)
}

/// The place of an address in a file.
fn place(file: &object::File, address: u64) -> Option<usize> {
    use object::{ObjectSection, ObjectSegment};
    let within = |start: u64, (at, size): (u64, u64)| {
        let offset = address.checked_sub(start)?;
        (offset < size).then(|| usize::try_from(at.checked_add(offset)?).ok())?
    };
    let sections = file
        .sections()
        .filter_map(|s| within(s.address(), s.file_range()?));
    let segments = file
        .segments()
        .filter_map(|s| within(s.address(), s.file_range()));
    sections.chain(segments).next()
}

impl Bundle {
    /// The network of `path`, a library of Open Image Denoise or a TZA file, on `device`. It denoises as
    /// OIDN does.
    ///
    /// `name` is one of [`weight_sets`]: a name, or a number in their order. Without it, a library gives
    /// [`DEFAULT_WEIGHTS`].
    ///
    /// # Errors
    /// [`OidnError`].
    pub fn import_oidn(
        path: &Path,
        name: Option<&str>,
        device: &Device,
    ) -> Result<Self, OidnError> {
        let mut sets = weight_sets(path)?;
        let wanted = match name {
            Some(name) => name,
            None if sets.len() == 1 => "0",
            None => DEFAULT_WEIGHTS,
        };
        let position = sets.iter().enumerate().position(|(number, set)| {
            set.name.as_deref() == Some(wanted) || wanted.parse() == Ok(number)
        });
        let Some(position) = position else {
            let known = sets.iter().enumerate().map(|(number, set)| {
                let number = number.to_string();
                set.name.clone().unwrap_or(number)
            });
            return Err(OidnError::Unknown {
                path: path.into(),
                wanted: wanted.into(),
                known: known.collect::<Vec<_>>().join(", "),
            });
        };
        let set = sets.swap_remove(position);
        if !set.is_hdr() {
            let name = set.name.unwrap_or_default();
            return Err(OidnError::NotHdr { name });
        }
        let model = set.model();
        let network = model
            .load(&mut Weights::new(set.weights), device)
            .expect("the tensors were compared with the network's");
        let layout = ChannelLayout::resolve("demc-exr").expect("a preset");
        let meta = BundleMeta::new(model, normalizer(), layout, 0);
        Ok(Bundle::new(meta.with_license(LICENSE), network))
    }

    /// Writes the network as a TZA file of Open Image Denoise atomically, reads it back, and compares. The
    /// weights are half precision: OIDN 2.5 refuses others.
    ///
    /// # Errors
    /// [`OidnError::NotUnet`], [`OidnError::AlbedoFilter`]; a weight beyond f16's range; a path that cannot
    /// be written; a file that differs from what was written.
    pub fn export_tza(&self, path: &Path) -> Result<(), OidnError> {
        let rounded = self.rounded(Precision::F16)?;
        let bytes = rounded.to_tza()?;
        demc_program::file::write_whole(path, |file| file.write_all(&bytes))
            .map_err(BundleError::from)?;
        let back = Bundle::import_oidn(path, None, &self.device())?;
        let same = back.model.weights() == rounded.model.weights();
        if same {
            return Ok(());
        }
        Err(OidnError::Bundle(BundleError::ReadBack {
            path: path.into(),
            what: "a tensor".into(),
        }))
    }

    /// The network as a TZA file of Open Image Denoise.
    ///
    /// # Errors
    /// [`OidnError::NotUnet`], [`OidnError::AlbedoFilter`].
    fn to_tza(&self) -> Result<Vec<u8>, OidnError> {
        let model = &self.meta.model;
        if model.trunk() != Some(*model) || self.meta.normalizer.transfer != Transfer::Pu {
            let model = model.to_string();
            return Err(OidnError::NotUnet { model });
        }
        if self.albedo_filter.is_some() {
            return Err(OidnError::AlbedoFilter);
        }
        let tensors = network::renamed(self.model.weights(), model.size);
        Ok(format::write(&tensors, Precision::F16))
    }
}

/// The conversions to OIDN's input.
fn normalizer() -> Normalizer {
    let features = FeatureStats {
        mean: [0.0; FEATURES],
        std: [1.0; FEATURES],
    };
    Normalizer {
        gamma: 2.2,
        transfer: Transfer::Pu,
        albedo_demodulation_epsilon: None,
        position: PositionSpace::Scene,
        exposure_level: Some(EXPOSURE_LEVEL),
        restore_light: false,
        features: features.with_ranges_of(Transfer::Pu),
        flat_color: [0.0; 3],
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::bundle::testing::{bundle, filtered};

    fn unet() -> Bundle {
        let mut unet = bundle(Variant::Unet);
        unet.meta.normalizer = normalizer();
        unet
    }

    #[test]
    fn an_export_comes_back_as_a_model() {
        let folder = tempfile::TempDir::new().expect("a temporary directory");
        let path = folder.path().join("unet.tza");
        let model = unet();
        model.export_tza(&path).expect("exported");
        let back = Bundle::import_oidn(&path, None, &model.device()).expect("its own");
        let rounded = model.rounded(Precision::F16).expect("small weights");
        assert_eq!(back.model.weights(), rounded.model.weights());
        assert_eq!(back.meta.model, model.meta.model);
        assert_eq!(back.meta.normalizer, model.meta.normalizer);
        let unknown = Bundle::import_oidn(&path, Some("1"), &model.device());
        let message = unknown.expect_err("one set").to_string();
        assert!(message.ends_with("no weights `1`; it has 0"), "{message}");
    }

    #[test]
    fn other_networks_are_refused() {
        let folder = tempfile::TempDir::new().expect("a temporary directory");
        let path = folder.path().join("x.tza");
        let error = |bundle: &Bundle| bundle.export_tza(&path).expect_err("refused");
        let other = error(&bundle(Variant::Semc));
        assert!(matches!(other, OidnError::NotUnet { .. }), "{other}");
        let grown = error(&bundle(Variant::UnetDemc));
        assert!(matches!(grown, OidnError::NotUnet { .. }), "{grown}");
        let gamma = error(&bundle(Variant::Unet));
        assert!(matches!(gamma, OidnError::NotUnet { .. }), "{gamma}");
        let mut filter = filtered(Variant::Unet, Variant::Demc);
        filter.meta.normalizer = normalizer();
        assert!(matches!(error(&filter), OidnError::AlbedoFilter));
    }
}
