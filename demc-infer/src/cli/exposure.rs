//! `--input-scale`: the factor on the colour before the network.

use std::collections::HashMap;
use std::path::{Path, PathBuf};
use std::str::FromStr;

use clap::Args;
use demc_data::image::exr::ExrFile;

use super::exposure_curve::ExposureCurve;
use super::inputs::{Place, Sequence, place};
use super::layouts::Layouts;
use crate::Bundle;
use crate::denoise::MAX_INPUT_SCALE;

/// `--input-scale`.
#[derive(Args)]
pub struct InputScaleFlag {
    /// Factor on the colour before the network; the result is divided by it. `auto`: to the exposure of training.
    /// In a sequence it changes by at most half a stop from frame to frame
    #[arg(
        long = "input-scale",
        value_name = "auto|FACTOR",
        default_value = "auto"
    )]
    pub choice: InputScale,
}

/// Largest exposure of a preview in stops, in both directions: all of f32's range.
const MAX_STOPS: f32 = 128.0;

/// Parses the exposure of a preview.
pub fn stops(text: &str) -> Result<f32, String> {
    match text.parse::<f32>() {
        Ok(stops) if stops.abs() <= MAX_STOPS => Ok(stops),
        _ => Err(format!("expected stops from -{MAX_STOPS} to {MAX_STOPS}")),
    }
}

/// The value of `--input-scale`.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum InputScale {
    /// From the exposure of the image or sequence.
    Auto,
    /// This factor.
    Factor(f32),
}

impl InputScale {
    /// The factor, if it was given.
    pub fn factor(self) -> Option<f32> {
        match self {
            Self::Auto => None,
            Self::Factor(factor) => Some(factor),
        }
    }
}

impl FromStr for InputScale {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        if text == "auto" {
            return Ok(Self::Auto);
        }
        let allowed = 1.0 / MAX_INPUT_SCALE..=MAX_INPUT_SCALE;
        match text.parse() {
            Ok(factor) if allowed.contains(&factor) => Ok(Self::Factor(factor)),
            _ => Err("expected auto, or a factor from 0.000001 to 1000000".to_owned()),
        }
    }
}

/// The factors of the frames of sequences.
pub struct SequenceScales<'a> {
    sequences: &'a [Sequence],
    /// The sequence and the index of each frame, by its place.
    places: HashMap<Place, (usize, usize)>,
    /// By the index of the sequence.
    curves: HashMap<usize, ExposureCurve>,
}

impl<'a> SequenceScales<'a> {
    pub fn new(sequences: &'a [Sequence]) -> Self {
        let frames = sequences.iter().enumerate().flat_map(|(index, sequence)| {
            let frames = sequence.frames.iter().enumerate();
            frames.map(move |(frame, (_, file))| (place(file), (index, frame)))
        });
        Self {
            sequences,
            places: frames.collect(),
            curves: HashMap::new(),
        }
    }

    /// Names the first and the last frame of the sequence of an image, which decide its factor.
    pub fn sequence(&self, path: &Path) -> Option<String> {
        let (index, _) = self.places.get(&place(path))?;
        let frames = &self.sequences[*index].frames;
        let name = |(_, file): &(u64, PathBuf)| {
            let name = file.file_name().unwrap_or_default();
            name.to_string_lossy().into_owned()
        };
        let count = frames.len();
        let ends = [frames.first()?, frames.last()?].map(name);
        Some(format!("{} to {} ({count} frames)", ends[0], ends[1]))
    }

    /// The exposure that the factor for a frame is made for, which hardly changes from frame to frame; `None` for
    /// an image in no sequence.
    pub fn exposure(&mut self, path: &Path, bundle: &Bundle, layouts: &Layouts) -> Option<f64> {
        let &(index, frame) = self.places.get(&place(path))?;
        let frames = &self.sequences[index].frames;
        let curve = self.curves.entry(index).or_insert_with(|| {
            let numbers: Vec<u64> = frames.iter().map(|(number, _)| *number).collect();
            ExposureCurve::measure(&numbers, |frame| {
                // An unreadable frame is reported when its turn comes.
                let exposure = exposure_of(&frames[frame].1, bundle, layouts).ok()?;
                (exposure > 0.0).then(|| exposure.log2())
            })
        });
        let stops = curve.at(frames[frame].0);
        Some(stops.map_or(0.0, f64::exp2))
    }
}

/// The exposure of an image, from its colour alone.
fn exposure_of(path: &Path, bundle: &Bundle, layouts: &Layouts) -> Result<f64, demc_data::Error> {
    let mut file = ExrFile::open(path)?;
    let (layout, _) = layouts.choose(&file, bundle)?;
    let names = layout.color.each_ref().map(String::as_str);
    file.require(&names)?;
    let planes = file.read(&names)?;
    let color: Vec<f32> = planes.iter().flat_map(|plane| plane.to_f32()).collect();
    let window = &file.channel(names[0]).expect("it was required").window;
    Ok(bundle.exposure(&color, window.height, window.width))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_scale_is_auto_or_a_positive_number() {
        assert_eq!("auto".parse(), Ok(InputScale::Auto));
        assert_eq!("0.25".parse(), Ok(InputScale::Factor(0.25)));
        for wrong in ["0", "-1", "nan", "inf", "1e9", "x", ""] {
            assert!(wrong.parse::<InputScale>().is_err(), "{wrong}");
        }
    }
}
