//! What the commands that score a data set have in common: their flags, and the walk over the scenes.

use std::path::PathBuf;

use clap::{Args, ValueEnum};
use demc_data::{Dataset, Rgb, Scene};
use demc_infer::report::Views;
use demc_infer::{Baseline, BaselineError, Ensemble, ImageScore, Report, Tiling, baseline};

use super::{Clamped, DeviceFlag, EnsembleFlag, Model, Usage};
use crate::progress::Progress;

/// Which model, which scenes, and what to compare with.
#[derive(Args)]
pub struct Scenes {
    #[command(flatten)]
    model: Model,
    /// Data set: the directory with manifest.json
    #[arg(long, value_name = "DIR")]
    pub data: PathBuf,
    /// Which scenes
    #[arg(long, value_enum, default_value = "test")]
    pub split: Split,
    /// Other images of the same scenes: DIR holds an EXR with channels R, G, B for each scene, with the scene's file
    /// name. Can be given several times
    #[arg(long = "baseline", value_name = "NAME=DIR")]
    baselines: Vec<Baseline>,
    #[command(flatten)]
    ensemble: EnsembleFlag,
    #[command(flatten)]
    device: DeviceFlag,
}

/// A part of a data set.
#[derive(Clone, Copy, ValueEnum)]
pub enum Split {
    Train,
    Test,
}

impl From<Split> for demc_data::Split {
    fn from(split: Split) -> Self {
        match split {
            Split::Train => demc_data::Split::Train,
            Split::Test => demc_data::Split::Test,
        }
    }
}

impl Scenes {
    /// What computes the denoised images, for a title.
    pub fn model_name(&self) -> String {
        let path = self.model.path.as_ref();
        let name = path.map_or(super::OWN_MODEL_NAME.into(), |path| {
            path.display().to_string()
        });
        match self.ensemble.looks {
            Ensemble::One => name,
            looks => format!("{name}, mean of {} looks", looks.count()),
        }
    }

    /// Scores every scene of the split in all metrics, one in memory at a time. `beside` sees its images and the number of all
    /// scenes while they are scored, and `each` gets what that made. The first that fails ends it: a mean over fewer would mislead.
    pub fn score<T: Send>(
        &self,
        beside: impl Fn(&Views, usize) -> anyhow::Result<T> + Sync,
        mut each: impl FnMut(T, &ImageScore) -> anyhow::Result<()>,
    ) -> anyhow::Result<Report> {
        let bundle = self.model.load_onto(&self.device)?;
        let layout = &bundle.meta.layout;
        let dataset = Dataset::open(&self.data, layout)?;
        let scenes = dataset.split(self.split.into())?;
        baseline::check(&self.baselines, &scenes).map_err(|error| match error {
            BaselineError::Taken(_) => anyhow::Error::new(Usage(format!("--baseline {error}"))),
            other => other.into(),
        })?;
        let progress = Progress::new(scenes.len());
        let mut images = Vec::with_capacity(scenes.len());
        let mut clamped = Clamped::default();
        for scene in &scenes {
            progress.start(&scene.name);
            let mut frame = demc_data::read_frame(&scene.path, layout)?;
            frame.name.clone_from(&scene.name);
            clamped.count(frame.clamped);
            let others = self.read_baselines(scene, &mut clamped)?;
            let others: Vec<_> = self
                .baselines
                .iter()
                .zip(&others)
                .map(|(baseline, image)| (baseline.name.as_str(), image.planes.as_slice()))
                .collect();
            let tiling = Tiling::default();
            let denoised = bundle.denoise_tiled(&frame, &tiling, self.ensemble.looks, |_, _| ())?;
            let denoised = denoised.color_hdr;
            let residual = scene.ref_residual_relmse;
            let views = Views {
                frame: &frame,
                denoised: &denoised,
                baselines: &others,
            };
            let (score, made) = rayon::join(
                || ImageScore::full(&frame, &denoised, &others, residual),
                || beside(&views, scenes.len()),
            );
            let score = score?;
            each(made?, &score)?;
            images.push(score);
            progress.advance();
        }
        progress.finish();
        clamped.report();
        Ok(Report::new(images))
    }

    fn read_baselines(&self, scene: &Scene, clamped: &mut Clamped) -> anyhow::Result<Vec<Rgb>> {
        let mut images = Vec::with_capacity(self.baselines.len());
        for baseline in &self.baselines {
            let image = baseline.read(scene)?;
            clamped.count(image.clamped);
            images.push(image);
        }
        Ok(images)
    }
}
