//! Checksums of bundles and checkpoints, so that a damaged weight is refused.
//!
//! A bundle's header entry ends with the key `sha256`. Its value is the SHA-256 of the entry with an
//! empty value, then of each tensor in the order of the names: a line `NAME TYPE SHAPE` and its
//! bytes. So a program that writes the same content in another order keeps the checksum.
//! Files without the key load too: they are older, or another program wrote them.

use std::path::Path;

use demc_program::checksum::sha256;
use demc_program::message::printable;
use safetensors::SafeTensors;

use super::error::BundleError;

/// File of a checkpoint with the checksums of its other files, as `sha256sum` writes it.
pub const SUMS: &str = "SHA256SUMS";

/// A tensor of a file: its name, a line that describes it, and its bytes.
pub(super) struct SummedTensor<'a> {
    name: &'a str,
    line: String,
    bytes: &'a [u8],
}

impl<'a> SummedTensor<'a> {
    pub(super) fn new(
        name: &'a str,
        dtype: safetensors::Dtype,
        shape: &[usize],
        bytes: &'a [u8],
    ) -> Self {
        Self {
            name,
            line: format!("{name} {dtype} {shape:?}\n"),
            bytes,
        }
    }
}

/// The checksum of a bundle whose header entry, with an empty `sha256`, is `entry`.
pub(super) fn of_bundle(entry: &str, mut tensors: Vec<SummedTensor<'_>>) -> String {
    tensors.sort_by_key(|tensor| tensor.name);
    let parts = tensors
        .iter()
        .flat_map(|tensor| [tensor.line.as_bytes(), tensor.bytes]);
    sha256([entry.as_bytes()].into_iter().chain(parts))
}

/// Compares a file with the checksum `sum` in its header entry.
///
/// # Errors
/// [`BundleError::Checksum`].
pub(super) fn check(
    path: &Path,
    entry: &str,
    sum: &str,
    file: &SafeTensors<'_>,
) -> Result<(), BundleError> {
    let tensors = file
        .iter()
        .map(|(name, view)| SummedTensor::new(name, view.dtype(), view.shape(), view.data()));
    // An empty checksum is one of the ways in which the digits can be damaged.
    let blank = if sum.is_empty() {
        String::new()
    } else {
        entry.replacen(sum, "", 1)
    };
    if of_bundle(&blank, tensors.collect()) == sum {
        Ok(())
    } else {
        Err(BundleError::Checksum { path: path.into() })
    }
}

/// The checksums in a checkpoint's [`SUMS`]: pairs of checksum and file name.
///
/// # Errors
/// A file that cannot be read, or a message about the first line without checksum and name.
pub fn sums(dir: &Path) -> Result<Vec<(String, String)>, BundleError> {
    let path = dir.join(SUMS);
    let invalid = |detail: String| BundleError::Sums {
        path: path.clone(),
        detail,
    };
    let text = match std::fs::read(&path) {
        Ok(bytes) => String::from_utf8(bytes).map_err(|_| invalid("not UTF-8 text".into()))?,
        Err(source) => return Err(BundleError::Read { path, source }),
    };
    let lines = text.lines().map(|line| match line.split_once("  ") {
        Some((sum, name)) => Ok((sum.to_owned(), name.to_owned())),
        None => {
            let line = printable(line);
            Err(invalid(format!(
                "expected `CHECKSUM  FILE`, found `{line}`"
            )))
        }
    });
    let pairs: Vec<_> = lines.collect::<Result<_, _>>()?;
    if pairs.is_empty() {
        Err(invalid("empty".into()))
    } else {
        Ok(pairs)
    }
}

/// Compares the bytes of a checkpoint's file with [`SUMS`] beside it. A directory without that file
/// is no checkpoint of `demc-train`, and passes.
///
/// # Errors
/// As [`sums`]; a file that is not listed or differs.
pub(super) fn check_in_checkpoint(path: &Path, bytes: &[u8]) -> Result<(), BundleError> {
    let (Some(dir), Some(name)) = (path.parent(), path.file_name()) else {
        return Ok(());
    };
    if !dir.join(SUMS).exists() {
        return Ok(());
    }
    let sums = sums(dir)?;
    match sums.iter().find(|(_, listed)| name == listed.as_str()) {
        Some((sum, _)) if *sum == sha256([bytes]) => Ok(()),
        Some(_) => Err(BundleError::Damaged {
            path: path.into(),
            detail: format!("its checksum in {SUMS} differs; use another checkpoint"),
        }),
        None => Err(BundleError::Sums {
            path: dir.join(SUMS),
            detail: format!("does not list {}", printable(&name.to_string_lossy())),
        }),
    }
}
