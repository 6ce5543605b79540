//! Looks for mistakes in a data set that training would not report: it only gets worse.
//!
//! [`examine`] reads every scene once. [`scene`](self) checks a file and its features, `reference`
//! compares noisy image and reference, `passes` checks half buffers, variances, and parts, `set` compares scenes with each other. All limits were set on
//! the 108 scenes of the training and test renders, none of which has a finding.

mod alignment;
mod details;
mod finding;
mod passes;
mod reference;
mod scene;
mod set;

use std::path::Path;

use demc_program::parallel;

use crate::dataset::{Dataset, preset_of};
use crate::error::Error;
use crate::image::layout::ChannelLayout;
use finding::{Finding, grouped};

pub use finding::{Affected, Problem, Report};

/// Examines the data set at `root`. Without a `layout` (a preset or a TOML file), the preset that
/// fits the first readable file is used, or `demc-exr` if none fits.
///
/// `patch_size` is that of training in pixels.
///
/// # Errors
/// [`Error::File`] without a manifest, [`Error::Dataset`] if it is malformed or lists no scenes,
/// [`Error::Layout`] for an unusable layout. Problems with files are findings, not errors.
pub fn examine(root: &Path, layout: Option<&str>, patch_size: usize) -> Result<Report, Error> {
    let scenes = Dataset::list(root)?;
    if scenes.is_empty() {
        return Err(Error::Dataset {
            root: root.to_owned(),
            problems: vec!["manifest.json lists no scenes".to_owned()],
        });
    }
    let name = layout.unwrap_or_else(|| preset_of(&scenes));
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
