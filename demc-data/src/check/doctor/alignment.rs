//! Compares the features with the image: both have their edges at the same places, and the features have
//! none of the image's noise.
//!
//! The numbers at the limits are those of the 108 training and test renders.

use super::details::{Details, shifts};
use super::finding::Finding;
use crate::check::noise::log_luminance;
use crate::image::frame::{Frame, MAX_ALBEDO, TEXTURES};
use crate::image::layout::ChannelLayout;

/// Smallest correlation of the edges of features and image (renders: 0.145; features of other scenes: 95 %
/// below 0.12).
const SAME_IMAGE: f64 = 0.1;
/// Difference by which moved or mirrored features must correlate better (renders: at least 0.05 worse).
const MARGIN: f64 = 0.05;
/// Largest length of a gradient that counts.
const LONGEST: f64 = 2.0;
/// Correlation of the details of an albedo and of the image's noise that shows a colour (renders: 0.43;
/// colours: at least 0.65).
const SAME_NOISE: f64 = 0.55;
/// Ratio of the median variances of both albedos above which they are exchanged (renders: 1.5). The one of the
/// second hit has the noise of a random bounce.
const NOISIER: f64 = 2.2;
/// Correlation of neighbouring details below which they are noise. Textures have more than 0.13: renders of
/// 16 and 64 samples per pixel, and quarters of renders. At 4 samples, 95 % of the second hits have less.
const WHITE: f64 = 0.1;
/// Variance that is added to both.
const ROUNDING: f64 = 1e-6;

/// Features of another image, moved or mirrored; a colour as albedo; exchanged albedos. If the reference is
/// wrong, the features are not compared with it.
pub(super) fn findings(
    name: &str,
    frame: &Frame,
    layout: &ChannelLayout,
    reference_is_wrong: bool,
) -> Vec<Finding> {
    let mut found = Vec::new();
    let mut add = |problem: &str, cause: &str, detail: String| {
        found.push(Finding::new(problem, cause, name, detail));
    };
    let reference = frame.reference.as_deref().filter(|_| !reference_is_wrong);
    if let Some(reference) = reference {
        if let Some((problem, detail)) = misplaced(frame, layout, reference) {
            let cause =
                "render them with the colour in one pass, and do not crop or mirror one of them";
            add(problem, cause, detail);
        }
        if let Some(share) = noise_of_albedo(frame, layout, reference)
            && share > SAME_NOISE
        {
            let detail = format!("it correlates with the noise by {share:.2}");
            add(
                "texture1 has the noise of the image",
                "is it the colour?",
                detail,
            );
        }
    }
    if let Some(ratio) = noise_ratio(frame, layout).filter(|ratio| *ratio > NOISIER) {
        let cause = "are the albedos of first and second hit exchanged?";
        let detail = format!("{ratio:.1} times its variance");
        add("texture1 has more noise than texture2", cause, detail);
    }
    found
}

fn double(plane: &[f32]) -> Vec<f64> {
    plane.iter().map(|x| f64::from(*x)).collect()
}

/// How the features do not fit the image, if they do not.
fn misplaced(
    frame: &Frame,
    layout: &ChannelLayout,
    image: &[f32],
) -> Option<(&'static str, String)> {
    let pixels = frame.width * frame.height;
    let plane = |channel: usize| &frame.features[channel * pixels..(channel + 1) * pixels];
    let mut planes = Vec::new();
    if layout.normal.is_some() {
        planes.extend((0..3).map(|channel| double(plane(channel))));
    }
    if layout.texture1.is_some() {
        let albedo = (TEXTURES..TEXTURES + 3).map(|channel| {
            let values = plane(channel).iter();
            values.map(|x| f64::from(x.min(MAX_ALBEDO))).collect()
        });
        planes.extend(albedo);
    }
    let features = Details::edges(&planes, LONGEST, frame);
    let image = Details::edges(&[log_luminance(image)?], LONGEST, frame);
    if features.variance() == 0.0 || image.variance() == 0.0 || image.count() == 0 {
        return None;
    }
    let unmoved = features.correlation(&image, (0, 0));
    let mirrored = [
        (true, false, "left to right"),
        (false, true, "top to bottom"),
        (true, true, "in both directions"),
    ]
    .map(|(across, down, words)| {
        let other = image.mirrored(across, down);
        (features.correlation(&other, (0, 0)), words)
    });
    let (best, words) = mirrored.into_iter().max_by(|a, b| a.0.total_cmp(&b.0))?;
    if best > unmoved + MARGIN && best > SAME_IMAGE {
        return Some(("the features are mirrored", words.to_owned()));
    }
    let moved = shifts().map(|shift| (features.correlation(&image, shift), shift));
    let (best, (x, y)) = moved.max_by(|a, b| a.0.total_cmp(&b.0))?;
    if best > unmoved + MARGIN && best > SAME_IMAGE {
        // The pixel of the image that fits is at the opposite of the features' shift.
        let detail = format!("by {:+} {:+} pixels", -x, -y);
        return Some(("the features are shifted against the image", detail));
    }
    (unmoved < SAME_IMAGE).then(|| {
        let detail = format!("edges correlate by {unmoved:.2}");
        ("the features are of another image", detail)
    })
}

/// Correlation of the details of the first albedo and of the noise.
fn noise_of_albedo(frame: &Frame, layout: &ChannelLayout, reference: &[f32]) -> Option<f64> {
    layout.texture1.as_ref()?;
    let pixels = frame.width * frame.height;
    let albedo: Vec<f32> = frame.features[TEXTURES * pixels..(TEXTURES + 3) * pixels]
        .iter()
        .map(|x| x.clamp(0.0, MAX_ALBEDO))
        .collect();
    let [noisy, clean] = [&frame.color[..], reference].map(log_luminance);
    let noise = noisy?
        .iter()
        .zip(clean?)
        .map(|(noisy, clean)| noisy - clean)
        .collect::<Vec<f64>>();
    let noise = Details::without_mean(&noise, frame);
    Some(noise.correlation(&Details::of(&albedo, frame)?, (0, 0)))
}

/// Ratio of the median variances of the albedos' details; `None` if those of the first hit are a texture.
fn noise_ratio(frame: &Frame, layout: &ChannelLayout) -> Option<f64> {
    layout.texture1.as_ref()?;
    layout.texture2.as_ref()?;
    let pixels = frame.width * frame.height;
    let [first, second] = [TEXTURES, TEXTURES + 3].map(|start| {
        let mean = (0..pixels).map(|i| {
            let channels =
                (start..start + 3).map(|c| frame.features[c * pixels + i].min(MAX_ALBEDO));
            f64::from(channels.sum::<f32>()) / 3.0
        });
        Details::without_mean(&mean.collect::<Vec<f64>>(), frame)
    });
    if first.neighbours() >= WHITE {
        return None;
    }
    let [first, second] = [first, second].map(|details| details.median_square() + ROUNDING);
    Some(first / second)
}
