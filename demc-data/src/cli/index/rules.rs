//! The rules by which files become scenes: names, splits, and base scenes.

use std::collections::{BTreeMap, HashMap};
use std::path::Path;

use anyhow::Result;
use demc_program::exit::UsageError;
use demc_program::message::printable;
use glob::Pattern;
use regex_lite::Regex;

use super::found::{Found, refuse};
use crate::dataset::Split;

/// The rules for splits and base scenes.
pub(super) struct Rules {
    test: Vec<(String, Pattern)>,
    base: Option<Regex>,
}

/// A scene of the new manifest.
pub(super) struct Entry {
    pub(super) name: String,
    pub(super) split: Split,
    pub(super) base: String,
    pub(super) file: String,
    pub(super) width: usize,
    pub(super) height: usize,
}

/// What a file is in the manifest that is replaced.
#[derive(Default)]
pub(super) struct Kept {
    pub(super) split: Option<Split>,
    pub(super) base: Option<String>,
}

impl Rules {
    /// The rules of `--test` and `--base`.
    pub(super) fn new(test: &[String], base: Option<&str>) -> Result<Self, UsageError> {
        let pattern = |text: &String| match Pattern::new(text) {
            Ok(pattern) => Ok((text.clone(), pattern)),
            Err(error) => Err(UsageError(format!("--test {}: {error}", printable(text)))),
        };
        let regex = |text: &str| {
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
            test: test.iter().map(pattern).collect::<Result<_, _>>()?,
            base: base.map(regex).transpose()?,
        })
    }

    /// The scenes of these files. Without `--test`, a file keeps the split that it has `before`; without
    /// `--base`, its base scene.
    pub(super) fn scenes(
        &self,
        root: &Path,
        found: &[Found],
        before: impl Fn(&str) -> Kept,
    ) -> Result<Vec<Entry>> {
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
            let name = if unique {
                stem(file).to_owned()
            } else {
                path.replace('/', "-")
            };
            if let Some(other) = names.insert(name.clone(), file) {
                problems.push(format!("{other} and {file} both get the name {name}"));
            }
            let kept = before(file);
            let base = match &self.base {
                None => Some(kept.base.unwrap_or_else(|| base(path).to_owned())),
                Some(regex) => regex
                    .captures(path)
                    .and_then(|groups| groups.get(1))
                    .map(|group| group.as_str().to_owned()),
            }
            .filter(|base| !base.is_empty());
            if base.is_none() {
                problems.push(format!("{file}: --base finds no base scene in {path}"));
            }
            let split = match kept.split {
                Some(split) if self.test.is_empty() => split,
                _ if self.test.iter().any(|(_, test)| matches(test, file)) => Split::Test,
                _ => Split::Train,
            };
            scenes.push(Entry {
                name,
                split,
                base: base.unwrap_or_default(),
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
        let files = files
            .into_iter()
            .map(|(split, file)| format!("{file} is in {split}"))
            .collect::<Vec<_>>()
            .join(", ");
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
