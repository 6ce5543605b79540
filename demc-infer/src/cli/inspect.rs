//! `demc-infer inspect`: what a model is, what it was trained on, what files it takes.

use std::fmt::Write;
use std::path::PathBuf;

use burn::tensor::Device;
use clap::Args;
use demc_data::ChannelLayout;
use demc_data::frame::FEATURE_NAMES;
use demc_data::layout::Missing;
use demc_infer::{Bundle, BundleMeta, Names, Precision};
use serde::Serialize;

use super::{Model, print};

/// Show a model: network, training step, statistics, and the channels that it reads.
///
/// Everything is checked on the way: a model that `inspect` shows can be used.
#[derive(Args)]
#[command(after_help = "Examples:
  demc-infer inspect --model runs/quickstart
  demc-infer inspect --model demc.safetensors --json | jq .normalizer")]
pub struct Inspect {
    #[command(flatten)]
    model: Model,
    /// List the tensors, too
    #[arg(long)]
    tensors: bool,
    /// Print JSON
    #[arg(long)]
    json: bool,
}

/// What is shown.
#[derive(Serialize)]
struct Summary {
    file: PathBuf,
    #[serde(flatten)]
    meta: BundleMeta,
    names: Names,
    precision: Precision,
    /// Number of trainable values.
    parameters: usize,
    /// Name and shape.
    #[serde(skip_serializing_if = "Vec::is_empty")]
    tensors: Vec<(String, Vec<usize>)>,
}

impl Inspect {
    /// Loads the model as every other command does, and prints what it is.
    pub fn run(self) -> anyhow::Result<()> {
        let source = self.model.read()?;
        let (file, names, precision) = (source.path.clone(), source.names, source.precision);
        let Bundle { meta, model } = source.into_bundle(&Device::flex())?;
        let tensors = match self.tensors {
            true => model
                .weights()
                .into_iter()
                .map(|w| (names.from_burn(&w.name), w.shape))
                .collect(),
            false => Vec::new(),
        };
        let parameters = model.parameter_count();
        let summary = Summary {
            file,
            meta,
            names,
            precision,
            parameters,
            tensors,
        };
        print(&match self.json {
            true => serde_json::to_string_pretty(&summary)?,
            false => summary.text()?,
        })
    }
}

impl Summary {
    fn text(&self) -> Result<String, std::fmt::Error> {
        let Self { meta, .. } = self;
        let mut text = String::new();
        let t = &mut text;
        writeln!(t, "file        {}", self.file.display())?;
        writeln!(t, "network     {}", meta.model)?;
        writeln!(t, "parameters  {}", self.parameters)?;
        writeln!(t, "step        {}", meta.step)?;
        let style = format!("{:?}, {:?} names", self.precision, self.names);
        writeln!(t, "weights     {}", style.to_lowercase())?;
        writeln!(t, "gamma       {}", meta.normalizer.gamma)?;
        writeln!(t, "demodulate  {}", meta.normalizer.demodulate)?;

        writeln!(t, "\n| feature    |         mean | standard deviation |")?;
        writeln!(t, "| ---------- | -----------: | -----------------: |")?;
        let features = &meta.normalizer.features;
        for (name, (mean, std)) in FEATURE_NAMES
            .iter()
            .zip(features.mean.iter().zip(&features.std))
        {
            writeln!(t, "| {name:<10} | {mean:>12.6} | {std:>18.6} |")?;
        }

        writeln!(
            t,
            "\n| buffer     | channels                             | where missing  |"
        )?;
        writeln!(
            t,
            "| ---------- | ------------------------------------ | -------------- |"
        )?;
        for (buffer, channels, missing) in buffers(&meta.layout) {
            writeln!(t, "| {buffer:<10} | {channels:<36} | {missing:<14} |")?;
        }

        if !self.tensors.is_empty() {
            writeln!(t, "\n| {:<40} | shape", "tensor")?;
            writeln!(t, "| {0:-<40} | {0:-<18}", "-")?;
        }
        for (name, shape) in &self.tensors {
            writeln!(t, "| {name:<40} | {shape:?}")?;
        }
        Ok(text.trim_end().into())
    }
}

/// The buffers that a layout reads: name, channels, and what a file without them gets.
fn buffers(layout: &ChannelLayout) -> Vec<(&'static str, String, &'static str)> {
    let channels =
        |names: Option<&[String; 3]>| names.map_or("none".into(), |names| names.join(" "));
    let mut rows = vec![("color", channels(Some(&layout.color)), "refused")];
    for (buffer, names, missing) in layout.features() {
        let missing = match missing {
            Missing::Error => "refused",
            Missing::Zeros => "zeros",
            Missing::CopyTexture1 => "texture1",
        };
        rows.push((buffer, channels(names), missing));
    }
    rows.push((
        "reference",
        channels(layout.reference.as_ref()),
        "no scores",
    ));
    rows
}
