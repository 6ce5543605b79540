//! Looks for mistakes in a data set that training would not report: it only gets worse.
//!
//! [`examine`] reads every scene once. [`scene`](self) checks a file and its features, `reference`
//! compares noisy image and reference, `set` compares scenes with each other. All limits were set on
//! the 108 scenes of the training and test renders, none of which has a finding.

mod reference;
mod scene;
mod set;

use std::path::Path;

use serde::Serialize;

use crate::exr::ExrFile;
use crate::layout::{MissingPolicies, detect};
use crate::{ChannelLayout, Dataset, Error, Scene, parallel};

/// The scenes that share a problem.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Problem {
    /// What is wrong.
    pub problem: String,
    /// The likely cause, or the remedy.
    pub cause: String,
    /// The scenes concerned.
    pub scenes: Vec<Affected>,
}

/// A scene with a problem.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Affected {
    /// The scene's name; for a problem of a base scene, the base scene's.
    pub scene: String,
    /// What was measured; empty if there is nothing to add.
    pub detail: String,
}

/// The findings of [`examine`].
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Report {
    /// The layout that the files were read with.
    pub layout: String,
    /// Number of scenes in the manifest.
    pub scenes: usize,
    /// All problems, in the order of the checks.
    pub problems: Vec<Problem>,
}

/// One problem of one scene, before grouping.
#[derive(Debug, Clone, PartialEq)]
struct Finding {
    problem: String,
    cause: String,
    affected: Affected,
}

impl Finding {
    fn new(problem: &str, cause: &str, scene: &str, detail: String) -> Self {
        Self {
            problem: problem.to_owned(),
            cause: cause.to_owned(),
            affected: Affected {
                scene: scene.to_owned(),
                detail,
            },
        }
    }
}

/// Examines the data set at `root`. Without a `layout` (a preset or a TOML file), the preset that
/// fits the first readable file is used, or `demc-exr` if none fits.
///
/// `patch_size` is that of training in pixels.
///
/// # Errors
/// [`Error::Read`] without a manifest, [`Error::Dataset`] if it is malformed or lists no scenes,
/// [`Error::Layout`] for an unusable layout. Problems with files are findings, not errors.
pub fn examine(root: &Path, layout: Option<&str>, patch_size: usize) -> Result<Report, Error> {
    let scenes = Dataset::list(root)?;
    if scenes.is_empty() {
        return Err(Error::Dataset {
            root: root.to_owned(),
            problems: vec!["manifest.json lists no scenes".to_owned()],
        });
    }
    let name = layout.unwrap_or_else(|| layout_of(&scenes));
    let layout = ChannelLayout::resolve(name)?;

    let mut findings = set::of_manifest(&scenes);
    let examined = parallel::map(
        parallel::threads().count,
        scenes.iter().collect(),
        |scene| scene::examine(scene, &layout, patch_size),
    );
    let mut measured = Vec::with_capacity(scenes.len());
    for (scene, (own, image)) in scenes.iter().zip(examined) {
        findings.extend(own);
        measured.extend(image.map(|image| (scene, image)));
    }
    findings.extend(set::of_images(&measured));
    if layout.reference.is_none() {
        let cause = "training needs one: name its channels in the layout";
        findings.push(Finding::new(
            "the layout names no reference",
            cause,
            name,
            String::new(),
        ));
    }
    Ok(Report {
        layout: name.to_owned(),
        scenes: scenes.len(),
        problems: grouped(findings),
    })
}

fn layout_of(scenes: &[Scene]) -> &'static str {
    let fitting = |scene: &Scene| {
        let file = ExrFile::open(&scene.path).ok()?;
        let found = detect(&file, MissingPolicies::default(), None).ok()?;
        Some(found.preset)
    };
    scenes.iter().find_map(fitting).unwrap_or("demc-exr")
}

/// Findings of one kind become one problem, at the place of the first one.
fn grouped(findings: Vec<Finding>) -> Vec<Problem> {
    let mut problems: Vec<Problem> = Vec::new();
    for finding in findings {
        let same = |p: &&mut Problem| (&p.problem, &p.cause) == (&finding.problem, &finding.cause);
        match problems.iter_mut().find(same) {
            Some(problem) => problem.scenes.push(finding.affected),
            None => problems.push(Problem {
                problem: finding.problem,
                cause: finding.cause,
                scenes: vec![finding.affected],
            }),
        }
    }
    problems
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn findings_of_one_kind_are_one_problem() {
        let finding = |problem, scene| Finding::new(problem, "why", scene, String::new());
        let problems = grouped(vec![
            finding("dark", "a"),
            finding("small", "a"),
            finding("dark", "b"),
        ]);
        let scenes = |problem: &Problem| -> Vec<String> {
            let scenes = problem.scenes.iter();
            scenes.map(|affected| affected.scene.clone()).collect()
        };
        assert_eq!(problems.len(), 2);
        assert_eq!(scenes(&problems[0]), ["a", "b"]);
        assert_eq!(scenes(&problems[1]), ["a"]);
    }
}
