//! Manifests that the new one takes entries from: the one that is replaced, and those of `--with`.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

use anyhow::{Context, Result, bail};
use demc_program::file::{self, FileId};
use serde_json::{Map, Value, json};

use super::rules::{Entry, Kept};
use crate::dataset::{Dataset, FORMAT, MAX_MANIFEST, Split, preset_of};

/// The manifest that is replaced.
pub(super) struct Before {
    root: PathBuf,
    /// Its keys, with an empty list of scenes.
    pub(super) keys: Map<String, Value>,
    /// Its entries by file, whatever its path.
    pub(super) scenes: BTreeMap<FileId, Map<String, Value>>,
}

impl Default for Before {
    fn default() -> Self {
        let mut keys = Map::new();
        keys.insert("format".to_owned(), FORMAT.into());
        Self {
            root: PathBuf::new(),
            keys,
            scenes: BTreeMap::new(),
        }
    }
}

impl Before {
    pub(super) fn read(root: &Path, path: &Path) -> Result<Self> {
        let shown = path.display();
        let text = file::read_regular_text(path, MAX_MANIFEST)
            .with_context(|| format!("cannot read {shown}"))?;
        let mut before = Self {
            root: root.to_owned(),
            ..Self::default()
        };
        let keys: Map<String, Value> =
            serde_json::from_str(&text).with_context(|| format!("{shown} is not a manifest"))?;
        before.keys.extend(keys);
        before.keys.insert("format".to_owned(), FORMAT.into());
        let scenes = before.keys.insert("scenes".to_owned(), Value::Null);
        let Some(Value::Array(scenes)) = scenes else {
            bail!("{shown} is not a manifest: it has no list `scenes`");
        };
        for scene in scenes {
            if let Value::Object(scene) = scene
                && let Some(Value::String(file)) = scene.get("file")
            {
                before.scenes.insert(FileId::of(&root.join(file)), scene);
            }
        }
        Ok(before)
    }

    /// What a file is in it.
    pub(super) fn kept(&self, file: &str) -> Kept {
        let Some(scene) = self.scenes.get(&FileId::of(&self.root.join(file))) else {
            return Kept::default();
        };
        let split = scene.get("split").cloned();
        let base = scene.get("base").and_then(Value::as_str);
        Kept {
            split: split.and_then(|split| serde_json::from_value(split).ok()),
            base: base.map(str::to_owned),
        }
    }

    /// Drops the entries of files that have new ones.
    pub(super) fn forget(&mut self, entries: &[Value]) {
        for file in entries.iter().filter_map(|entry| entry["file"].as_str()) {
            self.scenes.remove(&FileId::of(&self.root.join(file)));
        }
    }

    /// Takes the entries whose files exist, but were not found in the directory: those of `../other/a.exr`.
    pub(super) fn elsewhere(&mut self) -> Vec<Value> {
        let exists = |scene: &Map<String, Value>| {
            let file = scene.get("file").and_then(Value::as_str);
            file.is_some_and(|file| self.root.join(file).exists())
        };
        let scenes = std::mem::take(&mut self.scenes);
        let (kept, gone) = scenes.into_iter().partition(|(_, scene)| exists(scene));
        self.scenes = gone;
        let kept: BTreeMap<FileId, Map<String, Value>> = kept;
        kept.into_values().map(Value::Object).collect()
    }

    /// The new entry of a scene, with the other keys of its old one.
    pub(super) fn entry(&mut self, scene: &Entry) -> Value {
        let mut entry = json!({
            "name": scene.name,
            "split": scene.split,
            "base": scene.base,
            "file": scene.file,
            "width": scene.width,
            "height": scene.height,
        });
        let file = FileId::of(&self.root.join(&scene.file));
        if let (Some(entry), Some(old)) = (entry.as_object_mut(), self.scenes.remove(&file)) {
            for (key, value) in old {
                entry.entry(key).or_insert(value);
            }
        }
        entry
    }
}

/// The entries of the training scenes of `sets` in the manifest of `root`, whose own files have `layout`.
///
/// # Errors
/// A set without a manifest, or with an unusable one; a scene whose file is missing.
pub(super) fn beside(root: &Path, sets: &[PathBuf], layout: &str) -> Result<Vec<Value>> {
    let root = root
        .canonicalize()
        .with_context(|| format!("cannot read {}", root.display()))?;
    let mut entries = Vec::new();
    for set in sets {
        let scenes = Dataset::list(set)?;
        let preset = preset_of(&scenes);
        let mut manifest = Before::read(set, &set.join("manifest.json"))?;
        for scene in scenes.iter().filter(|scene| scene.split == Split::Train) {
            let Some(mut entry) = manifest.scenes.remove(&FileId::of(&scene.path)) else {
                bail!("scene {}: its file is listed twice", scene.name);
            };
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
