//! A bundle file taken apart: header and tensors, before they are a network.

use std::fs;
use std::io;
use std::path::{Path, PathBuf};

use demc_data::frame::FEATURE_NAMES;
use demc_model::Weight;
use safetensors::SafeTensors;
use safetensors::tensor::Dtype;
use serde::Deserialize;

use super::encode::KEY;
use super::tensors::values;
use super::{BundleError, BundleMeta, FORMAT, Names, Precision, locate};

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
        let bytes = read_regular(&path).map_err(|source| BundleError::Read {
            path: path.clone(),
            source,
        })?;
        Self::parse(path, &bytes)
    }

    /// Takes the bytes of a bundle file apart; `path` is what errors call it.
    ///
    /// # Errors
    /// As [`read`](Self::read), but for reading.
    pub fn parse(path: PathBuf, bytes: &[u8]) -> Result<Self, BundleError> {
        let damaged = |error: safetensors::SafeTensorError| BundleError::Damaged {
            path: path.clone(),
            detail: printable(&error.to_string()),
        };
        let (_, header) = SafeTensors::read_metadata(bytes).map_err(damaged)?;
        let entry = header.metadata().as_ref().and_then(|all| all.get(KEY));
        let entry = entry.ok_or_else(|| BundleError::Foreign { path: path.clone() })?;
        let (meta, names) = parse_header(entry, &path)?;

        let tensors = SafeTensors::deserialize(bytes).map_err(damaged)?;
        let mut precision = Precision::F32;
        let mut weights = Vec::with_capacity(tensors.len());
        for (name, view) in tensors.iter() {
            let name = printable(name);
            if view.dtype() == Dtype::F16 {
                precision = Precision::F16;
            }
            let data = values(&view).map_err(|detail| BundleError::Tensor {
                path: path.clone(),
                name: name.clone(),
                detail,
            })?;
            weights.push(Weight {
                name: names.to_burn(&name),
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

/// A device need not end, and a FIFO would wait for a writer.
fn read_regular(path: &Path) -> io::Result<Vec<u8>> {
    match fs::metadata(path)?.is_file() {
        true => fs::read(path),
        false => Err(io::Error::new(
            io::ErrorKind::InvalidInput,
            "not a regular file",
        )),
    }
}

/// Text of a file, as it is shown in a message of one line: names may hold line breaks, and codes that a terminal obeys.
fn printable(text: &str) -> String {
    text.replace(char::is_control, "\u{fffd}")
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
        detail,
    };
    let json = |error: serde_json::Error| invalid(printable(&error.to_string()));
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
