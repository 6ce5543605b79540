//! `demc-infer check`: whether images are what a model was trained on.

use std::path::PathBuf;

use clap::Args;
use demc_data::Summary;
use demc_data::frame::{FEATURE_NAMES, read_input};
use demc_data::ranges::Range;
use demc_infer::Bundle;
use serde::Serialize;

use super::inputs::{Frames, Inputs};
use super::{Clamped, DeviceFlag, Model, print};

/// Whether images are like those that a model was trained on: every channel beside the training scenes, and warnings.
///
/// The same warnings come with `denoise`. Exit code 1: there was one.
#[derive(Args)]
#[command(after_help = "Examples:
  demc-infer check noisy.exr
  demc-infer check --model runs/demc --json renders/ | jq '.[].warnings'")]
pub struct Check {
    #[command(flatten)]
    model: Model,
    /// Images: files, directories, patterns, frame sequences
    #[arg(value_name = "IN.exr", required = true)]
    inputs: Vec<PathBuf>,
    /// Of sequences, only these frames
    #[arg(long, value_name = "FIRST-LAST")]
    frames: Option<Frames>,
    /// Print JSON
    #[arg(long)]
    json: bool,
    #[command(flatten)]
    device: DeviceFlag,
}

#[derive(Serialize)]
struct Checked {
    file: PathBuf,
    exposure: Row,
    channels: Vec<Channel>,
    warnings: Vec<String>,
}

/// A number of the image, and the range of the training scenes where the model has it.
#[derive(Serialize)]
struct Row {
    value: f64,
    training: Option<Range>,
}

#[derive(Serialize)]
struct Channel {
    channel: &'static str,
    mean: Row,
    std: Row,
}

impl Check {
    /// Checks every image; the first that cannot be read ends it.
    pub fn run(self) -> anyhow::Result<()> {
        let inputs = Inputs::expand(&self.inputs, self.frames)?;
        let bundle = self.model.load_onto(&self.device)?;
        let mut all = Vec::with_capacity(inputs.files.len());
        let mut clamped = Clamped::default();
        for path in inputs.files {
            let (checked, negative) = Checked::new(path, &bundle)?;
            clamped.count(negative);
            if !self.json {
                print(&checked.text())?;
            }
            all.push(checked);
        }
        if self.json {
            print(&serde_json::to_string_pretty(&all)?)?;
        }
        clamped.report();
        let warned = all.iter().filter(|checked| !checked.warnings.is_empty());
        match warned.count() {
            0 => Ok(()),
            warned => anyhow::bail!("{warned} of {} images with warnings", all.len()),
        }
    }
}

impl Checked {
    /// The check of one file, and how many of its samples were negative.
    fn new(file: PathBuf, bundle: &Bundle) -> anyhow::Result<(Self, usize)> {
        let frame = read_input(&file, &bundle.meta.layout)?;
        let Summary {
            exposure,
            mean,
            std,
        } = Summary::of(&frame);
        let ranges = bundle.meta.ranges.as_ref();
        let row = |value, training: Option<Range>| Row { value, training };
        let channels = FEATURE_NAMES
            .iter()
            .enumerate()
            .map(|(i, channel)| Channel {
                channel,
                mean: row(mean[i], ranges.map(|ranges| ranges.mean[i])),
                std: row(std[i], ranges.map(|ranges| ranges.std[i])),
            });
        let mut warnings: Vec<String> = bundle
            .warnings(&frame)?
            .into_iter()
            .map(|warning| warning.to_string())
            .collect();
        if let Err(refused) = bundle.check_statistics(&frame) {
            warnings.push(format!("denoise refuses it: {refused}"));
        }
        let checked = Self {
            file,
            exposure: row(exposure, ranges.map(|ranges| ranges.exposure)),
            channels: channels.collect(),
            warnings,
        };
        Ok((checked, frame.clamped))
    }

    fn text(&self) -> String {
        let range = |row: &Row| match row.training {
            Some(Range { low, high }) => format!("{low:.3} to {high:.3}"),
            None => "unknown".into(),
        };
        let mut lines = vec![
            self.file.display().to_string(),
            format!(
                "| {:<10} | {:>9} | {:>20} | {:>9} | {:>20} |",
                "channel", "mean", "training scenes", "deviation", "training scenes"
            ),
            format!(
                "| {0:-<10} | {0:->8}: | {0:->19}: | {0:->8}: | {0:->19}: |",
                "-"
            ),
            format!(
                "| {:<10} | {:>9.3} | {:>20} | {:>9} | {:>20} |",
                "exposure",
                self.exposure.value,
                range(&self.exposure),
                "",
                ""
            ),
        ];
        lines.extend(self.channels.iter().map(|Channel { channel, mean, std }| {
            format!(
                "| {channel:<10} | {:>9.3} | {:>20} | {:>9.3} | {:>20} |",
                mean.value,
                range(mean),
                std.value,
                range(std)
            )
        }));
        lines.extend(
            self.warnings
                .iter()
                .map(|warning| format!("warning: {warning}")),
        );
        lines.join("\n") + "\n"
    }
}
