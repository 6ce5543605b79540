//! `demc-infer inspect`: shows a model's network, statistics and channel layout.

use std::fmt::Write;

use burn::tensor::Device;
use clap::Args;
use demc_data::ChannelLayout;
use demc_data::image::frame::FEATURE_NAMES;
use demc_data::image::layout::Missing;
use demc_program::message::{self, printable};
use serde::Serialize;

use super::flags::ModelFlag;
use super::outputs::utf8_for_json;
use crate::{Bundle, BundleMeta, Names, Precision};

/// Show a model: network, training step, statistics and input channels.
///
/// The model is validated completely: a model that `inspect` shows is usable.
#[derive(Args)]
#[command(after_help = "Examples:
  demc-infer inspect --model runs/quickstart
  demc-infer inspect --model demc.safetensors --json | jq .normalizer")]
pub struct Arguments {
    #[command(flatten)]
    model: ModelFlag,
    /// Also list the tensors
    #[arg(long)]
    tensors: bool,
    /// Print JSON
    #[arg(long)]
    json: bool,
}

#[derive(Serialize)]
struct ModelSummary {
    file: String,
    #[serde(flatten)]
    meta: BundleMeta,
    names: Names,
    precision: Precision,
    parameters: u64,
    #[serde(skip_serializing_if = "Option::is_none")]
    albedo_filter: Option<FilterSummary>,
    #[serde(skip_serializing_if = "Vec::is_empty")]
    tensors: Vec<(String, Vec<usize>)>,
}

#[derive(Serialize)]
struct FilterSummary {
    #[serde(flatten)]
    meta: BundleMeta,
    parameters: u64,
}

impl Arguments {
    pub fn run(self) -> anyhow::Result<()> {
        let source = self.model.read()?;
        let (file, names, precision) = (source.path.clone(), source.names, source.precision);
        if self.json {
            utf8_for_json(&file)?;
        }
        let bundle = source.into_bundle(&Device::flex())?;
        let tensors = if self.tensors {
            bundle.tensors(names)
        } else {
            Vec::new()
        };
        let Bundle {
            meta,
            albedo_filter,
            ..
        } = bundle;
        let albedo_filter = albedo_filter.map(|filter| FilterSummary {
            parameters: filter.meta.model.parameter_count(),
            meta: filter.meta,
        });
        let parameters = meta.model.parameter_count();
        let summary = ModelSummary {
            file: file.display().to_string(),
            meta,
            names,
            precision,
            parameters,
            albedo_filter,
            tensors,
        };
        let text = if self.json {
            message::json(&summary)?
        } else {
            summary.text()?
        };
        Ok(message::result(&text)?)
    }
}

impl ModelSummary {
    fn text(&self) -> Result<String, std::fmt::Error> {
        let Self { meta, .. } = self;
        let mut text = String::new();
        let t = &mut text;
        writeln!(t, "file        {}", printable(&self.file))?;
        writeln!(t, "network     {}", meta.model)?;
        writeln!(t, "parameters  {}", self.parameters)?;
        writeln!(t, "step        {}", meta.step)?;
        let style = format!("{:?}, {:?} names", self.precision, self.names);
        writeln!(t, "weights     {}", style.to_lowercase())?;
        if let Some(license) = &meta.license {
            writeln!(t, "license     {}", printable(license))?;
        }
        writeln!(t, "gamma       {}", meta.normalizer.gamma)?;
        if !meta.normalizer.transfer.is_gamma() {
            writeln!(t, "transfer    Open Image Denoise's curve")?;
        }
        if let Some(FilterSummary { meta, parameters }) = &self.albedo_filter {
            let (model, step) = (meta.model, meta.step);
            writeln!(
                t,
                "filter      albedo: {model}, step {step}, {parameters} parameters"
            )?;
        }
        let epsilon = meta.normalizer.albedo_demodulation_epsilon;
        let demodulation = epsilon.map_or("off".into(), |epsilon| format!("albedo + {epsilon}"));
        writeln!(t, "demodulate  {demodulation}")?;

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
            "\n| buffer     | channels                             | if missing     |"
        )?;
        writeln!(
            t,
            "| ---------- | ------------------------------------ | -------------- |"
        )?;
        for BufferRow {
            name,
            channels,
            missing,
        } in buffers(&meta.layout)
        {
            writeln!(t, "| {name:<10} | {channels:<36} | {missing:<14} |")?;
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

/// A buffer of a layout.
struct BufferRow {
    name: &'static str,
    channels: String,
    /// The replacement for missing channels.
    missing: &'static str,
}

/// The buffers of a layout.
fn buffers(layout: &ChannelLayout) -> Vec<BufferRow> {
    let channels = |names: Option<&[String; 3]>| {
        names.map_or("none".into(), |names| printable(&names.join(" ")))
    };
    let row = |name, names, missing| BufferRow {
        name,
        channels: channels(names),
        missing,
    };
    let mut rows = vec![row("color", Some(&layout.color), "refused")];
    for feature in layout.features() {
        let missing = match feature.missing {
            Missing::Error => "refused",
            Missing::Zeros => "zeros",
            Missing::CopyTexture1 => "texture1",
        };
        rows.push(row(feature.name, feature.channels, missing));
    }
    rows.push(row("reference", layout.reference.as_ref(), "no scores"));
    rows
}
