//! Buffers without content, and references beyond the range of the loss: training accepts them, but
//! learns nothing from them.

use std::collections::BTreeMap;

use demc_program::message::short_list;

use crate::image::frame::FramePlanes;
use crate::image::layout::{ChannelLayout, Missing};

/// Largest plausible radiance, linear HDR. Squares overflow from 1.8e19 on (Eq. 5).
const MAX_RADIANCE: f32 = 1e15;

/// What an image lacks or exceeds.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct ContentProblem {
    /// The problem in a phrase, such as `the reference is black`.
    pub text: String,
    /// Whether nothing can be learned from this image.
    pub is_fatal: bool,
}

/// The problems of an image; empty for a usable image.
pub fn suspicious(planes: &FramePlanes, layout: &ChannelLayout) -> Vec<ContentProblem> {
    let mut found = Vec::new();
    let mut report = |text: String, is_fatal| found.push(ContentProblem { text, is_fatal });
    let images = [
        ("noisy image", Some(&planes.color)),
        ("reference", planes.reference.as_ref()),
    ];
    for (name, planes) in images {
        let Some(planes) = planes else { continue };
        if planes.iter().all(|plane| plane.constant() == Some(0.0)) {
            report(format!("the {name} is black"), true);
        }
        if planes.iter().any(|plane| plane.max() > MAX_RADIANCE) {
            // Some such values may be fireflies.
            let is_fatal = planes.iter().all(|plane| plane.min() > MAX_RADIANCE);
            let which = if is_fatal { "only values" } else { "values" };
            report(
                format!("the {name} has {which} above {MAX_RADIANCE:e}"),
                is_fatal,
            );
        }
    }
    let buffers = layout.features().into_iter();
    for (buffer, planes) in buffers.zip(planes.features.chunks_exact(3)) {
        // With a policy the buffer may be absent from the file.
        let is_read = buffer.missing == Missing::Error;
        if is_read && planes.iter().all(|plane| plane.constant().is_some()) {
            report(format!("{} is constant", buffer.name), false);
        }
    }
    found
}

/// One line for each problem, with the names of its scenes.
pub fn by_problem(found: &[(String, Vec<ContentProblem>)]) -> Vec<String> {
    let mut scenes: BTreeMap<&str, Vec<&str>> = BTreeMap::new();
    for (scene, problems) in found {
        for problem in problems {
            scenes.entry(&problem.text).or_default().push(scene);
        }
    }
    let lines = scenes.into_iter();
    lines
        .map(|(problem, scenes)| format!("{problem}: {}", short_list(&scenes)))
        .collect()
}

/// The fatal problems, as [`by_problem`], if every scene has one; otherwise nothing.
pub fn unusable(found: &[(String, Vec<ContentProblem>)]) -> Vec<String> {
    let fatal_of = |(scene, problems): &(String, Vec<ContentProblem>)| {
        let fatal = problems.iter().filter(|problem| problem.is_fatal);
        (scene.clone(), fatal.cloned().collect::<Vec<_>>())
    };
    let fatal: Vec<_> = found.iter().map(fatal_of).collect();
    if fatal.iter().any(|(_, problems)| problems.is_empty()) {
        Vec::new()
    } else {
        by_problem(&fatal)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::image::plane::Plane;

    fn planes(color: f32, reference: f32, feature: f32) -> FramePlanes {
        let varied = |value: f32| Plane::Float(vec![value, value / 2.0]);
        FramePlanes {
            width: 2,
            height: 1,
            color: vec![varied(color); 3],
            features: vec![varied(feature); 12],
            reference: Some(vec![varied(reference); 3]),
            mask: None,
            alpha: None,
            passes: None,
            reference_passes: None,
            clamped: 0,
            exposure_scale: 1.0,
        }
    }

    #[test]
    fn black_constant_and_huge_buffers_are_found() {
        let layout = ChannelLayout::resolve("demc-exr").expect("a preset");
        let found = |color, reference, feature| {
            let found = suspicious(&planes(color, reference, feature), &layout);
            let phrases = found.into_iter().map(|problem| {
                if problem.is_fatal {
                    problem.text + "!"
                } else {
                    problem.text
                }
            });
            phrases.collect::<Vec<_>>().join("; ")
        };
        assert_eq!(found(1.0, 1.0, 1.0), "");
        assert_eq!(found(0.0, 1.0, 1.0), "the noisy image is black!");
        assert_eq!(found(1.0, 0.0, 1.0), "the reference is black!");
        let only = "the reference has only values above 1e15!";
        assert_eq!(found(1.0, 1e30, 1.0), only);
        let some = "the reference has values above 1e15";
        assert_eq!(found(1.0, 1.5e15, 1.0), some);
        let noisy = "the noisy image has only values above 1e15!";
        assert_eq!(found(1e30, 1.0, 1.0), noisy);
        assert_eq!(
            found(1.0, 1.0, 0.0),
            "normal is constant; position is constant; texture1 is constant; texture2 is constant"
        );
    }

    fn problem(text: &str, is_fatal: bool) -> ContentProblem {
        ContentProblem {
            text: text.into(),
            is_fatal,
        }
    }

    #[test]
    fn scenes_are_grouped_by_problem_and_counted() {
        let found: Vec<_> = (0..7)
            .map(|i| (format!("s{i}"), vec![problem("black", true)]))
            .collect();
        assert_eq!(by_problem(&found), ["black: s0, s1, s2, s3, s4 and 2 more"]);
        assert!(by_problem(&[("s".into(), Vec::new())]).is_empty());
    }

    #[test]
    fn scenes_are_unusable_if_none_is_usable() {
        let mut found = vec![
            ("a".to_owned(), vec![problem("black", true)]),
            (
                "b".to_owned(),
                vec![problem("flat", false), problem("huge", true)],
            ),
        ];
        assert_eq!(unusable(&found), ["black: a", "huge: b"]);
        found.push(("c".to_owned(), vec![problem("flat", false)]));
        assert!(unusable(&found).is_empty());
    }
}
