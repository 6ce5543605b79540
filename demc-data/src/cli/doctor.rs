//! `demc-data doctor`.

use std::fmt::Write;
use std::path::PathBuf;

use anyhow::Result;
use clap::Args;
use demc_program::exit;
use demc_program::message::{self, printable};

use crate::check::doctor::{Affected, Problem, Report, examine};
use crate::training::config::{MAX_PATCH_SIZE, PATCH_MULTIPLE, PATCH_SIZE};

#[derive(Args)]
#[command(after_help = "Example:\n  demc-data doctor data/sample")]
pub struct Arguments {
    /// Directory of the data set, with its manifest.json
    #[arg(value_name = "DIR")]
    root: PathBuf,
    /// Channel layout: a preset or a TOML file; by default the preset that fits the first file
    #[arg(long, value_name = "PRESET|FILE")]
    layout: Option<String>,
    /// Patch size of training in pixels: a multiple of 32, at most 4096
    #[arg(long, default_value_t = PATCH_SIZE, value_name = "PIXELS", value_parser = patch_size)]
    patch_size: usize,
    /// Print one JSON object instead of lines
    #[arg(long)]
    json: bool,
}

/// Scenes that are named for a problem; the others are counted.
const NAMED: usize = 4;

/// Parses the patch size of training.
fn patch_size(text: &str) -> Result<usize, String> {
    let allowed = |size: &usize| {
        (PATCH_MULTIPLE..=MAX_PATCH_SIZE).contains(size) && size.is_multiple_of(PATCH_MULTIPLE)
    };
    text.parse().ok().filter(allowed).ok_or_else(|| {
        format!("expected a multiple of {PATCH_MULTIPLE} from {PATCH_MULTIPLE} to {MAX_PATCH_SIZE}")
    })
}

impl Arguments {
    /// Prints one line per problem and a summary, or one JSON object.
    pub fn run(&self) -> Result<u8> {
        let root = &self.root;
        if root.is_dir() && !root.join("manifest.json").exists() {
            anyhow::bail!(
                "{} has no manifest.json; run `demc-data index {0}` to write it",
                root.display()
            );
        }
        let report = examine(root, self.layout.as_deref(), self.patch_size)?;
        let text = if self.json {
            message::json(&report)?
        } else {
            lines(&report)
        };
        message::result(&text)?;
        Ok(if report.problems.is_empty() {
            exit::SUCCESS
        } else {
            exit::FAILURE
        })
    }
}

fn lines(report: &Report) -> String {
    let mut text = String::new();
    for problem in &report.problems {
        // Writing to a String cannot fail.
        let _ = writeln!(text, "{}", printable(&line(problem)));
    }
    let scenes = match report.scenes {
        1 => "1 scene".to_owned(),
        scenes => format!("{scenes} scenes"),
    };
    let problems = match report.problems.len() {
        0 => "no problems".to_owned(),
        1 => "1 problem".to_owned(),
        problems => format!("{problems} problems"),
    };
    let layout = printable(&report.layout);
    let _ = write!(text, "{scenes} with layout {layout}: {problems}.");
    text
}

/// `problem: scene (detail), scene (detail) and 3 more; cause`.
fn line(problem: &Problem) -> String {
    let name = |Affected { scene, detail }: &Affected| {
        if detail.is_empty() {
            scene.clone()
        } else {
            format!("{scene} ({detail})")
        }
    };
    let named: Vec<String> = problem.scenes.iter().take(NAMED).map(name).collect();
    let mut scenes = named.join(", ");
    if let Some(more @ 1..) = problem.scenes.len().checked_sub(NAMED) {
        // Writing to a String cannot fail.
        let _ = write!(scenes, " and {more} more");
    }
    format!("{}: {scenes}; {}", problem.problem, problem.cause)
}
