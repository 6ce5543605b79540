//! `--with`: the training scenes of other data sets.

use std::path::{Path, PathBuf};

use anyhow::{Context, Result};
use demc_program::file;
use serde_json::{Map, Value};

use crate::dataset::{Dataset, MAX_MANIFEST, Split, preset_of};

/// The entries of the training scenes of `sets` in the manifest of `root`, whose own files have `layout`.
///
/// # Errors
/// A set without a manifest, or with an unusable one; a scene whose file is missing.
pub(super) fn entries(root: &Path, sets: &[PathBuf], layout: &str) -> Result<Vec<Value>> {
    let root = root
        .canonicalize()
        .with_context(|| format!("cannot read {}", root.display()))?;
    let mut entries = Vec::new();
    for set in sets {
        let scenes = Dataset::list(set)?;
        let preset = preset_of(&scenes);
        let text = file::read_regular_text(&set.join("manifest.json"), MAX_MANIFEST)?;
        let raw: Manifest = serde_json::from_str(&text)?;
        for (scene, mut entry) in scenes.iter().zip(raw.scenes) {
            if scene.split != Split::Train {
                continue;
            }
            let shown = scene.path.display();
            let path = scene.path.canonicalize();
            let path = path.with_context(|| format!("scene {}: {shown}", scene.name))?;
            let relative = pathdiff::diff_paths(&path, &root).unwrap_or(path);
            let parts: Option<Vec<&str>> = relative.iter().map(|part| part.to_str()).collect();
            let parts = parts.with_context(|| format!("{shown}: its path is not UTF-8"))?;
            entry.insert("file".into(), parts.join("/").into());
            if preset != layout {
                entry.entry("layout").or_insert(preset.into());
            }
            entries.push(Value::Object(entry));
        }
    }
    Ok(entries)
}

#[derive(serde::Deserialize)]
struct Manifest {
    scenes: Vec<Map<String, Value>>,
}
