//! Flags and scoring shared by the commands that score a data set.

use std::path::{Path, PathBuf};

use clap::{Args, ValueEnum};
use demc_data::image::exr::ExrFile;
use demc_data::{ChannelLayout, Dataset, Frame, Scene};
use demc_program::exit::UsageError;
use demc_program::message::printable;
use demc_program::output::Outputs;

use super::clamped::Clamped;
use super::exposure::InputScaleFlag;
use super::filter::Filter;
use super::flags::{DeviceFlag, EnsembleFlag, LightFlag, ModelFlag};
use super::layouts::{LayoutFlags, Layouts};
use super::outputs;
use super::progress::Progress;
use crate::denoise::{DenoiseError, DenoiseOptions, Denoised, unobserved};
use crate::evaluate::FailedImage;
use crate::report::SceneImages;
use crate::{Baseline, BaselineError, Ensemble, ImageScore, Report, baseline};

/// The model, the scenes and the baselines.
#[derive(Args)]
pub struct Scenes {
    #[command(flatten)]
    model: ModelFlag,
    #[command(flatten)]
    layout: LayoutFlags,
    /// Data set: the directory with manifest.json
    #[arg(long, value_name = "DIR")]
    pub data: PathBuf,
    /// Split of the data set
    #[arg(long, value_enum, default_value = "test")]
    pub split: SplitFlag,
    /// Images of the same scenes from another program. DIR has one EXR file per scene, with
    /// channels R, G, B and the scene's file name. Without DIR, NAME is a filter of `denoise`: nfor,
    /// which needs the channels of tools/render --passes paper. The flag can be repeated
    #[arg(long = "baseline", value_name = "NAME=DIR|nfor", value_parser = Compared::parse)]
    baselines: Vec<Compared>,
    #[command(flatten)]
    input_scale: InputScaleFlag,
    #[command(flatten)]
    ensemble: EnsembleFlag,
    #[command(flatten)]
    light: LightFlag,
    #[command(flatten)]
    device: DeviceFlag,
}

#[derive(Clone, Copy, ValueEnum)]
pub enum SplitFlag {
    Train,
    Test,
}

impl From<SplitFlag> for demc_data::Split {
    fn from(split: SplitFlag) -> Self {
        match split {
            SplitFlag::Train => demc_data::Split::Train,
            SplitFlag::Test => demc_data::Split::Test,
        }
    }
}

/// Fails if a scene was not scored.
pub fn require_all(report: &Report) -> anyhow::Result<()> {
    let (failed, scored) = (report.failed.len(), report.images.len());
    let all = failed + scored;
    anyhow::ensure!(failed == 0, "{failed} of {all} scenes were not scored");
    Ok(())
}

impl Scenes {
    /// The model and the number of passes, for a title.
    pub fn model_name(&self) -> String {
        let name = self.model.name();
        match self.ensemble.passes {
            Ensemble::One => name,
            passes => format!("{name}, mean of {} passes", passes.count()),
        }
    }

    /// Checks the command's output before anything is scored.
    ///
    /// # Errors
    /// An output that is an input or cannot be written; no data set.
    pub fn check_output(&self, path: &Path, overwrite: bool) -> anyhow::Result<()> {
        let mut outputs = Outputs::default();
        self.model.protect(&mut outputs);
        self.layout.protect(&mut outputs);
        let scenes = Dataset::protect(&self.data, &mut outputs)?;
        for baseline in self.baselines.iter().filter_map(Compared::images) {
            let what = format!("an image of baseline {}", baseline.name);
            for scene in &scenes {
                outputs.protect(&baseline.path(scene), &what);
            }
        }
        Ok(outputs::check_output(outputs, path, overwrite)?)
    }

