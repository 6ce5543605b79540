//! The files of a directory, and their headers.

use std::collections::BTreeMap;
use std::fs;
use std::path::{Path, PathBuf};

use anyhow::{Context, Result, bail};
use demc_program::file::FileId;

use crate::image::exr::ExrFile;
use crate::image::frame::{Presence, check_open_header};
use crate::image::layout::{ChannelLayout, MissingPolicies, detect};

/// Problems that an error names; the others are counted.
const PROBLEMS_LISTED: usize = 8;

/// A file of the data set.
pub(super) struct Found {
    /// Relative path with `/`, as in the manifest.
    pub(super) file: String,
    pub(super) layout: String,
    pub(super) width: usize,
    pub(super) height: usize,
}

/// The EXR files of a directory and below, as relative paths in order, and the number of other
/// entries.
pub(super) fn exr_files(root: &Path) -> Result<(Vec<PathBuf>, usize)> {
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
pub(super) fn headers(root: &Path, files: &[PathBuf], layout: Option<&str>) -> Result<Vec<Found>> {
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
        problems.push(format!(
            "the files have several layouts: {}; use one directory for each",
            groups.collect::<Vec<_>>().join(", ")
        ));
    }
    problems.extend(same_files(root, &found));
    refuse(root, problems)?;
    Ok(found)
}

/// Files that stand in the directory under several names.
fn same_files(root: &Path, found: &[Found]) -> Vec<String> {
    let mut first: BTreeMap<FileId, &str> = BTreeMap::new();
    let mut problems = Vec::new();
    for Found { file, .. } in found {
        // A file that is gone is reported when it is read.
        let Ok(id) = FileId::of_existing(&root.join(file)) else {
            continue;
        };
        let other = *first.entry(id).or_insert(file);
        if other != file {
            problems.push(format!("{other} and {file} are the same file; remove one"));
        }
    }
    problems
}

fn header(root: &Path, relative: &Path, chosen: Option<&(&str, ChannelLayout)>) -> Result<Found> {
    let path = root.join(relative);
    let shown = path.display();
    let Some(parts) = relative
        .iter()
        .map(|part| part.to_str())
        .collect::<Option<Vec<_>>>()
    else {
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

pub(super) fn refuse(root: &Path, mut problems: Vec<String>) -> Result<()> {
    let more = problems.len().saturating_sub(PROBLEMS_LISTED);
    problems.truncate(PROBLEMS_LISTED);
    if more > 0 {
        problems.push(format!("and {more} more problems"));
    }
    if !problems.is_empty() {
        bail!("{}: {}", root.display(), problems.join("; "));
    }
    Ok(())
}
