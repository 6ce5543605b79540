//! `demc-data index`.

mod rules;

use std::collections::{BTreeMap, BTreeSet, HashMap};
use std::fs;
use std::io::Write;
use std::path::{Path, PathBuf};

use crate::dataset::{FORMAT, MAX_MANIFEST};
use crate::exr::ExrFile;
use crate::frame::{Presence, check_open_header};
use crate::layout::{MissingPolicies, detect};
use crate::message::{self, printable};
use crate::output::{Directories, Outputs};
use crate::{ChannelLayout, Split, file};
use anyhow::{Context, Result, bail};
use serde_json::{Map, Value, json};

use super::IndexArguments;
use rules::{Entry, Rules};

/// Problems that an error names; the others are counted.
const PROBLEMS_LISTED: usize = 8;

/// A file of the data set.
struct Found {
    /// Relative path with `/`, as in the manifest.
    file: String,
    layout: String,
    width: usize,
    height: usize,
}

/// Writes the manifest and prints one line.
pub fn run(args: &IndexArguments) -> Result<()> {
    let rules = Rules::of(args)?;
    let manifest = args.root.join("manifest.json");
    let exists = manifest.symlink_metadata().is_ok();
    let (files, ignored) = exr_files(&args.root)?;
    let mut outputs = Outputs::default();
    for file in &files {
        outputs.protect(&args.root.join(file), &format!("scene {}", file.display()));
    }
    if let Some(layout) = &args.layout {
        outputs.protect(Path::new(layout), "the channel layout");
    }
    outputs.claim(&manifest, args.overwrite)?;
    outputs.prepare(Directories::Expect)?;
    let mut before = match exists {
        true => Before::read(&manifest)?,
        false => Before::default(),
    };
    if files.is_empty() {
        bail!("{}: no EXR files in it or below", args.root.display());
    }
    let found = check(&args.root, &files, args.layout.as_deref())?;
    let scenes = rules.scenes(&args.root, &found)?;
    let count = |split: Split| scenes.iter().filter(|scene| scene.split == split).count();
    let bases: BTreeSet<&str> = scenes.iter().map(|scene| scene.base.as_str()).collect();
    let mut summary = format!(
        "{}: {} scenes ({} train, {} test) of {} base scenes, layout {}",
        manifest.display(),
        scenes.len(),
        count(Split::Train),
        count(Split::Test),
        bases.len(),
        found[0].layout,
    );
    if ignored > 0 {
        summary += &format!("; other files and links, ignored: {ignored}");
    }
    let entries: Vec<Value> = scenes.iter().map(|scene| before.entry(scene)).collect();
    let gone = before.scenes.len();
    if gone > 0 {
        summary += &format!("; scenes of the old manifest without a file, dropped: {gone}");
    }
    let mut keys = before.keys;
    keys.insert("scenes".to_owned(), Value::Array(entries));
    let text = serde_json::to_string_pretty(&keys)? + "\n";
    file::write_whole(&manifest, |writer| writer.write_all(text.as_bytes()))?;
    message::status(printable(&summary));
    Ok(())
}

/// The manifest that is replaced.
struct Before {
    /// Its keys, with an empty list of scenes.
    keys: Map<String, Value>,
    /// Its entries by file.
    scenes: HashMap<String, Map<String, Value>>,
}

impl Default for Before {
    fn default() -> Self {
        let mut keys = Map::new();
        keys.insert("format".to_owned(), FORMAT.into());
        Self {
            keys,
            scenes: HashMap::new(),
        }
    }
}

impl Before {
    fn read(path: &Path) -> Result<Self> {
        let shown = path.display();
        let text =
            file::read_text(path, MAX_MANIFEST).with_context(|| format!("cannot read {shown}"))?;
        let mut before = Self::default();
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
                before.scenes.insert(file.clone(), scene);
            }
        }
        Ok(before)
    }

    /// The new entry of a scene, with the other keys of its old one.
    fn entry(&mut self, scene: &Entry) -> Value {
        let mut entry = json!({
            "name": scene.name,
            "split": scene.split,
            "base": scene.base,
            "file": scene.file,
            "width": scene.width,
            "height": scene.height,
        });
        if let (Some(entry), Some(old)) = (entry.as_object_mut(), self.scenes.remove(&scene.file)) {
            for (key, value) in old {
                entry.entry(key).or_insert(value);
            }
        }
        entry
    }
}

