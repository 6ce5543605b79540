//! Reads a bundle file: header and tensors, without building the network.

use std::collections::BTreeMap;
use std::io::{self, Read};
use std::path::{Path, PathBuf};

use demc_data::image::frame::FEATURE_NAMES;
use demc_model::kernel_head::GAMMA;
use demc_model::{Head, Weight};
use demc_program::file::open_regular;
use demc_program::message::printable;
use safetensors::SafeTensors;
use safetensors::tensor::{Dtype, Metadata};
use serde::Deserialize;
use serde::de::IgnoredAny;

use super::bundled::Bundled;
use super::encode::KEY;
use super::error::BundleError;
use super::meta::{BundleMeta, FORMAT};
use super::names::{Names, Precision};
use super::network::{FILTER_KEY, PREFIX};
use super::tensors::values;
use super::{checksum, locate};

/// Longest accepted header in bytes (ours: the widest network's has 20 kB).
const MAX_HEADER: u64 = 4 << 20;
/// Size of the field before the header that holds its length, in bytes.
const LENGTH: usize = 8;

/// The keys of [`BundleMeta`].
const META_KEYS: [&str; 7] = [
    "format",
    "model",
    "normalizer",
    "layout",
    "step",
    "ranges",
    "license",
];

/// The keys beside them in a header entry.
const HEADER_KEYS: [&str; 3] = ["names", "sha256", FILTER_KEY];

/// The contents of a bundle file, validated as far as possible without building the network.
#[derive(Debug, Clone)]
pub struct BundleFile {
    /// The file, also if a directory was given.
    pub path: PathBuf,
    /// Everything except the weights.
    pub meta: BundleMeta,
    /// The naming scheme in the file.
    pub names: Names,
    /// `F16` if any tensor has that type.
    pub precision: Precision,
    /// The tensors with Burn's names, as f32, sorted by name; without those of the albedo filter.
    pub weights: Vec<Weight>,
    /// The albedo filter of the file; it has none of its own. Its tensors have no prefix here.
    pub albedo_filter: Option<Box<BundleFile>>,
}

impl BundleFile {
    /// A bundled model.
    ///
    /// # Errors
    /// A build with a damaged model.
    pub fn bundled(model: Bundled) -> Result<Self, BundleError> {
        Self::parse(model.name().into(), model.bytes())
    }

    /// Reads a run directory, a checkpoint directory or a bundle file; see [`Bundle::load`](super::Bundle::load).
    /// The path `quality` or `fast` is the bundled model of that name; `./fast` is a file.
    ///
    /// # Errors
    /// - The file cannot be read, is cut short, is no bundle, or has another format.
    /// - A tensor has a type other than f32 and f16, or holds NaN or infinity.
    /// - A standard deviation is zero, or another entry of the header is invalid.
    /// - The content differs from the checksum in the header or, for a directory, in the
    ///   checkpoint's `SHA256SUMS`.
    pub fn read(path: &Path) -> Result<Self, BundleError> {
        if let Some(model) = Bundled::named(path) {
            return Self::bundled(model);
        }
        let file = locate::locate(path)?;
        let bytes = read(&file)?;
        if file != path {
            checksum::check_in_checkpoint(&file, &bytes)?;
        }
        Self::parse(file, &bytes)
    }

