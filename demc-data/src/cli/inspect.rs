//! `demc-data inspect`.

use std::fmt::Write;
use std::path::{Path, PathBuf};

use anyhow::Result;
use clap::Args;
use demc_program::exit;
use demc_program::message::{self, printable};
use serde::Serialize;

use super::number::number;
use crate::image::channel::{Channel, ChannelType};
use crate::image::exr::ExrFile;
use crate::image::layout::{MissingPolicies, detect};
use crate::image::plane::Plane;

#[derive(Args)]
#[command(after_help = "Example:\n  demc-data inspect data/sample/train/*.exr")]
pub struct Arguments {
    /// OpenEXR files: half, float or uint channels, one part or several, scan lines or tiles
    #[arg(required = true, value_name = "FILE")]
    files: Vec<PathBuf>,
    /// Print one JSON array instead of tables
    #[arg(long)]
    json: bool,
}

#[derive(Serialize)]
struct ChannelRow {
    name: String,
    layer: Option<String>,
    /// The buffer of the layout that fits the file.
    buffer: Option<String>,
    #[serde(rename = "type")]
    kind: ChannelType,
    size: String,
    /// Range of the finite samples; none if there are none.
    range: Option<SampleRange>,
    non_finite: usize,
}

#[derive(Serialize)]
struct SampleRange {
    min: f32,
    max: f32,
    mean: f64,
}

#[derive(Serialize)]
struct FileReport {
    file: String,
    channels: Vec<ChannelRow>,
}

impl Arguments {
    /// Prints a table per file, or one JSON array. A file that cannot be read gives one error line and,
    /// at the end, a failure status; the other files are still inspected.
    pub fn run(&self) -> Result<u8> {
        let mut reports = Vec::new();
        let mut status = exit::SUCCESS;
        for file in &self.files {
            let channels = match rows(file) {
                Ok(channels) => channels,
                Err(error) => {
                    demc_program::cli::report(&error);
                    status = exit::FAILURE;
                    continue;
                }
            };
            let file = file.display().to_string();
            let report = FileReport { file, channels };
            if self.json {
                reports.push(report);
            } else {
                message::result(&table(&report))?;
            }
        }
        if self.json {
            message::result(&message::json(&reports)?)?;
        }
        Ok(status)
    }
}

fn rows(path: &Path) -> Result<Vec<ChannelRow>> {
    let mut file = ExrFile::open(path)?;
    let channels = file.channels().to_vec();
    let names: Vec<&str> = channels
        .iter()
        .map(|channel| channel.name.as_str())
        .collect();
    let planes = file.read(&names)?;
    let layout = detect(&file, MissingPolicies::default(), None).ok();
    let buffers = layout.map_or_else(Vec::new, |found| found.layout.buffers());
    let buffer = |name: &String| {
        let found = buffers.iter().find(|buffer| buffer.channels.contains(name));
        found.map(|buffer| buffer.content.clone())
    };
    Ok(channels
        .iter()
        .zip(&planes)
        .map(|(channel, plane)| row(channel, buffer(&channel.name), plane))
        .collect())
}

fn row(channel: &Channel, buffer: Option<String>, plane: &Plane) -> ChannelRow {
    let samples = plane.to_f32();
    let finite = samples.iter().copied().filter(|sample| sample.is_finite());
    let count = finite.clone().count();
    let range = (count > 0).then(|| SampleRange {
        min: finite.clone().fold(f32::INFINITY, f32::min),
        max: finite.clone().fold(f32::NEG_INFINITY, f32::max),
        mean: finite.map(f64::from).sum::<f64>() / count as f64,
    });
    ChannelRow {
        name: channel.name.clone(),
        layer: channel.layer.clone(),
        buffer,
        kind: channel.kind,
        size: channel.window.to_string(),
        range,
        non_finite: samples.len() - count,
    }
}

fn table(report: &FileReport) -> String {
    let rows = &report.channels;
    let longest = |text: fn(&ChannelRow) -> &str, title: &str| {
        rows.iter()
            .map(|row| text(row).chars().count())
            .chain([title.len()])
            .max()
            .unwrap_or(0)
    };
    let name_width = longest(|row| &row.name, "channel");
    let size_width = longest(|row| &row.size, "size");
    let mut text = format!("{}: {} channels", printable(&report.file), rows.len());
    let mut layers: Vec<String> = rows.iter().filter_map(|row| row.layer.clone()).collect();
    layers.dedup();
    if !layers.is_empty() {
        // Writing to a String cannot fail.
        let _ = write!(text, ", layers {}", message::list(&layers));
    }
    let _ = write!(
        text,
        "\n  {:name_width$}  {:5}  {:size_width$}  {:>11}  {:>11}  {:>11}  {:>7}{}",
        "channel",
        "type",
        "size",
        "min",
        "max",
        "mean",
        "NaN/inf",
        if rows.iter().any(|row| row.buffer.is_some()) {
            "  buffer"
        } else {
            ""
        }
    );
    for row in rows {
        let [min, max, mean] = match &row.range {
            Some(range) => [f64::from(range.min), f64::from(range.max), range.mean].map(number),
            None => ["-"; 3].map(str::to_owned),
        };
        let _ = write!(
            text,
            "\n  {:name_width$}  {:5}  {:size_width$}  {min:>11}  {max:>11}  {mean:>11}  {:>7}",
            row.name, row.kind, row.size, row.non_finite
        );
        if let Some(buffer) = &row.buffer {
            let _ = write!(text, "  {buffer}");
        }
    }
    text
}
