//! `demc-data stats`.

use std::collections::{BTreeMap, BTreeSet};
use std::fmt::Write;
use std::path::Path;

use crate::frame::FEATURE_NAMES;
use crate::message::{self, printable};
use crate::patch::patches;
use crate::{ChannelLayout, DataConfig, Dataset, Scene, Split, Statistics};
use anyhow::Result;
use serde::Serialize;

/// Epsilon of Eq. 5 (Sec. 4.2).
const RELMSE_EPSILON: f32 = 0.001;

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
    /// Number of patches of the default size, stride and border; none if a scene is too small for a
    /// patch.
    patches: Option<usize>,
}

#[derive(Serialize)]
struct FeatureRow {
    name: &'static str,
    mean: f32,
    std: f32,
}

/// Measures the data set at `root` and prints a table or a JSON object.
pub fn run(root: &Path, layout_name: &str, split: Split, json: bool) -> Result<()> {
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
    let text = match json {
        true => message::json(&report)?,
        false => table(&report, &config),
    };
    Ok(message::result(&text)?)
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
        patches: patches(scenes, config.patch_size, config.stride, config.border)
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
        let (mean, std) = (
            super::number(f64::from(*mean)),
            super::number(f64::from(*std)),
        );
        let _ = writeln!(text, "  {name:10}  {mean:>11}  {std:>11}");
    }
    let [r, g, b] = report.flat_color;
    let _ = write!(
        text,
        "  flat colour with the least RelMSE, in gamma space: {r:.4} {g:.4} {b:.4}"
    );
    text
}