    /// Parses the bytes of a bundle file. Errors call it `path`.
    ///
    /// # Errors
    /// As [`read`](Self::read), except for reading.
    pub fn parse(path: PathBuf, bytes: &[u8]) -> Result<Self, BundleError> {
        let header = parse_meta(&path, bytes)?;
        let names = header.names;
        let tensors = SafeTensors::deserialize(bytes).map_err(|error| damaged(&path, &error))?;
        if let Some(sum) = &header.sha256 {
            checksum::check(&path, &header.entry, sum, &tensors)?;
        }
        let mut precision = Precision::F32;
        let mut weights = Vec::with_capacity(tensors.len());
        let mut filter_weights = Vec::new();
        let mut specs = names.specs_in_file(&header.meta.model);
        let mut filter_specs = header
            .albedo_filter
            .as_ref()
            .map(|filter| names.specs_in_file(&filter.model));
        for (name, view) in tensors.iter() {
            if view.dtype() == Dtype::F16 {
                precision = Precision::F16;
            }
            let data = values(&view).map_err(|detail| BundleError::Tensor {
                path: path.clone(),
                name: printable(name),
                detail,
            })?;
            let (weights, specs, name) = match (name.strip_prefix(PREFIX), &mut filter_specs) {
                (Some(name), Some(specs)) => (&mut filter_weights, specs, name),
                _ => (&mut weights, &mut specs, name),
            };
            weights.push(Weight {
                name: match specs.remove(name) {
                    Some(spec) => spec.name,
                    None => printable(name),
                },
                shape: view.shape().to_vec(),
                data,
            });
        }
        for weights in [&mut weights, &mut filter_weights] {
            weights.sort_by(|a, b| a.name.cmp(&b.name));
        }
        let file = |meta, weights, albedo_filter| Self {
            path: path.clone(),
            meta,
            names,
            precision,
            weights,
            albedo_filter,
        };
        let filter = header
            .albedo_filter
            .map(|meta| Box::new(file(meta, filter_weights, None)));
        Ok(file(header.meta, weights, filter))
    }
}

/// Reads a safetensors file, and no more bytes than its header announces. A path can also name a
/// device or a disk image that is larger than the memory.
///
/// # Errors
/// A path that cannot be read, or a header longer than [`MAX_HEADER`].
pub(super) fn read(path: &Path) -> Result<Vec<u8>, BundleError> {
    let failed = |source| BundleError::Read {
        path: path.into(),
        source,
    };
    let mut file = open_regular(path).map_err(failed)?;
    let mut bytes = Vec::new();
    let mut more = |bytes: &mut Vec<u8>, count: u64| -> io::Result<()> {
        file.by_ref().take(count).read_to_end(bytes).map(|_| ())
    };
    more(&mut bytes, LENGTH as u64).map_err(failed)?;
    let Ok(length) = <[u8; LENGTH]>::try_from(&bytes[..]).map(u64::from_le_bytes) else {
        return Ok(bytes);
    };
    if length > MAX_HEADER {
        return Err(BundleError::Damaged {
            path: path.into(),
            detail: format!("a header of {length} bytes"),
        });
    }
    more(&mut bytes, length).map_err(failed)?;
    // The decoder reports an invalid header.
    if let Ok(header) = serde_json::from_slice::<Metadata>(&bytes[LENGTH..]) {
        // One byte more, to detect a file that is too long.
        let count = (header.data_len() as u64).saturating_add(1);
        more(&mut bytes, count).map_err(failed)?;
    }
    Ok(bytes)
}

pub(super) fn damaged(path: &Path, error: &safetensors::SafeTensorError) -> BundleError {
    BundleError::Damaged {
        path: path.into(),
        detail: printable(&error.to_string()),
    }
}

/// The parsed header entry of a bundle file.
pub(super) struct BundleHeader {
    pub meta: BundleMeta,
    pub names: Names,
    /// Metadata of the albedo filter.
    pub albedo_filter: Option<BundleMeta>,
    /// The checksum, if the file has one.
    pub sha256: Option<String>,
    /// The entry as it stands in the file.
    pub entry: String,
}

/// The metadata of a bundle file.
///
/// # Errors
/// The bytes are no safetensors file, or no bundle.
pub(super) fn parse_meta(path: &Path, bytes: &[u8]) -> Result<BundleHeader, BundleError> {
    let (_, header) = SafeTensors::read_metadata(bytes).map_err(|error| damaged(path, &error))?;
    let entry = header
        .metadata()
        .as_ref()
        .and_then(|all| all.get(KEY))
        .ok_or_else(|| BundleError::Foreign { path: path.into() })?;
    parse_header(entry, path)
}

