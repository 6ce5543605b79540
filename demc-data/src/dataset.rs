//! A data set on disk: its `manifest.json`, its scenes and its splits. Scenes are split by *base
//! scene*: views of one room are never in both splits.

use std::collections::btree_map::Entry;
use std::collections::{BTreeMap, BTreeSet, HashSet};
use std::fmt;
use std::num::NonZero;
use std::path::{Path, PathBuf};

use demc_program::file::{self, FileError, FileId};
use demc_program::message::printable;
use demc_program::output::Outputs;
use rand::seq::SliceRandom;
use serde::{Deserialize, Serialize};

use crate::error::Error;
use crate::image::channel::Window;
use crate::image::exr::ExrFile;
use crate::image::frame::{Presence, check_header};
use crate::image::layout::{ChannelLayout, MissingPolicies, detect};
use crate::seed::{RandomStream, generator};

/// The manifest format that this version reads and writes.
pub const FORMAT: &str = "demc-exr 1";
/// Largest manifest in bytes (ours: a scene takes 150 to 500).
pub const MAX_MANIFEST: u64 = 1 << 28;
/// Maximum number of problems in one message; the others are counted.
const PROBLEMS_LISTED: usize = 8;

/// The part of a data set that a scene belongs to.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Split {
    /// For training and validation.
    Train,
    /// For the final scores only.
    Test,
}

impl fmt::Display for Split {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(match self {
            Split::Train => "train",
            Split::Test => "test",
        })
    }
}

/// One image of a data set, as described by the manifest.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Scene {
    /// Its name, unique in the data set.
    pub name: String,
    /// The part it belongs to.
    pub split: Split,
    /// The base scene that it is a view of; never in two splits.
    pub base: String,
    /// Its file.
    pub path: PathBuf,
    /// Width in pixels.
    pub width: usize,
    /// Height in pixels.
    pub height: usize,
    /// Expected RelMSE of the reference against a perfect one, if known.
    pub ref_residual_relmse: Option<f64>,
    /// How often an epoch of training takes its patches.
    pub repeat: NonZero<u8>,
    /// The channel layout of its file, if that is not the data set's: see [`layout`](Self::layout).
    pub layout: Option<ChannelLayout>,
    /// The other keys of its manifest entry: licences, credits, render
    /// settings, the denoiser of the reference.
    pub other: serde_json::Map<String, serde_json::Value>,
}

impl Scene {
    /// The channel layout of its file, in a data set with the layout `of_set`.
    pub fn layout<'a>(&'a self, of_set: &'a ChannelLayout) -> &'a ChannelLayout {
        self.layout.as_ref().unwrap_or(of_set)
    }
}

/// A data set whose manifest and file headers were checked.
#[derive(Debug, Clone, PartialEq)]
pub struct Dataset {
    /// Its directory.
    pub root: PathBuf,
    /// All scenes, in the manifest's order.
    pub scenes: Vec<Scene>,
}

/// The key that all versions of the format have.
#[derive(Deserialize)]
struct ManifestHeader {
    format: String,
}

#[derive(Deserialize)]
struct Manifest {
    scenes: Vec<ManifestScene>,
}

#[derive(Deserialize)]
struct ManifestScene {
    name: String,
    split: Split,
    base: String,
    file: PathBuf,
    width: usize,
    height: usize,
    ref_residual_relmse: Option<f64>,
    #[serde(default = "once")]
    repeat: NonZero<u8>,
    layout: Option<String>,
    #[serde(flatten)]
    other: serde_json::Map<String, serde_json::Value>,
}

fn once() -> NonZero<u8> {
    NonZero::<u8>::MIN
}

impl Dataset {
    /// Opens `root/manifest.json` and checks every scene's file: it exists, and has the size in the manifest.
    /// It holds the channels of its own layout, or else of `layout`, including the reference. Decodes no pixels.
    ///
    /// # Errors
    /// [`FileError::Read`] without a manifest, otherwise [`Error::Dataset`] with all problems.
    pub fn open(root: &Path, layout: &ChannelLayout) -> Result<Self, Error> {
        let mut scenes = Self::list(root)?;
        for own in scenes.iter_mut().filter_map(|scene| scene.layout.as_mut()) {
            own.inputs = layout.inputs;
        }
        let mut problems = manifest_problems(&scenes);
        if layout.reference.is_none() {
            problems.push("the layout names no reference, which training needs".to_owned());
        }
        problems.extend(repeated_files(&scenes));
        problems.extend(file_problems(&scenes, layout));
        if !problems.is_empty() {
            return Err(unusable(root, problems));
        }
        Ok(Self {
            root: root.to_owned(),
            scenes,
        })
    }

