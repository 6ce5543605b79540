//! `demc-data stats`.

use std::collections::{BTreeMap, BTreeSet};
use std::fmt::Write;
use std::path::PathBuf;

use anyhow::Result;
use clap::Args;
use demc_program::exit;
use demc_program::message::{self, printable};
use serde::Serialize;

use super::number::number;
use crate::dataset::{Dataset, Scene, Split, preset_of};
use crate::image::frame::FEATURE_NAMES;
use crate::image::layout::ChannelLayout;
use crate::training::config::DataConfig;
use crate::training::patch::patches;
use crate::training::stats::Statistics;

/// Epsilon of Eq. 5 (Sec. 4.2).
const RELMSE_EPSILON: f32 = 0.001;

#[derive(Args)]
#[command(
    after_help = "Examples:\n  demc-data stats data/sample\n  demc-data stats renders --layout my-renderer.toml --json"
)]
pub struct Arguments {
    /// Directory of the data set, with its manifest.json
    #[arg(value_name = "DIR")]
    root: PathBuf,
    /// Channel layout: demc-exr, mitsuba3, pbrt-v4, cycles, luxcore, fbksd, or a TOML file [default: the preset
    /// that fits the first file]
    #[arg(long, value_name = "PRESET|FILE")]
    layout: Option<String>,
    /// The split to measure
    #[arg(long, default_value = "train", value_parser = parse_split, value_name = "train|test")]
    split: Split,
    /// Print one JSON object instead of a table
    #[arg(long)]
    json: bool,
}

#[derive(Serialize)]
struct DatasetReport<'a> {
    root: String,
    layout: &'a str,
    splits: BTreeMap<Split, SplitContents>,
    /// The split of the measurements below.
    split: Split,
    pixels: u64,
    /// Share of the pixels whose camera rays hit nothing.
    misses: f64,
    /// Negative samples of colour and reference, which are set to 0.
    negative: u64,
    features: Vec<FeatureRow>,
    /// The constant reference colour with the least RelMSE, in gamma space.
    flat_color: [f32; 3],
}

#[derive(Serialize)]
struct SplitContents {
    scenes: usize,
    base_scenes: BTreeSet<String>,
    sizes: BTreeMap<String, usize>,
    /// Number of patches of the default size and stride; none if a scene is too small for a
    /// patch.
    patches: Option<usize>,
}

#[derive(Serialize)]
struct FeatureRow {
    name: &'static str,
    mean: f32,
    std: f32,
}

impl Arguments {
    /// Measures the data set and prints a table or a JSON object.
    pub fn run(&self) -> Result<u8> {
        let Self {
            root,
            layout,
            split,
            json,
        } = self;
        let split = *split;
        let layout_name = match layout {
            Some(name) => name.as_str(),
            None => preset_of(&Dataset::list(root)?),
        };
        let layout = ChannelLayout::resolve(layout_name)?;
        let dataset = Dataset::open(root, &layout)?;
        let config = DataConfig::default();
        let scenes = dataset.split(split)?;
        let measured = Statistics::measure(&scenes, &layout, &config, RELMSE_EPSILON)?;
        let splits = [Split::Train, Split::Test].into_iter().filter_map(|split| {
            let scenes = dataset.split(split).ok()?;
            Some((split, contents(&scenes, &config)))
        });
        let normalizer = measured.normalizer;
        let stats = normalizer
            .features
            .mean
            .into_iter()
            .zip(normalizer.features.std);
        let report = DatasetReport {
            root: root.display().to_string(),
            layout: layout_name,
            splits: splits.collect(),
            split,
            pixels: measured.pixels,
            misses: measured.misses as f64 / measured.pixels as f64,
            negative: measured.clamped,
            features: FEATURE_NAMES
                .into_iter()
                .zip(stats)
                .map(|(name, (mean, std))| FeatureRow { name, mean, std })
                .collect(),
            flat_color: normalizer.flat_color,
        };
        let text = if *json {
            message::json(&report)?
        } else {
            table(&report, &config)
        };
        message::result(&text)?;
        Ok(exit::SUCCESS)
    }
}

fn parse_split(text: &str) -> Result<Split, String> {
    match text {
        "train" => Ok(Split::Train),
        "test" => Ok(Split::Test),
        _ => Err("expected train or test".to_owned()),
    }
}

fn contents(scenes: &[Scene], config: &DataConfig) -> SplitContents {
    let mut sizes = BTreeMap::new();
    for scene in scenes {
        *sizes
            .entry(format!("{}x{}", scene.width, scene.height))
            .or_default() += 1;
    }
    SplitContents {
        scenes: scenes.len(),
        base_scenes: scenes.iter().map(|scene| scene.base.clone()).collect(),
        sizes,
        patches: patches(scenes, config.patch_size, config.stride)
            .ok()
            .map(|patches| patches.len()),
    }
}

fn table(report: &DatasetReport<'_>, config: &DataConfig) -> String {
    let title = format!("{} (layout {})", report.root, report.layout);
    let mut text = printable(&title) + "\n";
    // Writing to a String cannot fail.
    for (split, contents) in &report.splits {
        let sizes: Vec<String> = contents
            .sizes
            .iter()
            .map(|(size, scenes)| format!("{scenes} of {size}"))
            .collect();
        let patches = match contents.patches {
            Some(patches) => patches.to_string(),
            None => "no".to_owned(),
        };
        let _ = writeln!(
            text,
            "  {:5}  {} scenes ({}) of {} base scenes; {patches} patches of {size}x{size} at stride {}",
            split.to_string(),
            contents.scenes,
            sizes.join(", "),
            contents.base_scenes.len(),
            config.stride,
            size = config.patch_size,
        );
        let bases: Vec<&str> = contents.base_scenes.iter().map(String::as_str).collect();
        let _ = writeln!(text, "         {}", printable(&bases.join(", ")));
    }
    let _ = writeln!(
        text,
        "\n{} split: {} pixels, {:.2} % misses, {} negative radiance samples (set to 0)",
        report.split,
        report.pixels,
        100.0 * report.misses,
        report.negative
    );
    let _ = writeln!(text, "  {:10}  {:>11}  {:>11}", "feature", "mean", "std");
    for FeatureRow { name, mean, std } in &report.features {
        let (mean, std) = (number(f64::from(*mean)), number(f64::from(*std)));
        let _ = writeln!(text, "  {name:10}  {mean:>11}  {std:>11}");
    }
    let [r, g, b] = report.flat_color;
    let _ = write!(
        text,
        "  flat colour with the least RelMSE, in gamma space: {r:.4} {g:.4} {b:.4}"
    );
    text
}
