//! Buffers without content, and references beyond the range of the loss: training accepts them, but
//! learns nothing from them.

use std::collections::BTreeMap;

use crate::ChannelLayout;
use crate::frame::FramePlanes;
use crate::layout::Missing;
use crate::message::short_list;
use crate::plane::Plane;

/// Largest plausible reference, linear HDR. Squares overflow from 1.8e19 on (Eq. 5).
const MAX_REFERENCE: f32 = 1e15;

/// What an image lacks or exceeds, one phrase each; empty for a usable image.
pub fn suspicious(planes: &FramePlanes, layout: &ChannelLayout) -> Vec<String> {
    let is_black = |planes: &[Plane]| planes.iter().all(|plane| plane.constant() == Some(0.0));
    let mut found = Vec::new();
    if is_black(&planes.color) {
        found.push("the noisy image is black".to_owned());
    }
    if let Some(reference) = &planes.reference {
        if is_black(reference) {
            found.push("the reference is black".to_owned());
        }
        if reference.iter().any(|plane| plane.max() > MAX_REFERENCE) {
            found.push(format!("the reference has values above {MAX_REFERENCE:e}"));
        }
    }
    let buffers = layout.features().into_iter();
    for ((buffer, _, missing), planes) in buffers.zip(planes.features.chunks_exact(3)) {
        // With a policy the buffer may be absent from the file.
        let is_read = missing == Missing::Error;
        if is_read && planes.iter().all(|plane| plane.constant().is_some()) {
            found.push(format!("{buffer} is constant"));
        }
    }
    found
}

/// One line for each phrase, with the names of its scenes.
pub fn by_problem(found: &[(String, Vec<String>)]) -> Vec<String> {
    let mut scenes: BTreeMap<&str, Vec<&str>> = BTreeMap::new();
    for (scene, problems) in found {
        for problem in problems {
            scenes.entry(problem).or_default().push(scene);
        }
    }
    let lines = scenes.into_iter();
    lines
        .map(|(problem, scenes)| format!("{problem}: {}", short_list(&scenes)))
        .collect()
}

#[cfg(test)]
mod tests {
    use super::*;

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
            clamped: 0,
            exposure_scale: 1.0,
        }
    }

    #[test]
    fn black_constant_and_huge_buffers_are_found() {
        let layout = ChannelLayout::resolve("demc-exr").expect("a preset");
        let found = |color, reference, feature| {
            suspicious(&planes(color, reference, feature), &layout).join("; ")
        };
        assert_eq!(found(1.0, 1.0, 1.0), "");
        assert_eq!(found(0.0, 1.0, 1.0), "the noisy image is black");
        assert_eq!(found(1.0, 0.0, 1.0), "the reference is black");
        assert_eq!(found(1.0, 1e30, 1.0), "the reference has values above 1e15");
        assert_eq!(
            found(1.0, 1.0, 0.0),
            "normal is constant; position is constant; texture1 is constant; texture2 is constant"
        );
    }

    #[test]
    fn scenes_are_grouped_by_problem_and_counted() {
        let found: Vec<_> = (0..7)
            .map(|i| (format!("s{i}"), vec!["black".to_owned()]))
            .collect();
        assert_eq!(by_problem(&found), ["black: s0, s1, s2, s3, s4 and 2 more"]);
        assert!(by_problem(&[("s".into(), Vec::new())]).is_empty());
    }
}
