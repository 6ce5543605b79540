//! `demc-infer evaluate`: a table of scores over a data set's split.

use std::path::{Path, PathBuf};

use clap::{Args, ValueEnum};
use demc_data::Dataset;
use demc_infer::{Report, evaluate};

use super::{Clamped, DeviceFlag, Model};
use crate::progress::Progress;

/// Score a model on images with references: RelMSE and SSIM of the noisy, a black and the denoised image.
///
/// Prints a table; the last row is the mean over images. A score near the reference's own residual means nothing,
/// and neither does being better than the noisy image: compare with the black one.
#[derive(Args)]
#[command(after_help = "Examples:
  demc-infer evaluate --model runs/quickstart --data data/sample
  demc-infer evaluate --model runs/quickstart --data data/sample --json - | jq .mean")]
pub struct Evaluate {
    #[command(flatten)]
    model: Model,
    /// Data set: the directory with manifest.json
    #[arg(long, value_name = "DIR")]
    data: PathBuf,
    /// Which scenes
    #[arg(long, value_enum, default_value = "test")]
    split: Split,
    /// Write the scores as JSON to FILE; `-` for stdout, in place of the table
    #[arg(long, value_name = "FILE")]
    json: Option<PathBuf>,
    #[command(flatten)]
    device: DeviceFlag,
}

#[derive(Clone, Copy, ValueEnum)]
enum Split {
    Train,
    Test,
}

impl Evaluate {
    /// Scores every scene of the split. The first that fails ends it: a mean over fewer would mislead.
    pub fn run(self) -> anyhow::Result<()> {
        let bundle = self.model.load_onto(&self.device)?;
        let layout = &bundle.meta.layout;
        let dataset = Dataset::open(&self.data, layout)?;
        let scenes = dataset.split(match self.split {
            Split::Train => demc_data::Split::Train,
            Split::Test => demc_data::Split::Test,
        })?;
        let progress = Progress::new(scenes.len());
        let mut images = Vec::with_capacity(scenes.len());
        let mut clamped = Clamped::default();
        for scene in scenes {
            progress.start(&scene.name);
            let mut frame = demc_data::read_frame(&scene.path, layout)?;
            frame.name.clone_from(&scene.name);
            clamped.count(frame.clamped);
            images.push(evaluate::score(&bundle, &frame, scene.ref_residual_relmse)?);
            progress.advance();
        }
        progress.finish();
        clamped.report();
        let report = Report::new(images);
        // The table first: it is not lost where the file cannot be written.
        if self.json.as_deref() != Some(Path::new("-")) {
            super::print(&report.to_string())?;
        }
        match &self.json {
            Some(path) => super::write_text(path, &serde_json::to_string_pretty(&report)?),
            None => Ok(()),
        }
    }
}
