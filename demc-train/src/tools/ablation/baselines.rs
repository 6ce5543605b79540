//! Methods without training that are scored beside the variants: the noisy image, NFOR, and images of
//! other programs.

use std::collections::BTreeMap;

use anyhow::Context;
use demc_data::image::exr::ExrFile;
use demc_data::{ChannelLayout, Dataset, Frame, Scene, Split, read_frame};
use demc_infer::baseline;
use demc_infer::evaluate::ImageScore;
use demc_infer::nfor;
use demc_program::checksum::{sha256, sha256_of};

use super::results::{self, ImageValue, RESULTS, ScoredRun};
use super::spec::{AblationSpec, Baseline};
use super::{DataFiles, data_key, values_of};
use crate::config::HASH_DIGITS;
use crate::record::progress::say;

/// The value of `images` that stands for the noisy image.
const NOISY: &str = "noisy";
/// The value of `images` that stands for NFOR.
const NFOR: &str = "nfor";

/// The scores of all baselines, once for each seed. Those in `results.csv` are taken from there if data
/// and images are the same; others are computed and added to it. A missing directory is left out, with
/// a note.
///
/// # Errors
/// A scene or an image that cannot be read; a file that cannot be written.
pub(super) fn scored(spec: &AblationSpec, files: &DataFiles) -> anyhow::Result<Vec<ScoredRun>> {
    let mut found = Vec::new();
    if spec.baselines.is_empty() {
        return Ok(found);
    }
    let data = &spec.variants[0].config.data;
    let layout = ChannelLayout::resolve(&data.layout)?;
    let scenes = Dataset::open(&data.root, &layout)?.split(Split::Test)?;
    let path = spec.dir.join(RESULTS);
    let mut stored = results::read(&path)?;
    for baseline in &spec.baselines {
        let images = Images::new(baseline);
        if !images.exists() {
            let Baseline { name, images } = baseline;
            say(format!(
                "note: {name} is left out: there is no directory {images}"
            ));
            continue;
        }
        let hash = images.hash(&scenes, &files[&data_key(data)].checksums)?;
        let is_own = |run: &ScoredRun| run.variant == baseline.name;
        let is_same = |run: &&ScoredRun| is_own(run) && run.configuration == hash;
        let scores = match stored.iter().find(is_same) {
            Some(run) => run.scores.clone(),
            None => {
                say(format!(
                    "\n== {}: {} test images",
                    baseline.name,
                    scenes.len()
                ));
                let all = scenes.iter().map(|scene| images.score(scene, &layout));
                all.collect::<anyhow::Result<Vec<_>>>()
                    .with_context(|| baseline.name.clone())?
                    .concat()
            }
        };
        stored.retain(|run| !is_own(run));
        let runs = spec.seeds.iter().map(|seed| ScoredRun {
            variant: baseline.name.clone(),
            seed: *seed,
            configuration: hash.clone(),
            weights: String::new(),
            steps: 0,
            minutes: 0.0,
            width: 0,
            parameters: 0,
            flops_per_pixel: 0.0,
            settings: String::new(),
            scores: scores.clone(),
        });
        found.extend(runs);
    }
    let all = [stored.as_slice(), &found].concat();
    results::write(&path, &all)?;
    Ok(found)
}

/// Where the images of a baseline come from.
pub(super) enum Images {
    Noisy,
    Nfor,
    Directory(baseline::Baseline),
}

impl Images {
    pub(super) fn new(baseline: &Baseline) -> Self {
        match baseline.images.as_str() {
            NOISY => Self::Noisy,
            NFOR => Self::Nfor,
            dir => Self::Directory(baseline::Baseline {
                name: baseline.name.clone(),
                dir: dir.into(),
            }),
        }
    }

    /// The first digits of the SHA-256 of what the scores depend on.
    fn hash(
        &self,
        scenes: &[Scene],
        checksums: &BTreeMap<String, String>,
    ) -> anyhow::Result<String> {
        let mut text = match self {
            Self::Noisy => NOISY.to_owned(),
            Self::Nfor => NFOR.to_owned(),
            Self::Directory(_) => String::new(),
        };
        for scene in scenes {
            let own = checksums.get(&scene.name).map_or("", String::as_str);
            text += &format!("\n{own}");
            if let Self::Directory(directory) = self {
                text += &sha256_of(&directory.path(scene))?;
            }
        }
        let mut digits = sha256([text.as_bytes()]);
        digits.truncate(HASH_DIGITS);
        Ok(digits)
    }

    /// False for a directory that is missing.
    pub(super) fn exists(&self) -> bool {
        match self {
            Self::Noisy | Self::Nfor => true,
            Self::Directory(directory) => directory.dir.exists(),
        }
    }

    /// The image of a scene, `[3, H, W]`.
    pub(super) fn image(
        &self,
        scene: &Scene,
        frame: &Frame,
        layout: &ChannelLayout,
    ) -> anyhow::Result<Vec<f32>> {
        Ok(match self {
            Self::Noisy => frame.color.clone(),
            Self::Nfor => {
                nfor::Buffers::read(&mut ExrFile::open(&scene.path)?, layout)?.denoise()?
            }
            Self::Directory(directory) => directory.read(scene)?.planes,
        })
    }

    fn score(&self, scene: &Scene, layout: &ChannelLayout) -> anyhow::Result<Vec<ImageValue>> {
        let layout = scene.layout(layout);
        let frame = read_frame(&scene.path, layout)?;
        let image = self.image(scene, &frame, layout)?;
        let score = ImageScore {
            name: scene.name.clone(),
            base: Some(scene.base.clone()),
            ..ImageScore::new(&frame, &image, scene.ref_residual_relmse)?
        };
        Ok(values_of(&score).collect())
    }
}
