//! `--layers`: further channels of a file that are denoised beside its colour.

use std::collections::BTreeSet;

use clap::Args;
use demc_data::image::exr::ExrFile;
use demc_data::image::frame::layers::{check_layers, decode_layers};
use demc_data::{ChannelLayout, Error};
use demc_program::exit::UsageError;
use demc_program::message::list;
use glob::Pattern;

use super::record::Record;
use crate::denoise::Layer;
use crate::{Bundle, Ensemble};

/// `--layers`.
#[derive(Args)]
pub struct LayersFlag {
    /// Also denoise these channels: names or glob patterns, such as 'ViewLayer.Combined_*'. Layers that
    /// add up to the colour still do. Not with a KPCN model. The flag can be repeated
    #[arg(long = "layers", value_name = "PATTERN", value_parser = pattern)]
    patterns: Vec<Pattern>,
}

fn pattern(text: &str) -> Result<Pattern, String> {
    Pattern::new(text).map_err(|error| error.to_string())
}

impl LayersFlag {
    /// Adds the patterns to a record.
    pub fn record(&self, record: &mut Record) {
        // A set: the order changes nothing. Its text shows where a pattern ends.
        let patterns: BTreeSet<&str> = self.patterns.iter().map(Pattern::as_str).collect();
        match Vec::from_iter(&patterns)[..] {
            [] => {}
            [pattern] => record.add("--layers", pattern),
            _ => record.add("--layers", format!("{patterns:?}")),
        }
    }

    /// Refuses a model or test-time augmentation that does not suit layers.
    pub fn check(&self, bundle: &Bundle, ensemble: Ensemble) -> Result<(), UsageError> {
        if self.patterns.is_empty() {
            return Ok(());
        }
        let checked = bundle.check_layers(ensemble);
        checked.map_err(|error| UsageError(format!("--layers: {error}")))
    }

    /// The names of the channels that match, in the file's order, without those of the colour.
    ///
    /// # Errors
    /// A pattern that matches nothing, and as [`check_layers`].
    pub fn names(&self, file: &ExrFile, layout: &ChannelLayout) -> anyhow::Result<Vec<String>> {
        let channels = || file.channels().iter().map(|channel| &channel.name);
        for pattern in &self.patterns {
            if !channels().any(|name| pattern.matches(name)) {
                let present: Vec<&String> = channels().collect();
                let (path, present) = (file.path().display(), list(&present));
                anyhow::bail!(
                    "{path}: no channel matches --layers {pattern}; the file has {present}"
                );
            }
        }
        let mut names: Vec<String> = Vec::new();
        for name in channels().filter(|name| !layout.color.contains(name)) {
            let chosen = self.patterns.iter().any(|pattern| pattern.matches(name));
            // Two parts of a file may have the same names.
            if chosen && !names.contains(name) {
                names.push(name.clone());
            }
        }
        check_layers(file, layout, &names)?;
        Ok(names)
    }
}

/// Decodes layers, if wanted with repaired samples. Also returns their number.
///
/// # Errors
/// As [`decode_layers`].
pub fn read_layers(
    file: &mut ExrFile,
    layout: &ChannelLayout,
    names: &[String],
    repair: bool,
) -> Result<(Vec<Layer>, usize), Error> {
    if names.is_empty() {
        return Ok((Vec::new(), 0));
    }
    let (planes, repaired) = decode_layers(file, layout, names, repair)?;
    let named = names.iter().cloned().zip(planes);
    let layers = named.map(|(name, samples)| Layer { name, samples });
    Ok((layers.collect(), repaired))
}
