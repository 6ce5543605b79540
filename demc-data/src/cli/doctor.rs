//! `demc-data doctor`.

use std::fmt::Write;
use std::path::Path;

use crate::doctor::{Affected, Problem, Report, examine};
use crate::message::{self, printable};
use anyhow::Result;

/// Scenes that are named for a problem; the others are counted.
const NAMED: usize = 4;

/// Prints one line per problem and a summary, or one JSON object.
pub fn run(root: &Path, layout: Option<&str>, patch_size: usize, json: bool) -> Result<u8> {
    if root.is_dir() && !root.join("manifest.json").exists() {
        anyhow::bail!(
            "{} has no manifest.json; run `demc-data index {0}` to write it",
            root.display()
        );
    }
    let report = examine(root, layout, patch_size)?;
    message::result(&match json {
        true => message::json(&report)?,
        false => lines(&report),
    })?;
    Ok(match report.problems.is_empty() {
        true => 0,
        false => 1,
    })
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
    let named = problem.scenes.iter().take(NAMED);
    let named = named.map(|Affected { scene, detail }| match detail.is_empty() {
        true => scene.clone(),
        false => format!("{scene} ({detail})"),
    });
    let mut scenes = named.collect::<Vec<_>>().join(", ");
    if let Some(more @ 1..) = problem.scenes.len().checked_sub(NAMED) {
        // Writing to a String cannot fail.
        let _ = write!(scenes, " and {more} more");
    }
    format!("{}: {scenes}; {}", problem.problem, problem.cause)
}
