//! Checks of one scene: its file, its features, its noise.

use demc_program::file::FileError;

use super::alignment;
use super::finding::{Finding, short};
use super::passes;
use super::reference;
use super::set::Image;
use crate::check::geometry;
use crate::check::noise::{self, CORRELATED};
use crate::dataset::{Scene, size_mismatch};
use crate::error::Error;
use crate::image::frame::{Frame, POSITIONS, TEXTURES, read_pair};
use crate::image::layout::{ChannelLayout, Missing};

/// Share of pixels with a unit vector that identifies normals (the renders' positions: at most
/// 0.35).
const UNIT_SHARE: f64 = 0.9;
/// Smallest share of negative samples that is reported (renders: 0.0095; noisy images with
/// Mitchell, Catmull-Rom, and Lanczos filters: 0.05 to 0.13).
const NEGATIVE_SHARE: f64 = 0.02;
/// Largest distance of a unit vector's length from 1.
const UNIT_TOLERANCE: f32 = 0.02;

/// The findings of a scene, and what is compared with other scenes.
pub(super) fn examine(
    scene: &Scene,
    layout: &ChannelLayout,
    patch_size: usize,
) -> (Vec<Finding>, Option<Image>) {
    let layout = scene.layout(layout);
    let mut findings = Vec::new();
    let mut frame = read_pair(&scene.path, layout, false);
    if let Err(error @ Error::NonFinite { .. }) = &frame {
        findings.push(Finding::new(
            "NaN or infinite samples",
            "a bug of the renderer or of its materials; training refuses the file",
            &scene.name,
            short(error),
        ));
        frame = read_pair(&scene.path, layout, true);
    }
    let frame = match frame {
        Ok(frame) => frame,
        Err(error) => {
            findings.push(unusable(scene, &error));
            return (findings, None);
        }
    };
    let mut add = |problem: &str, cause: &str, detail: String| {
        findings.push(Finding::new(problem, cause, &scene.name, detail));
    };
    if let Some(error) = size_mismatch(scene, frame.width, frame.height) {
        let cause = "run demc-data index --overwrite";
        add("sizes differ from the manifest", cause, short(&error));
    }
    let (width, height) = (frame.width, frame.height);
    if width.min(height) < patch_size {
        add(
            &format!("images smaller than a patch of {patch_size}x{patch_size}"),
            "render larger images, or set data.patch_size",
            format!("{width}x{height}"),
        );
    }
    let radiance = frame.color.len() + frame.reference.as_ref().map_or(0, Vec::len);
    let negative = frame.clamped as f64 / radiance as f64;
    if negative > NEGATIVE_SHARE {
        add(
            "much negative radiance, which training sets to 0",
            "a pixel filter with negative lobes (Mitchell, Catmull-Rom, Lanczos): use a box",
            format!("{:.1} % of the samples", 100.0 * negative),
        );
    }
    let correlation = noise::correlation(&frame.color, width, height)
        .filter(|correlation| *correlation >= CORRELATED);
    if let Some(correlation) = correlation {
        add(
            "noise of neighbouring pixels correlates",
            "set the renderer's pixel filter to box",
            format!("by {correlation:.2}"),
        );
    }
    let wrong = reference::findings(&scene.name, &frame, correlation.is_some());
    let reference_is_wrong = !wrong.is_empty();
    findings.extend(wrong);
    let wrong = features(&scene.name, &frame, layout);
    // Normals in another space or buffer are at other places, too.
    if wrong.is_empty() {
        findings.extend(alignment::findings(
            &scene.name,
            &frame,
            layout,
            reference_is_wrong,
        ));
    }
    findings.extend(wrong);
    findings.extend(passes::findings(&scene.name, &scene.path, layout));
    let image = Image::of(&frame);
    (findings, Some(image))
}

/// The finding for a file that cannot be read with the layout.
fn unusable(scene: &Scene, error: &Error) -> Finding {
    let (problem, cause) = match error {
        Error::MissingChannels { .. } | Error::Layout { .. } => (
            "channels are missing",
            "choose --layout, or append them with demc-data merge",
        ),
        Error::Sizes { .. } => (
            "buffers of different sizes",
            "render all of them in one resolution",
        ),
        Error::File(FileError::Read { source, .. })
            if source.kind() == std::io::ErrorKind::NotFound =>
        {
            (
                "files are missing",
                "restore them, or run demc-data index --overwrite",
            )
        }
        _ => ("files cannot be read", "copy or render them again"),
    };
    Finding::new(problem, cause, &scene.name, short(error))
}

/// Constant, swapped, packed, and rotated features.
fn features(name: &str, frame: &Frame, layout: &ChannelLayout) -> Vec<Finding> {
    let pixels = frame.width * frame.height;
    let mut findings = Vec::new();
    let buffers = frame.features.chunks_exact(3 * pixels);
    for (buffer, planes) in layout.features().into_iter().zip(buffers) {
        // A policy replaces a buffer without names, and one of zeros a buffer that the file lacks.
        if buffer.channels.is_some()
            && let Some(color) = constant(planes, pixels)
            && (buffer.missing != Missing::Zeros || color.iter().any(|value| *value != 0.0))
        {
            findings.push(Finding::new(
                &format!("{} is constant", buffer.name),
                "the renderer does not write this buffer; leave it out of the layout or enable it",
                name,
                format!("{color:?}"),
            ));
        }
    }
    let position = &frame.features[POSITIONS * pixels..TEXTURES * pixels];
    let share = unit_share(position, pixels);
    if share > UNIT_SHARE {
        findings.push(Finding::new(
            "position: its vectors have length 1",
            "is it swapped with the normal?",
            name,
            format!("at {:.0} % of the pixels", 100.0 * share),
        ));
    }
    findings.extend(geometry::warnings(frame).into_iter().map(|warning| {
        let problem = format!("{}: wrong space or buffer", warning.what);
        Finding::new(&problem, warning.cause, name, warning.found)
    }));
    findings
}

/// The value of a constant buffer.
fn constant(planes: &[f32], pixels: usize) -> Option<Vec<f32>> {
    let first = |plane: &[f32]| {
        let value = plane[0];
        plane.iter().all(|sample| *sample == value).then_some(value)
    };
    planes.chunks_exact(pixels).map(first).collect()
}

/// Share of the pixels, without those at the origin, whose vector has length 1.
fn unit_share(planes: &[f32], pixels: usize) -> f64 {
    let length = |i: usize| {
        let squares = (0..3).map(|channel| planes[channel * pixels + i].powi(2));
        squares.sum::<f32>().sqrt()
    };
    let hits: Vec<f32> = (0..pixels).map(length).filter(|l| *l > 0.0).collect();
    let unit = hits.iter().filter(|l| (**l - 1.0).abs() < UNIT_TOLERANCE);
    unit.count() as f64 / hits.len().max(1) as f64
}
