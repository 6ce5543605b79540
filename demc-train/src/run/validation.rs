//! Scores and pictures of whole scenes, for validation and for the test split. It denoises with the
//! code of `demc-infer`, as users do.

use std::path::Path;

use anyhow::Context;
use demc_data::{Scene, read_frame};
use demc_infer::Bundle;
use demc_infer::evaluate::{ImageScore, Report};
use demc_infer::picture::Picture;
use demc_model::config::DETAIL_CHANNELS;
use serde::{Deserialize, Serialize};

/// Number of scenes in the picture of a validation: always the first ones. Ours.
pub const STRIP_SCENES: usize = 3;

/// References above this value are not black, linear HDR; ours.
const NOT_BLACK: f32 = 0.01;

/// A channel of the detail map is dead if it is zero at this share of the pixels. Ours: the rest
/// lies at edges and describes no surface.
const DEAD: f64 = 0.95;

/// The result of a validation.
pub struct Validation {
    /// The scores.
    pub report: Report,
    /// Signs of a network with too little capacity in use.
    pub health: NetworkHealth,
    /// Picture of the first scenes, if any were requested.
    pub picture: Option<Picture>,
}

/// Signs of a network with too little capacity in use.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct NetworkHealth {
    /// Channels of the detail map that are zero at 95 % or more of the pixels; `None` for a network
    /// without one.
    pub dead_channels: Option<usize>,
    /// Share of zeros in the output where the reference is above 0.01.
    pub zero_share: f64,
}

/// Denoises and scores `scenes`, one at a time, and draws the first `strips` of them.
///
/// # Errors
/// A scene that cannot be read or has no reference.
pub fn score(bundle: &Bundle, scenes: &[Scene], strips: usize) -> anyhow::Result<Validation> {
    let mut scores = Vec::with_capacity(scenes.len());
    let mut rows = Vec::new();
    let (mut dark, mut pixels) = ([0; DETAIL_CHANNELS], 0);
    let (mut zeros, mut bright) = (0usize, 0usize);
    for (index, scene) in scenes.iter().enumerate() {
        let frame = read_frame(&scene.path, &bundle.meta.layout)?;
        let denoised = bundle.denoise(&frame)?;
        scores.push(ImageScore {
            name: scene.name.clone(),
            ..ImageScore::new(&frame, &denoised, scene.ref_residual_relmse)?
        });
        for (out, reference) in denoised.iter().zip(frame.reference.iter().flatten()) {
            bright += usize::from(*reference > NOT_BLACK);
            zeros += usize::from(*reference > NOT_BLACK && *out == 0.0);
        }
        let detail_map = bundle.detail_map(&frame)?;
        if let Some(map) = &detail_map {
            let channels = map.chunks_exact(map.len() / DETAIL_CHANNELS);
            for (dark, channel) in dark.iter_mut().zip(channels) {
                *dark += channel.iter().filter(|value| **value == 0.0).count();
            }
            pixels += frame.width * frame.height;
        }
        if index < strips {
            rows.push(Picture::strip(&frame, detail_map.as_deref(), &denoised));
        }
    }
    let picture = (!rows.is_empty()).then(|| Picture::above(&rows));
    let has_map = bundle.meta.model.variant.spec().has_fusion();
    let health = NetworkHealth {
        dead_channels: has_map.then(|| {
            let limit = DEAD * pixels as f64;
            dark.iter().filter(|dark| **dark as f64 >= limit).count()
        }),
        zero_share: zeros as f64 / bright.max(1) as f64,
    };
    Ok(Validation {
        report: Report::new(scores),
        health,
        picture,
    })
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