/// The EXR files of a directory and below, as relative paths in order, and the number of other
/// entries.
fn exr_files(root: &Path) -> Result<(Vec<PathBuf>, usize)> {
    let (mut files, mut ignored) = (Vec::new(), 0);
    let mut directories = vec![PathBuf::new()];
    while let Some(directory) = directories.pop() {
        let path = root.join(&directory);
        let shown = path.display();
        let entries = fs::read_dir(&path).with_context(|| format!("cannot read {shown}"))?;
        for entry in entries {
            let entry = entry.with_context(|| format!("cannot read {shown}"))?;
            let relative = directory.join(entry.file_name());
            let hidden = entry.file_name().as_encoded_bytes().starts_with(b".");
            let is_exr = Path::new(&entry.file_name())
                .extension()
                .is_some_and(|extension| extension.eq_ignore_ascii_case("exr"));
            // A linked directory may contain itself, so only links to files are followed.
            let kind = entry.file_type().ok();
            if kind.is_some_and(|kind| kind.is_dir()) && !hidden {
                directories.push(relative);
            } else if is_exr && !hidden && !entry.path().is_dir() {
                files.push(relative);
            } else if relative != Path::new("manifest.json") {
                ignored += 1;
            }
        }
    }
    files.sort();
    Ok((files, ignored))
}

/// Reads the headers. All files must have the reference and fit one layout.
fn check(root: &Path, files: &[PathBuf], layout: Option<&str>) -> Result<Vec<Found>> {
    let chosen = layout
        .map(|name| ChannelLayout::resolve(name).map(|layout| (name, layout)))
        .transpose()?;
    let mut found = Vec::with_capacity(files.len());
    let mut problems = Vec::new();
    for relative in files {
        match header(root, relative, chosen.as_ref()) {
            Ok(file) => found.push(file),
            Err(error) => problems.push(format!("{error:#}")),
        }
    }
    let mut layouts: BTreeMap<&str, Vec<&str>> = BTreeMap::new();
    for file in &found {
        layouts.entry(&file.layout).or_default().push(&file.file);
    }
    if layouts.len() > 1 {
        let groups = layouts.iter().map(|(layout, files)| {
            let more = match files.len() - 1 {
                0 => String::new(),
                more => format!(" and {more} more"),
            };
            format!("{layout} fits {}{more}", files[0])
        });
        let groups = groups.collect::<Vec<_>>().join(", ");
        problems.push(format!(
            "the files have several layouts: {groups}; use one directory for each"
        ));
    }
    refuse(root, problems)?;
    Ok(found)
}

fn header(root: &Path, relative: &Path, chosen: Option<&(&str, ChannelLayout)>) -> Result<Found> {
    let path = root.join(relative);
    let shown = path.display();
    let parts = relative.iter().map(|part| part.to_str());
    let Some(parts) = parts.collect::<Option<Vec<_>>>() else {
        bail!("{shown}: its name is not UTF-8");
    };
    let file = ExrFile::open(&path)?;
    let (name, layout) = match chosen {
        Some((name, layout)) => (*name, layout.clone()),
        None => {
            let preset = detect(&file, MissingPolicies::default(), None)?.preset;
            (preset, ChannelLayout::resolve(preset)?)
        }
    };
    if layout.reference.is_none() {
        bail!("layout {name} names no reference, which training needs");
    }
    let window = check_open_header(&file, &layout, Presence::Required)?;
    Ok(Found {
        file: parts.join("/"),
        layout: name.to_owned(),
        width: window.width,
        height: window.height,
    })
}

fn refuse(root: &Path, mut problems: Vec<String>) -> Result<()> {
    let more = problems.len().saturating_sub(PROBLEMS_LISTED);
    problems.truncate(PROBLEMS_LISTED);
    if more > 0 {
        problems.push(format!("and {more} more problems"));
    }
    match problems.is_empty() {
        true => Ok(()),
        false => bail!("{}: {}", root.display(), problems.join("; ")),
    }
}
