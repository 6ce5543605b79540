//! `demc-data index`.

use std::collections::{BTreeMap, BTreeSet, HashMap};
use std::fs;
use std::io::Write;
use std::path::{Path, PathBuf};

use anyhow::{Context, Result, bail};
use demc_data::dataset::FORMAT;
use demc_data::exr::ExrFile;
use demc_data::frame::{Presence, check_open_header};
use demc_data::layout::{MissingPolicies, detect};
use demc_data::message::{self, printable};
use demc_data::output::{Directories, Outputs};
use demc_data::{ChannelLayout, Split, file};
use glob::Pattern;
use regex_lite::Regex;
use serde_json::{Map, Value, json};

use super::{IndexArguments, UsageError};

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
        let text = fs::read_to_string(path).with_context(|| format!("cannot read {shown}"))?;
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

/// The rules for splits and base scenes.
struct Rules {
    test: Vec<(String, Pattern)>,
    base: Option<Regex>,
}

/// A scene of the new manifest.
struct Entry {
    name: String,
    split: Split,
    base: String,
    file: String,
    width: usize,
    height: usize,
}

impl Rules {
    fn of(args: &IndexArguments) -> Result<Self, UsageError> {
        let pattern = |text: &String| match Pattern::new(text) {
            Ok(pattern) => Ok((text.clone(), pattern)),
            Err(error) => Err(UsageError(format!("--test {}: {error}", printable(text)))),
        };
        let regex = |text: &String| {
            let shown = printable(text);
            let regex =
                Regex::new(text).map_err(|error| UsageError(format!("--base {shown}: {error}")))?;
            // The whole match counts as a group.
            match regex.captures_len() {
                2 => Ok(regex),
                groups => Err(UsageError(format!(
                    "--base {shown}: {} groups, expected 1",
                    groups - 1
                ))),
            }
        };
        Ok(Self {
            test: args.test.iter().map(pattern).collect::<Result<_, _>>()?,
            base: args.base.as_ref().map(regex).transpose()?,
        })
    }

    /// The scenes of these files.
    fn scenes(&self, root: &Path, found: &[Found]) -> Result<Vec<Entry>> {
        let mut problems = Vec::new();
        for (text, pattern) in &self.test {
            if !found.iter().any(|found| matches(pattern, &found.file)) {
                problems.push(format!("--test {text} matches no file"));
            }
        }
        let mut stems: HashMap<&str, usize> = HashMap::new();
        for found in found {
            *stems.entry(stem(&found.file)).or_default() += 1;
        }
        let unique = stems.values().all(|count| *count == 1);
        let mut scenes = Vec::with_capacity(found.len());
        let mut names: HashMap<String, &str> = HashMap::new();
        for Found {
            file,
            width,
            height,
            ..
        } in found
        {
            let path = file
                .rsplit_once('.')
                .map_or(file.as_str(), |(path, _)| path);
            let name = match unique {
                true => stem(file).to_owned(),
                false => path.replace('/', "-"),
            };
            if let Some(other) = names.insert(name.clone(), file) {
                problems.push(format!("{other} and {file} both get the name {name}"));
            }
            let base = match &self.base {
                None => Some(base(path)),
                Some(regex) => regex
                    .captures(path)
                    .and_then(|groups| groups.get(1))
                    .map(|group| group.as_str()),
            };
            let base = base.filter(|base| !base.is_empty());
            if base.is_none() {
                problems.push(format!("{file}: --base finds no base scene in {path}"));
            }
            let test = self.test.iter().any(|(_, test)| matches(test, file));
            scenes.push(Entry {
                name,
                split: if test { Split::Test } else { Split::Train },
                base: base.unwrap_or_default().to_owned(),
                file: file.clone(),
                width: *width,
                height: *height,
            });
        }
        problems.extend(leaks(&scenes));
        refuse(root, problems)?;
        Ok(scenes)
    }
}

/// Base scenes in both splits.
fn leaks(scenes: &[Entry]) -> Vec<String> {
    let mut examples: BTreeMap<&str, BTreeMap<Split, &str>> = BTreeMap::new();
    for scene in scenes {
        let files = examples.entry(&scene.base).or_default();
        files.entry(scene.split).or_insert(&scene.file);
    }
    let leaks = examples.into_iter().filter(|(_, files)| files.len() > 1);
    let phrase = |(base, files): (&str, BTreeMap<Split, &str>)| {
        let files: Vec<String> = files
            .into_iter()
            .map(|(split, file)| format!("{file} is in {split}"))
            .collect();
        let files = files.join(", ");
        format!("base scene {base} would be in both splits ({files}); change --test or --base")
    };
    leaks.map(phrase).collect()
}

fn matches(pattern: &Pattern, file: &str) -> bool {
    let name = file.rsplit_once('/').map_or(file, |(_, name)| name);
    pattern.matches(file) || pattern.matches(name)
}

/// The file name without extension.
fn stem(file: &str) -> &str {
    let name = file.rsplit_once('/').map_or(file, |(_, name)| name);
    name.rsplit_once('.').map_or(name, |(stem, _)| stem)
}

/// The file name without the number of a frame or view at its end; the directory if only a number
/// is left. `path` has no extension.
fn base(path: &str) -> &str {
    let (directory, name) = path.rsplit_once('/').unwrap_or(("", path));
    let numberless = name.trim_end_matches(|c: char| c.is_ascii_digit());
    if numberless.len() == name.len() {
        return name;
    }
    match numberless.trim_end_matches(['-', '_', '.', ' ']) {
        "" if directory.is_empty() => name,
        "" => directory,
        base => base,
    }
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

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_base_is_the_name_without_its_number() {
        for (path, expected) in [
            ("kitchen-0", "kitchen"),
            ("a/kitchen.0012", "kitchen"),
            ("kitchen", "kitchen"),
            ("living-room-2-11", "living-room-2"),
            ("shot_0001", "shot"),
            ("frame0001", "frame"),
            ("kitchen/0001", "kitchen"),
            ("houses/kitchen/0001", "houses/kitchen"),
            ("0001", "0001"),
        ] {
            assert_eq!(base(path), expected, "{path}");
        }
    }
}