    /// The scenes that `root/manifest.json` lists. Their files are not checked.
    ///
    /// # Errors
    /// [`FileError::Read`] without a manifest, [`Error::Dataset`] if it is malformed.
    pub fn list(root: &Path) -> Result<Vec<Scene>, Error> {
        let path = root.join("manifest.json");
        let text = file::read_regular_text(&path, MAX_MANIFEST)
            .map_err(|source| FileError::Read { path, source })?;
        parse(root, &text).map_err(|problem| unusable(root, vec![problem]))
    }

    /// Notes the manifest and the scenes of the data set in `root`: no output may replace them.
    /// Returns the scenes.
    ///
    /// # Errors
    /// As [`list`](Self::list).
    pub fn protect(root: &Path, outputs: &mut Outputs) -> Result<Vec<Scene>, Error> {
        outputs.protect(&root.join("manifest.json"), "the manifest");
        let scenes = Self::list(root)?;
        for scene in &scenes {
            outputs.protect(&scene.path, &format!("scene {}", scene.name));
        }
        Ok(scenes)
    }

    /// The scenes of a split, in the manifest's order.
    ///
    /// # Errors
    /// [`Error::Dataset`] if there are none.
    pub fn split(&self, split: Split) -> Result<Vec<Scene>, Error> {
        let scenes: Vec<Scene> = self
            .scenes
            .iter()
            .filter(|scene| scene.split == split)
            .cloned()
            .collect();
        if scenes.is_empty() {
            let problem = format!("no scene is in the {split} split");
            return Err(unusable(&self.root, vec![problem]));
        }
        Ok(scenes)
    }

    /// Divides the training split into scenes for training and for validation. A `share` of its
    /// *base* scenes is held out, drawn by `seed`: rounded, at least one, and not all. A share of
    /// 0, or a single base scene, leaves no scenes for validation.
    ///
    /// # Errors
    /// [`Error::Dataset`] if the training split is empty.
    pub fn train_validation(
        &self,
        share: f64,
        seed: u64,
    ) -> Result<(Vec<Scene>, Vec<Scene>), Error> {
        let scenes = self.split(Split::Train)?;
        let sorted: BTreeSet<&str> = scenes.iter().map(|scene| scene.base.as_str()).collect();
        // The list is sorted, so the order of the manifest does not matter.
        let mut bases: Vec<&str> = sorted.into_iter().collect();
        bases.shuffle(&mut generator(RandomStream::Validation, seed, 0, 0));
        bases.truncate(held_out(share, bases.len()));
        let held: HashSet<String> = bases.into_iter().map(str::to_owned).collect();
        Ok(scenes
            .into_iter()
            .partition(|scene| !held.contains(&scene.base)))
    }
}

fn held_out(share: f64, bases: usize) -> usize {
    if share <= 0.0 || bases < 2 {
        return 0;
    }
    ((share * bases as f64).round() as usize).clamp(1, bases - 1)
}

fn parse(root: &Path, text: &str) -> Result<Vec<Scene>, String> {
    let problem = |error: serde_json::Error| format!("manifest.json: {error}");
    let ManifestHeader { format } = serde_json::from_str(text).map_err(problem)?;
    match format.strip_prefix(FORMAT) {
        Some(minor) if !minor.starts_with(|c: char| c.is_ascii_digit()) => {}
        _ => {
            return Err(format!(
                "manifest.json: format is {format:?}, expected {FORMAT:?}"
            ));
        }
    }
    let Manifest { scenes } = serde_json::from_str(text).map_err(problem)?;
    let scene = |entry: ManifestScene| {
        let layout = |name: String| {
            ChannelLayout::preset(&name)
                .ok_or_else(|| format!("scene {}: layout {name:?} is no preset", entry.name))
        };
        Ok(Scene {
            layout: entry.layout.map(layout).transpose()?,
            name: entry.name,
            split: entry.split,
            base: entry.base,
            path: root.join(entry.file),
            width: entry.width,
            height: entry.height,
            ref_residual_relmse: entry.ref_residual_relmse,
            repeat: entry.repeat,
            other: entry.other,
        })
    };
    scenes.into_iter().map(scene).collect()
}

