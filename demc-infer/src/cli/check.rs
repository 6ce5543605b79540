//! `demc-infer check`: compares images with a model's training data.

use std::path::{Path, PathBuf};

use clap::Args;
use demc_data::check::noise::{CORRELATED, correlation};
use demc_data::image::exr::ExrFile;
use demc_data::image::frame::MAX_ALBEDO;
use demc_data::image::frame::{FEATURE_NAMES, TEXTURES, decode_input};
use demc_data::input::ranges::Range;
use demc_data::{Frame, FrameSummary};
use demc_program::message::{self, printable};
use serde::Serialize;

use super::clamped::Clamped;
use super::flags::{DeviceFlag, ModelFlag};
use super::frames::Frames;
use super::inputs::Inputs;
use super::layouts::{LayoutFlags, Layouts, say};
use super::outputs::utf8_for_json;
use crate::Bundle;

/// Compare images with a model's training data: statistics of each channel, and warnings.
///
/// `denoise` prints the same warnings. The exit code is 1 if an image has a warning or
/// cannot be read. JSON then has its error. Notes do not change the exit code.
#[derive(Args)]
#[command(after_help = "Examples:
  demc-infer check noisy.exr
  demc-infer check --model runs/demc --json renders/ | jq '.[].warnings'")]
pub struct Arguments {
    #[command(flatten)]
    model: ModelFlag,
    #[command(flatten)]
    layout: LayoutFlags,
    /// Images: files, directories, glob patterns, or frame sequences
    #[arg(value_name = "IN.exr", required = true)]
    inputs: Vec<PathBuf>,
    /// Only these frames of sequences, such as 7, 1-240, or 1-10,15,20-40x2 (every second one)
    #[arg(long, value_name = "LIST")]
    frames: Option<Frames>,
    /// Print JSON
    #[arg(long)]
    json: bool,
    #[command(flatten)]
    device: DeviceFlag,
}

/// An element of the JSON array.
#[derive(Serialize)]
#[serde(untagged)]
enum Checked {
    Image(FileCheck),
    Failed { file: String, error: String },
}

#[derive(Serialize)]
struct FileCheck {
    file: String,
    exposure: CheckedValue,
    input_scale: f32,
    channels: Vec<ChannelCheck>,
    warnings: Vec<String>,
    /// What is normal for a renderer.
    notes: Vec<String>,
}

/// A value of the image, and its range over the training scenes if the model has it.
#[derive(Serialize)]
struct CheckedValue {
    value: f64,
    training: Option<Range>,
}

#[derive(Serialize)]
struct ChannelCheck {
    channel: &'static str,
    mean: CheckedValue,
    std: CheckedValue,
}

impl Arguments {
    /// Checks every image. Unreadable ones are reported.
    pub fn run(self) -> anyhow::Result<()> {
        let inputs = Inputs::expand(&self.inputs, self.frames.as_ref())?;
        if self.json {
            inputs
                .files
                .iter()
                .try_for_each(|file| utf8_for_json(file))?;
        }
        let incomplete = inputs.report_missing();
        let layouts = self.layout.read()?;
        let bundle = self.model.load_onto(&self.device)?;
        let mut all = Vec::with_capacity(inputs.files.len());
        let mut clamped = Clamped::default();
        let (mut warned, mut failed) = (0, 0);
        for path in &inputs.files {
            all.push(match FileCheck::new(path, &bundle, &layouts) {
                Ok((checked, negative)) => {
                    clamped.count(negative);
                    warned += usize::from(!checked.warnings.is_empty());
                    if !self.json {
                        message::result(&checked.text())?;
                    }
                    Checked::Image(checked)
                }
                Err(error) => {
                    failed += 1;
                    message::say(format_args!("error: {error:#}"));
                    Checked::Failed {
                        file: path.display().to_string(),
                        error: format!("{error:#}"),
                    }
                }
            });
        }
        if self.json {
            message::result(&message::json(&all)?)?;
        }
        clamped.report();
        let images = all.len();
        let counts = [
            (
                failed,
                format!("{failed} of {images} images were not checked"),
            ),
            (warned, format!("{warned} of {images} images have warnings")),
            (incomplete, format!("{incomplete} input(s) lack images")),
        ];
        let problems: Vec<String> = counts
            .into_iter()
            .filter(|(count, _)| *count > 0)
            .map(|(_, problem)| problem)
            .collect();
        anyhow::ensure!(problems.is_empty(), "{}", problems.join("; "));
        Ok(())
    }
}

