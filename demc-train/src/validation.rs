//! Scores and pictures of whole scenes, by the code that ships: validation during a run, the test split at its end.

use std::path::Path;

use anyhow::Context;
use demc_data::{Scene, read_frame};
use demc_infer::Bundle;
use demc_infer::evaluate::{ImageScore, Report};
use demc_infer::picture::Picture;

/// Scenes on a validation's picture; ours: the first ones, always the same.
pub const STRIP_SCENES: usize = 3;

/// Denoises and scores `scenes`, one in memory at a time, and draws the first `strips` of them.
///
/// # Errors
/// A scene that cannot be read or has no reference.
pub fn score(
    bundle: &Bundle,
    scenes: &[Scene],
    strips: usize,
) -> anyhow::Result<(Report, Option<Picture>)> {
    let mut scores = Vec::with_capacity(scenes.len());
    let mut rows = Vec::new();
    for (index, scene) in scenes.iter().enumerate() {
        let frame = read_frame(&scene.path, &bundle.meta.layout)?;
        let denoised = bundle.denoise(&frame)?;
        scores.push(ImageScore {
            name: scene.name.clone(),
            ..ImageScore::new(&frame, &denoised, scene.ref_residual_relmse)?
        });
        if index < strips {
            let detail_map = bundle.detail_map(&frame)?;
            rows.push(Picture::strip(&frame, detail_map.as_deref(), &denoised));
        }
    }
    let picture = (!rows.is_empty()).then(|| Picture::above(&rows));
    Ok((Report::new(scores), picture))
}

/// Writes a picture into the run directory.
///
/// # Errors
/// A file that cannot be written.
pub fn write_strip(run: &Path, name: &str, picture: &Picture) -> anyhow::Result<()> {
    let dir = run.join("strips");
    std::fs::create_dir_all(&dir).with_context(|| dir.display().to_string())?;
    Ok(picture.write_png(&dir.join(name))?)
}
