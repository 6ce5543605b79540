//! A bundle file taken apart: header and tensors, before they are a network.

use std::fs::{self, File};
use std::io::{self, Read};
use std::path::{Path, PathBuf};

use demc_data::frame::FEATURE_NAMES;
use demc_model::Weight;
use safetensors::SafeTensors;
use safetensors::tensor::{Dtype, Metadata};
use serde::Deserialize;

use super::encode::KEY;
use super::tensors::{one_line, values};
use super::{BundleError, BundleMeta, FORMAT, Names, Precision, locate};

/// Longest header that is read; ours: that of the widest network is 20 kB.
const LONGEST_HEADER: u64 = 4 << 20;
/// Bytes before the header: its length.
const LENGTH: usize = 8;

/// What a bundle file holds, checked as far as that goes without building the network.
#[derive(Debug, Clone)]
pub struct BundleFile {
    /// The file itself, where a directory was given.
    pub path: PathBuf,
    /// Everything but the weights.
    pub meta: BundleMeta,
    /// The style of the tensor names in the file.
    pub names: Names,
    /// `F16` if any tensor is.
    pub precision: Precision,
    /// The tensors under Burn's names, as f32, sorted by name.
    pub weights: Vec<Weight>,
}

impl BundleFile {
    /// Reads a run directory, a checkpoint directory or a bundle file; see [`super::Bundle::load`].
    ///
    /// # Errors
    /// A file that cannot be read, is cut short, is no bundle or one of another format; a tensor of another type
    /// than f32 and f16 or with NaN or infinity in it; statistics that nothing can be divided by.
    pub fn read(path: &Path) -> Result<Self, BundleError> {
        let path = locate::locate(path)?;
        let bytes = read(&path)?;
        Self::parse(path, &bytes)
    }

    /// Takes the bytes of a bundle file apart; `path` is what errors call it.
    ///
    /// # Errors
    /// As [`read`](Self::read), but for reading.
    pub fn parse(path: PathBuf, bytes: &[u8]) -> Result<Self, BundleError> {
        let (meta, names) = parse_meta(&path, bytes)?;
        let tensors = SafeTensors::deserialize(bytes).map_err(|error| damaged(&path, &error))?;
        let mut precision = Precision::F32;
        let mut weights = Vec::with_capacity(tensors.len());
        for (name, view) in tensors.iter() {
            if view.dtype() == Dtype::F16 {
                precision = Precision::F16;
            }
            let data = values(&view).map_err(|detail| BundleError::Tensor {
                path: path.clone(),
                name: one_line(name),
                detail,
            })?;
            weights.push(Weight {
                name: names.to_burn(&one_line(name)),
                shape: view.shape().to_vec(),
                data,
            });
        }
        weights.sort_by(|a, b| a.name.cmp(&b.name));
        Ok(Self {
            path,
            meta,
            names,
            precision,
            weights,
        })
    }
}

/// The bytes of a safetensors file and no more than its header claims: what else may stand at a path (a device, a disk image)
/// can be larger than the memory.
///
/// # Errors
/// A path that cannot be read; a header that is longer than any of ours.
pub(super) fn read(path: &Path) -> Result<Vec<u8>, BundleError> {
    let failed = |source| BundleError::Read {
        path: path.into(),
        source,
    };
    // A FIFO would wait for a writer.
    if !fs::metadata(path).map_err(failed)?.is_file() {
        let source = io::Error::new(io::ErrorKind::InvalidInput, "not a regular file");
        return Err(failed(source));
    }
    let mut file = File::open(path).map_err(failed)?;
    let mut bytes = Vec::new();
    let mut more = |bytes: &mut Vec<u8>, count: u64| -> io::Result<()> {
        file.by_ref().take(count).read_to_end(bytes).map(|_| ())
    };
    more(&mut bytes, LENGTH as u64).map_err(failed)?;
    let Ok(length) = <[u8; LENGTH]>::try_from(&bytes[..]).map(u64::from_le_bytes) else {
        return Ok(bytes);
    };
    if length > LONGEST_HEADER {
        return Err(BundleError::Damaged {
            path: path.into(),
            detail: format!("a header of {length} bytes"),
        });
    }
    more(&mut bytes, length).map_err(failed)?;
    // Where the header is none, that is for the decoder to say.
    if let Ok(header) = serde_json::from_slice::<Metadata>(&bytes[LENGTH..]) {
        // One more, so that a file that is too long is found out.
        let count = (header.data_len() as u64).saturating_add(1);
        more(&mut bytes, count).map_err(failed)?;
    }
    Ok(bytes)
}

pub(super) fn damaged(path: &Path, error: &safetensors::SafeTensorError) -> BundleError {
    BundleError::Damaged {
        path: path.into(),
        detail: one_line(&error.to_string()),
    }
}

/// The metadata of a file with these bytes.
///
/// # Errors
/// Bytes that are no safetensors file, or none of ours.
pub(super) fn parse_meta(path: &Path, bytes: &[u8]) -> Result<(BundleMeta, Names), BundleError> {
    let (_, header) = SafeTensors::read_metadata(bytes).map_err(|error| damaged(path, &error))?;
    let entry = header.metadata().as_ref().and_then(|all| all.get(KEY));
    let entry = entry.ok_or_else(|| BundleError::Foreign { path: path.into() })?;
    parse_header(entry, path)
}

/// The metadata in the header entry. The format is looked at first: another format may have other keys.
fn parse_header(entry: &str, path: &Path) -> Result<(BundleMeta, Names), BundleError> {
    #[derive(Deserialize)]
    struct Version {
        format: u64,
    }
    #[derive(Deserialize)]
    struct Style {
        names: Names,
    }
    let invalid = |detail: String| BundleError::Header {
        path: path.into(),
        detail: one_line(&detail),
    };
    let json = |error: serde_json::Error| invalid(error.to_string());
    let Version { format } = serde_json::from_str(entry).map_err(json)?;
    if format != u64::from(FORMAT) {
        return Err(BundleError::Format {
            path: path.into(),
            found: format,
        });
    }
    let Style { names } = serde_json::from_str(entry).map_err(json)?;
    let meta: BundleMeta = serde_json::from_str(entry).map_err(json)?;
    let mut problems = meta.model.validate();
    problems.extend(statistics_problems(&meta));
    let layout = meta.layout.validate().into_iter();
    problems.extend(layout.map(|problem| format!("layout: {problem}")));
    match problems.is_empty() {
        true => Ok((meta, names)),
        false => Err(invalid(problems.join("; "))),
    }
}

/// Statistics that would make every output NaN: worth finding before an hour of denoising.
fn statistics_problems(meta: &BundleMeta) -> Vec<String> {
    let normalizer = &meta.normalizer;
    let mut problems = Vec::new();
    if !(normalizer.gamma.is_finite() && normalizer.gamma > 0.0) {
        problems.push(format!(
            "normalizer.gamma: {} is not above 0",
            normalizer.gamma
        ));
    }
    if !(normalizer.demodulate.is_finite() && normalizer.demodulate >= 0.0) {
        problems.push(format!(
            "normalizer.demodulate: {} is not 0 or above",
            normalizer.demodulate
        ));
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
