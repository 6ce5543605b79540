//! Finds the bundle file for a path: a run directory, a checkpoint directory or a bundle.
//!
//! ```text
//! RUN/best.safetensors                                best weights by validation
//! RUN/latest                                          name of the newest checkpoint: step-00000500
//! RUN/checkpoints/step-00000500/average.safetensors   averaged weights, if the run has them: preferred
//! RUN/checkpoints/step-00000500/model.safetensors     weights in training
//! ```
//!
//! A checkpoint also holds the best weights so far, which belong to the run.

use std::fs;
use std::path::{Path, PathBuf};

use super::bundled::Bundled;
use super::error::BundleError;

/// Best weights of a run, by validation.
pub const BEST: &str = "best.safetensors";
/// Text file of a run with the name of the newest checkpoint.
pub const LATEST: &str = "latest";
/// Directory of a run with the checkpoints.
pub const CHECKPOINTS: &str = "checkpoints";
/// Averaged weights of a checkpoint.
pub const AVERAGE: &str = "average.safetensors";
/// Weights in training of a checkpoint.
pub const MODEL: &str = "model.safetensors";

/// The bundle file that `path` stands for.
///
/// # Errors
/// A directory without a bundle, or a `latest` that cannot be read.
pub(super) fn locate(path: &Path) -> Result<PathBuf, BundleError> {
    if !path.is_dir() {
        return Ok(path.into());
    }
    if let Some(file) = checkpoint_weights(path) {
        return Ok(file);
    }
    let best = path.join(BEST);
    if best.exists() {
        return Ok(best);
    }
    let latest = path.join(LATEST);
    if !latest.exists() {
        return Err(BundleError::NoModel { path: path.into() });
    }
    let name = fs::read_to_string(&latest).map_err(|source| BundleError::Read {
        path: latest,
        source,
    })?;
    let checkpoint = path.join(CHECKPOINTS).join(name.trim());
    Ok(checkpoint_weights(&checkpoint).unwrap_or_else(|| checkpoint.join(MODEL)))
}

/// Files of a run directory besides its checkpoints.
const RUN_FILES: [&str; 8] = [
    BEST,
    LATEST,
    "config.toml",
    "layout.toml",
    "run.json",
    "metrics.jsonl",
    "test.json",
    "lock",
];

/// The files that belong to the model at `path`: itself, or those of its run or checkpoint
/// directory. Some may be missing. Commands do not replace them. A bundled model has none.
pub fn files(path: &Path) -> Vec<PathBuf> {
    if Bundled::named(path).is_some() {
        return Vec::new();
    }
    let mut files = vec![path.to_owned()];
    files.extend(RUN_FILES.map(|name| path.join(name)));
    let checkpoints = entries(&path.join(CHECKPOINTS));
    files.extend(checkpoints.iter().flat_map(|dir| entries(dir)));
    if checkpoint_weights(path).is_some() {
        files.extend(entries(path));
    }
    files
}

/// The entries of a directory; none if it cannot be read.
fn entries(dir: &Path) -> Vec<PathBuf> {
    let entries = fs::read_dir(dir).into_iter().flatten().flatten();
    entries.map(|entry| entry.path()).collect()
}

/// The weights of a checkpoint directory; `None` if `dir` is none.
fn checkpoint_weights(dir: &Path) -> Option<PathBuf> {
    let mut files = [AVERAGE, MODEL].map(|file| dir.join(file)).into_iter();
    files.find(|file| file.exists())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_run_stands_for_its_best_weights_or_its_latest_checkpoint() -> std::io::Result<()> {
        let dir = tempfile::tempdir()?;
        let run = dir.path();
        let error = locate(run).expect_err("empty").to_string();
        assert!(
            error.contains("neither a run directory nor a checkpoint"),
            "{error}"
        );

        let checkpoint = run.join("checkpoints/step-00000500");
        fs::create_dir_all(&checkpoint)?;
        fs::write(run.join("latest"), "step-00000500\n")?;
        let model = checkpoint.join("model.safetensors");
        assert_eq!(locate(run).expect("latest"), model);

        fs::write(&model, "")?;
        assert_eq!(locate(&checkpoint).expect("checkpoint"), model);

        let average = checkpoint.join("average.safetensors");
        fs::write(&average, "")?;
        fs::write(checkpoint.join("best.safetensors"), "")?;
        assert_eq!(locate(&checkpoint).expect("checkpoint"), average);
        assert_eq!(locate(run).expect("latest"), average);

        let best = run.join("best.safetensors");
        fs::write(&best, "")?;
        assert_eq!(locate(run).expect("best"), best);
        assert_eq!(locate(&best).expect("file"), best);
        Ok(())
    }
}