/// Parses the header entry, with the entry of an albedo filter in it.
fn parse_header(entry: &str, path: &Path) -> Result<BundleHeader, BundleError> {
    #[derive(Deserialize)]
    struct Rest {
        names: Names,
        sha256: Option<String>,
        albedo_filter: Option<serde_json::Value>,
    }
    let invalid = |detail: String| BundleError::Header {
        path: path.into(),
        detail: printable(&detail),
    };
    let meta = parse_network(entry, path, &HEADER_KEYS, &invalid)?;
    let rest = serde_json::from_str(entry).map_err(|error| invalid(error.to_string()))?;
    let Rest {
        names,
        sha256,
        albedo_filter,
    } = rest;
    let within = |detail: String| invalid(format!("{FILTER_KEY}: {detail}"));
    let filter = albedo_filter.map(|entry| {
        if entry.get(FILTER_KEY).is_some() {
            return Err(within("has a filter of its own".into()));
        }
        let filter = parse_network(&entry.to_string(), path, &[], &within)?;
        match filter.filter_problem(meta.layout.inputs, meta.normalizer.position) {
            Some(problem) => Err(within(problem)),
            None => Ok(filter),
        }
    });
    Ok(BundleHeader {
        albedo_filter: filter.transpose()?,
        meta,
        names,
        sha256,
        entry: entry.to_owned(),
    })
}

/// Parses the metadata of one network, beside which the entry may have `other_keys`. The format is
/// checked first, because another format may have other keys.
fn parse_network(
    entry: &str,
    path: &Path,
    other_keys: &[&str],
    invalid: &dyn Fn(String) -> BundleError,
) -> Result<BundleMeta, BundleError> {
    #[derive(Deserialize)]
    struct Version {
        format: u64,
    }
    let json = |error: serde_json::Error| invalid(error.to_string());
    let Version { format } = serde_json::from_str(entry).map_err(json)?;
    if format != u64::from(FORMAT) {
        return Err(BundleError::Format {
            path: path.into(),
            found: format,
        });
    }
    let meta: BundleMeta = serde_json::from_str(entry).map_err(json)?;
    let mut problems = meta.model.validate();
    // An unknown key could be a damaged `sha256`.
    let keys: BTreeMap<String, IgnoredAny> = serde_json::from_str(entry).map_err(json)?;
    let known = |key: &str| META_KEYS.contains(&key) || other_keys.contains(&key);
    let unknown = keys.keys().filter(|key| !known(key));
    problems.extend(unknown.map(|key| format!("unknown key `{key}`")));
    problems.extend(statistics_problems(&meta));
    let layout = meta.layout.validate().into_iter();
    problems.extend(layout.map(|problem| format!("layout: {problem}")));
    if meta.layout.inputs != BundleMeta::inputs_of(meta.model.variant) {
        let variant = meta.model.variant.spec().name;
        problems.push(format!("layout.inputs: not those of variant {variant}"));
    }
    if problems.is_empty() {
        Ok(meta)
    } else {
        Err(invalid(problems.join("; ")))
    }
}

/// Problems in the statistics that would make every output NaN.
fn statistics_problems(meta: &BundleMeta) -> Vec<String> {
    let normalizer = &meta.normalizer;
    let mut problems = Vec::new();
    if !(normalizer.gamma.is_finite() && normalizer.gamma > 0.0) {
        problems.push(format!(
            "normalizer.gamma: {} is not above 0",
            normalizer.gamma
        ));
    }
    if let Some(epsilon) = normalizer.albedo_demodulation_epsilon
        && !(epsilon.is_finite() && epsilon > 0.0)
    {
        problems.push(format!(
            "normalizer.demodulate: {epsilon} is not 0 or above"
        ));
    }
    if meta.model.head == Head::Kernel && normalizer.gamma != GAMMA {
        problems.push(format!(
            "normalizer.gamma: {} is not {GAMMA}, as a kernel head needs",
            normalizer.gamma
        ));
    }
    let needs_gamma = meta.model.head == Head::Kernel
        || normalizer.albedo_demodulation_epsilon.is_some()
        || !meta.layout.inputs.is_demc();
    if needs_gamma && !normalizer.transfer.is_gamma() {
        problems.push(
            "normalizer.transfer: not gamma, as a kernel head, demodulation, or kpcn needs".into(),
        );
    }
    let features = &normalizer.features;
    for (channel, (mean, std)) in FEATURE_NAMES
        .iter()
        .zip(features.mean.iter().zip(&features.std))
    {
        if !mean.is_finite() || !std.is_finite() || *std <= 0.0 {
            problems.push(format!(
                "normalizer.features: {channel}: mean {mean}, std {std}"
            ));
        }
    }
    problems
}