impl FileCheck {
    /// Checks one file. Also returns its number of negative samples.
    fn new(path: &Path, bundle: &Bundle, layouts: &Layouts) -> anyhow::Result<(Self, usize)> {
        let mut file = ExrFile::open(path)?;
        let layout = layouts.of(&file, bundle, say)?;
        let mut frame = decode_input(&mut file, &layout)?;
        frame.name = path.display().to_string();
        let FrameSummary {
            exposure,
            mean,
            std,
        } = FrameSummary::of(&frame);
        let ranges = bundle.meta.ranges.as_ref();
        let row = |value, training: Option<Range>| CheckedValue { value, training };
        let channels = FEATURE_NAMES
            .iter()
            .enumerate()
            .map(|(i, channel)| ChannelCheck {
                channel,
                mean: row(mean[i], ranges.map(|ranges| ranges.mean[i])),
                std: row(std[i], ranges.map(|ranges| ranges.std[i])),
            });
        let mut warnings: Vec<String> = bundle
            .warnings(&frame)?
            .into_iter()
            .map(|warning| warning.to_string())
            .collect();
        warnings.extend(correlated_noise(&frame));
        if let Err(refused) = bundle.check_statistics(&frame) {
            warnings.push(format!("`denoise` refuses this image: {refused}"));
        }
        let checked = Self {
            file: path.display().to_string(),
            exposure: row(exposure, ranges.map(|ranges| ranges.exposure)),
            input_scale: bundle.input_scale(exposure),
            channels: channels.collect(),
            warnings,
            notes: bright_albedo(&frame).into_iter().collect(),
        };
        Ok((checked, frame.clamped))
    }

    fn text(&self) -> String {
        let range = |row: &CheckedValue| match row.training {
            Some(Range { low, high }) => format!("{low:.3} to {high:.3}"),
            None => "unknown".into(),
        };
        let mut lines = vec![
            printable(&self.file),
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
            format!(
                "| {:<10} | {:>9.3} | {:>20} | {:>9} | {:>20} |",
                "factor", self.input_scale, "", "", ""
            ),
        ];
        lines.extend(
            self.channels
                .iter()
                .map(|ChannelCheck { channel, mean, std }| {
                    format!(
                        "| {channel:<10} | {:>9.3} | {:>20} | {:>9.3} | {:>20} |",
                        mean.value,
                        range(mean),
                        std.value,
                        range(std)
                    )
                }),
        );
        for (kind, found) in [("warning", &self.warnings), ("note", &self.notes)] {
            lines.extend(
                found
                    .iter()
                    .map(|text| format!("{kind}: {}", printable(text))),
            );
        }
        lines.join("\n") + "\n"
    }
}

/// A note about albedo above [`MAX_ALBEDO`]: renderers write it where a lamp is seen in metal.
fn bright_albedo(frame: &Frame) -> Option<String> {
    let pixels = frame.width * frame.height;
    let above = |value: &&f32| **value > MAX_ALBEDO;
    let textures = frame.features[TEXTURES * pixels..].iter();
    let bright = textures.clone().filter(above).count();
    let largest = textures.fold(0.0, |largest: f32, value| largest.max(*value));
    (bright > 0).then(|| {
        format!(
            "albedo: {bright} samples are above {MAX_ALBEDO}, up to {largest:.1}, and count as {MAX_ALBEDO}"
        )
    })
}

/// A warning about noise of neighbouring pixels that correlates.
fn correlated_noise(frame: &Frame) -> Option<String> {
    let found = correlation(&frame.color, frame.width, frame.height)?;
    (found >= CORRELATED).then(|| {
        format!(
            "noise: that of neighbouring pixels correlates by {found:.2}; set the renderer's pixel filter to box, \
             one pixel wide"
        )
    })
}
