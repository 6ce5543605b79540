//! Scores and pictures of whole scenes, for validation and for the test split. It denoises with the
//! code of `demc-infer`, as users do.

use demc_data::{Scene, read_frame};
use demc_infer::Bundle;
use demc_infer::evaluate::{ImageScore, Report};
use demc_infer::picture::Picture;
use demc_model::config::DETAIL_CHANNELS;
use serde::{Deserialize, Serialize};

use crate::ranks::Reduce;

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

/// The result of one scene.
#[derive(Debug, Serialize, Deserialize)]
struct SceneResult {
    score: ImageScore,
    /// Zeros in each channel of the detail map; `None` for a network without one.
    dark: Option<Vec<usize>>,
    pixels: usize,
    /// Output values of 0 where the reference is not black, and such reference values.
    zeros: usize,
    bright: usize,
    picture: Option<Picture>,
}

/// Denoises and scores `scenes`, one at a time, and draws the first `strips` of them. The processes of
/// `reduce` deal them out; each gets the whole result.
///
/// # Errors
/// A scene that cannot be read or has no reference.
pub fn score(
    bundle: &Bundle,
    scenes: &[Scene],
    strips: usize,
    reduce: &Reduce,
) -> anyhow::Result<Validation> {
    let results = reduce.deal(scenes, |index, scene| {
        score_scene(bundle, scene, index < strips)
    })?;
    Ok(whole(results))
}

fn score_scene(bundle: &Bundle, scene: &Scene, draws: bool) -> anyhow::Result<SceneResult> {
    let frame = read_frame(&scene.path, scene.layout(&bundle.meta.layout))?;
    let denoised = bundle.denoise(&frame)?;
    let (mut zeros, mut bright) = (0, 0);
    for (out, reference) in denoised.iter().zip(frame.reference.iter().flatten()) {
        bright += usize::from(*reference > NOT_BLACK);
        zeros += usize::from(*reference > NOT_BLACK && *out == 0.0);
    }
    let detail_map = bundle.detail_map(&frame)?;
    let dark = detail_map.as_ref().map(|map| {
        let channels = map.chunks_exact(map.len() / DETAIL_CHANNELS);
        let dark = channels.map(|channel| channel.iter().filter(|value| **value == 0.0).count());
        dark.collect()
    });
    Ok(SceneResult {
        score: ImageScore {
            name: scene.name.clone(),
            base: Some(scene.base.clone()),
            ..ImageScore::new(&frame, &denoised, scene.ref_residual_relmse)?
        },
        dark,
        pixels: frame.width * frame.height,
        zeros,
        bright,
        picture: draws.then(|| Picture::strip(&frame, detail_map.as_deref(), &denoised)),
    })
}

/// The validation of these scenes.
fn whole(mut scenes: Vec<SceneResult>) -> Validation {
    let pictures: Vec<Picture> = scenes
        .iter_mut()
        .filter_map(|scene| scene.picture.take())
        .collect();
    let sum = |of: fn(&SceneResult) -> usize| scenes.iter().map(of).sum::<usize>();
    let limit = DEAD * sum(|scene| scene.pixels) as f64;
    let is_dead = |channel: &usize| {
        let dark = scenes.iter().filter_map(|scene| scene.dark.as_ref());
        dark.map(|dark| dark[*channel]).sum::<usize>() as f64 >= limit
    };
    let has_map = scenes.iter().any(|scene| scene.dark.is_some());
    let health = NetworkHealth {
        dead_channels: has_map.then(|| (0..DETAIL_CHANNELS).filter(is_dead).count()),
        zero_share: sum(|scene| scene.zeros) as f64 / sum(|scene| scene.bright).max(1) as f64,
    };
    Validation {
        picture: (!pictures.is_empty()).then(|| Picture::above(&pictures)),
        report: Report::new(scenes.into_iter().map(|scene| scene.score).collect()),
        health,
    }
}
