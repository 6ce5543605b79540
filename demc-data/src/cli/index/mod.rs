//! `demc-data index`.

mod found;
mod manifests;
mod rules;

use std::collections::BTreeSet;
use std::io::Write;
use std::path::{Path, PathBuf};

use anyhow::{Result, bail};
use clap::Args;
use demc_program::message::{self, printable};
use demc_program::output::{Directories, Outputs};
use demc_program::{exit, file};
use serde_json::Value;

use crate::dataset::Split;
use found::{exr_files, headers};
use manifests::Before;
use rules::Rules;

#[derive(Args)]
#[command(
    after_help = "Examples:\n  demc-data index renders --test 'kitchen*'\n  demc-data index renders --test 'bath/*' --base '^([^/]+)/'\n  demc-data index own --with data/sample"
)]
pub struct Arguments {
    /// Directory of the scenes
    #[arg(value_name = "DIR")]
    root: PathBuf,
    /// Glob pattern of the test scenes: relative paths or file names (repeatable)
    #[arg(long, value_name = "PATTERN")]
    test: Vec<String>,
    /// Regular expression whose only group is the base scene, searched in the relative path without
    /// extension; by default the file name without the number at its end
    #[arg(long, value_name = "REGEX")]
    base: Option<String>,
    /// Channel layout: a preset or a TOML file; by default the preset that fits each file
    #[arg(long, value_name = "PRESET|FILE")]
    layout: Option<String>,
    /// Data set whose training scenes are also listed (repeatable). Its files may have another layout
    #[arg(long = "with", value_name = "DIR")]
    beside: Vec<PathBuf>,
    /// Replace an existing manifest. Keys of its scenes that this command does not set stay, the splits without
    /// --test, and the base scenes without --base
    #[arg(long)]
    overwrite: bool,
}

impl Arguments {
    /// Writes the manifest and prints one line.
    pub fn run(&self) -> Result<u8> {
        let rules = Rules::new(&self.test, self.base.as_deref())?;
        let manifest = self.root.join("manifest.json");
        let exists = manifest.symlink_metadata().is_ok();
        let (files, ignored) = exr_files(&self.root)?;
        let mut outputs = Outputs::default();
        for file in &files {
            outputs.protect(&self.root.join(file), &format!("scene {}", file.display()));
        }
        if let Some(layout) = &self.layout {
            outputs.protect(Path::new(layout), "the channel layout");
        }
        outputs.claim(&manifest, self.overwrite)?;
        outputs.prepare(Directories::Expect)?;
        let mut before = if exists {
            Before::read(&self.root, &manifest)?
        } else {
            Before::default()
        };
        if files.is_empty() {
            bail!("{}: no EXR files in it or below", self.root.display());
        }
        let found = headers(&self.root, &files, self.layout.as_deref())?;
        let scenes = rules.scenes(&self.root, &found, |file| before.kept(file))?;
        let count = |split: Split| scenes.iter().filter(|scene| scene.split == split).count();
        let bases: BTreeSet<&str> = scenes.iter().map(|scene| scene.base.as_str()).collect();
        let mut entries: Vec<Value> = scenes.iter().map(|scene| before.entry(scene)).collect();
        let beside = manifests::beside(&self.root, &self.beside, &found[0].layout)?;
        let names = entries.iter().chain(&beside);
        if let Some(name) = repeated(names.filter_map(|entry| entry["name"].as_str())) {
            bail!("--with: several scenes have the name {}", printable(name));
        }
        before.forget(&beside);
        let elsewhere = before.elsewhere();
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
        if !beside.is_empty() {
            summary += &format!("; training scenes of --with: {}", beside.len());
            entries.extend(beside);
        }
        if !elsewhere.is_empty() {
            summary += &format!(
                "; scenes of the old manifest in other directories, kept: {}",
                elsewhere.len()
            );
            entries.extend(elsewhere);
        }
        let gone = before.scenes.len();
        if gone > 0 {
            summary += &format!("; scenes of the old manifest without a file, dropped: {gone}");
        }
        let mut keys = before.keys;
        keys.insert("scenes".to_owned(), Value::Array(entries));
        let text = serde_json::to_string_pretty(&keys)? + "\n";
        file::write_whole(&manifest, |writer| writer.write_all(text.as_bytes()))?;
        message::status(printable(&summary));
        Ok(exit::SUCCESS)
    }
}

/// The first name that occurs twice.
fn repeated<'a>(mut names: impl Iterator<Item = &'a str>) -> Option<&'a str> {
    let mut known = BTreeSet::new();
    names.find(|name| !known.insert(*name))
}
