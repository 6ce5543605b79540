//! What the checks find, and problems as they are reported.

use demc_program::file::FileError;
use serde::Serialize;

use crate::error::Error;

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

/// The findings of [`examine`](super::examine).
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
pub(super) struct Finding {
    problem: String,
    cause: String,
    affected: Affected,
}

impl Finding {
    pub(super) fn new(problem: &str, cause: &str, scene: &str, detail: String) -> Self {
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

/// The message without the path, which the scene's name replaces.
pub(super) fn short(error: &Error) -> String {
    match error {
        Error::MissingChannels { missing, .. } => missing.join(", "),
        Error::Sizes {
            a,
            a_window,
            b,
            b_window,
            ..
        } => format!("{a} is {a_window}, {b} is {b_window}"),
        Error::NonFinite {
            channel,
            value,
            x,
            y,
            count,
            ..
        } => format!("{channel}: {count}, the first {value} at x {x}, y {y}"),
        Error::SceneSize {
            found, expected, ..
        } => format!("{found}, not {expected}"),
        Error::Exr { detail, .. } | Error::Layout { detail, .. } => detail.clone(),
        Error::File(FileError::Read { source, .. }) => source.to_string(),
        other => other.to_string(),
    }
}

/// Findings of one kind become one problem, at the place of the first one.
pub(super) fn grouped(findings: Vec<Finding>) -> Vec<Problem> {
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