    /// Scores every scene of the split in all metrics, with one scene in memory at a time.
    ///
    /// In parallel with the scoring, `process` gets the scene's images and the number of all
    /// scenes. Its result and the scores go to `finish`. A scene that fails is reported and becomes
    /// one of the report's failed images.
    ///
    /// # Errors
    /// An invalid model or data set; missing baseline images; what `finish` returns.
    pub fn score<T: Send>(
        &self,
        process: impl Fn(&SceneImages, usize) -> anyhow::Result<T> + Sync,
        mut finish: impl FnMut(T, &ImageScore) -> anyhow::Result<()>,
    ) -> anyhow::Result<Report> {
        let layouts = self.layout.read()?;
        let bundle = self.model.load_onto(&self.device)?;
        let layout = &layouts.of_dataset(&self.data, &bundle)?;
        let dataset = Dataset::open(&self.data, layout)?;
        let scenes = dataset.split(self.split.into())?;
        self.check_baselines(&scenes).map_err(|error| match error {
            BaselineError::Taken(_) => {
                anyhow::Error::new(UsageError(format!("--baseline {error}")))
            }
            other => other.into(),
        })?;
        let progress = Progress::new(scenes.len());
        let (mut images, mut failed) = (Vec::with_capacity(scenes.len()), Vec::new());
        let mut clamped = Clamped::default();
        let options = DenoiseOptions {
            ensemble: self.ensemble.passes,
            input_scale: self.input_scale.choice.factor(),
            restore_light: self.light.restore_light,
            ..DenoiseOptions::default()
        };
        for scene in &scenes {
            progress.start(&scene.name);
            let denoise = |frame: &Frame| bundle.denoise_with(frame, &options, unobserved);
            let process = |images: &SceneImages| process(images, scenes.len());
            let files = self.read_scene(scene, &layouts, layout, &mut clamped);
            match files.and_then(|files| self.score_scene(scene, &files, denoise, process)) {
                Ok((score, processed)) => {
                    finish(processed, &score)?;
                    images.push(score);
                }
                Err(error) => {
                    progress.line(format_args!("error: {}: {error:#}", scene.name));
                    failed.push(FailedImage {
                        name: scene.name.clone(),
                        error: printable(&format!("{error:#}")),
                    });
                }
            }
            progress.advance();
        }
        progress.finish();
        clamped.report();
        Ok(Report {
            failed,
            ..Report::new(images)
        })
    }

    /// Checks that names are unique and not reserved, and that every image exists.
    fn check_baselines(&self, scenes: &[Scene]) -> Result<(), BaselineError> {
        for (i, baseline) in self.baselines.iter().enumerate() {
            let name = baseline.name();
            if self.baselines[..i].iter().any(|other| other.name() == name) {
                return Err(BaselineError::Taken(name.to_owned()));
            }
        }
        let images = self.baselines.iter().filter_map(Compared::images);
        baseline::check(&images.cloned().collect::<Vec<_>>(), scenes)
    }

    fn score_scene<T: Send>(
        &self,
        scene: &Scene,
        files: &SceneFiles,
        denoise: impl Fn(&Frame) -> Result<Denoised, DenoiseError>,
        process: impl Fn(&SceneImages) -> anyhow::Result<T> + Sync,
    ) -> anyhow::Result<(ImageScore, T)> {
        let SceneFiles { frame, baselines } = files;
        let others: Vec<_> = self
            .baselines
            .iter()
            .zip(baselines)
            .map(|(baseline, image)| (baseline.name(), image.as_slice()))
            .collect();
        let denoised = denoise(frame)?.color_hdr;
        let residual = scene.ref_residual_relmse;
        let scene_images = SceneImages {
            frame,
            denoised: &denoised,
            baselines: &others,
        };
        let (score, processed) = rayon::join(
            || ImageScore::full(frame, &denoised, &others, residual),
            || process(&scene_images),
        );
        Ok((score?.with_base(&scene.base), processed?))
    }

    fn read_scene(
        &self,
        scene: &Scene,
        layouts: &Layouts,
        layout: &ChannelLayout,
        clamped: &mut Clamped,
    ) -> anyhow::Result<SceneFiles> {
        let mut frame = demc_data::read_frame(&scene.path, scene.layout(layout))?;
        frame.name.clone_from(&scene.name);
        clamped.count(frame.clamped);
        let mut baselines = Vec::with_capacity(self.baselines.len());
        for baseline in &self.baselines {
            baselines.push(match baseline {
                Compared::Images(baseline) => {
                    let image = baseline.read(scene)?;
                    clamped.count(image.clamped);
                    image.planes
                }
                Compared::Filter(filter) => {
                    let mut file = ExrFile::open(&scene.path)?;
                    let layout = layouts.of_filtered(&file)?;
                    filter.denoise(&mut file, &layout)?
                }
            });
        }
        Ok(SceneFiles { frame, baselines })
    }
}

/// The images of a scene.
struct SceneFiles {
    frame: Frame,
    /// In the order of the command line.
    baselines: Vec<Vec<f32>>,
}

/// `--baseline`: what the model is compared with.
#[derive(Debug, Clone)]
enum Compared {
    /// Images in a directory.
    Images(Baseline),
    /// A filter that runs on each scene.
    Filter(Filter),
}

impl Compared {
    fn parse(text: &str) -> Result<Self, BaselineError> {
        match Filter::from_str(text, false) {
            Ok(filter) => Ok(Self::Filter(filter)),
            Err(_) => text.parse().map(Self::Images),
        }
    }

    fn name(&self) -> &str {
        match self {
            Self::Images(baseline) => &baseline.name,
            Self::Filter(filter) => filter.name(),
        }
    }

    fn images(&self) -> Option<&Baseline> {
        match self {
            Self::Images(baseline) => Some(baseline),
            Self::Filter(_) => None,
        }
    }
}