/// The preset that fits the first readable file of a data set without a layout of its own, or `demc-exr` if
/// none fits.
pub fn preset_of(scenes: &[Scene]) -> &'static str {
    let fitting = |scene: &Scene| {
        let file = ExrFile::open(&scene.path).ok()?;
        let found = detect(&file, MissingPolicies::default(), None).ok()?;
        Some(found.preset)
    };
    let mut scenes = scenes.iter().filter(|scene| scene.layout.is_none());
    scenes.find_map(fitting).unwrap_or("demc-exr")
}

fn manifest_problems(scenes: &[Scene]) -> Vec<String> {
    let mut problems = Vec::new();
    if scenes.is_empty() {
        problems.push("manifest.json lists no scenes".to_owned());
    }
    let mut names = HashSet::new();
    let mut split_of: BTreeMap<&str, BTreeSet<Split>> = BTreeMap::new();
    for scene in scenes {
        if !names.insert(&scene.name) {
            problems.push(format!("scene {} is listed twice", scene.name));
        }
        split_of.entry(&scene.base).or_default().insert(scene.split);
    }
    let leaks = split_of.iter().filter(|(_, splits)| splits.len() > 1);
    problems.extend(leaks.map(|(base, _)| format!("base scene {base} is in train and in test")));
    problems
}

/// Files that several scenes share, under any name. Otherwise training could see a test image.
fn repeated_files(scenes: &[Scene]) -> Vec<String> {
    let mut first: BTreeMap<FileId, &Scene> = BTreeMap::new();
    let mut problems = Vec::new();
    for scene in scenes {
        // Missing files are another problem.
        let Ok(id) = FileId::of_existing(&scene.path) else {
            continue;
        };
        match first.entry(id) {
            Entry::Vacant(entry) => {
                entry.insert(scene);
            }
            Entry::Occupied(other) => problems.push(format!(
                "scenes {} and {} are the same file; remove one",
                other.get().name,
                scene.name
            )),
        }
    }
    problems
}

/// Problems with the scenes' files. If several files lack the same channels, that is one problem,
/// named for the first file.
fn file_problems(scenes: &[Scene], layout: &ChannelLayout) -> Vec<String> {
    let mut problems: Vec<(Error, usize)> = Vec::new();
    for error in scenes.iter().filter_map(|scene| file_error(scene, layout)) {
        let same = problems.iter_mut().find(|(known, _)| {
            let lacking = missing_channels(known);
            lacking.is_some() && lacking == missing_channels(&error)
        });
        match same {
            Some((_, more)) => *more += 1,
            None => problems.push((error, 0)),
        }
    }
    let phrase = |(error, more): &(Error, usize)| match (std::error::Error::source(error), more) {
        (Some(source), _) => format!("{error}: {source}"),
        (None, 0) => error.to_string(),
        (None, more) => format!("{error} (the same in {more} more scenes)"),
    };
    problems.iter().map(phrase).collect()
}

fn missing_channels(error: &Error) -> Option<&[String]> {
    match error {
        Error::MissingChannels { missing, .. } => Some(missing),
        _ => None,
    }
}

fn file_error(scene: &Scene, layout: &ChannelLayout) -> Option<Error> {
    match check_header(&scene.path, scene.layout(layout), Presence::Required) {
        Ok(window) => size_mismatch(scene, window.width, window.height),
        Err(error) => Some(error),
    }
}

/// The error for a file whose size differs from the manifest.
pub(crate) fn size_mismatch(scene: &Scene, width: usize, height: usize) -> Option<Error> {
    let size = |width, height| {
        Window {
            x: 0,
            y: 0,
            width,
            height,
        }
        .to_string()
    };
    ((width, height) != (scene.width, scene.height)).then(|| Error::SceneSize {
        path: scene.path.clone(),
        found: size(width, height),
        expected: size(scene.width, scene.height),
    })
}

fn unusable(root: &Path, mut problems: Vec<String>) -> Error {
    let more = problems.len().saturating_sub(PROBLEMS_LISTED);
    problems.truncate(PROBLEMS_LISTED);
    if more > 0 {
        problems.push(format!("and {more} more problems"));
    }
    // Names and paths of the manifest may contain line breaks.
    let problems = problems.iter().map(|problem| printable(problem)).collect();
    Error::Dataset {
        root: root.to_owned(),
        problems,
    }
}
