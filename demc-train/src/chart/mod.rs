//! Charts as SVG and PNG: lines over steps, bars with intervals.
//!
//! A [`Figure`] becomes shapes at places in pixels (`page` lays out the panels, `lines` and `bars` fill them, `frame`
//! draws what is around them, `axis` chooses ranges and ticks), and `paint`, which alone knows `plotters`, makes
//! files of the shapes. Nothing is read from the system: the font for the PNG is embedded, the SVG asks for the
//! generic `sans-serif`.

mod axis;
mod bars;
mod frame;
mod lines;
mod page;
mod paint;
mod shape;
#[cfg(test)]
mod tests;

use std::ffi::OsString;
use std::io::Write;
use std::path::{Path, PathBuf};

use anyhow::{Context, ensure};
use demc_data::file::write_whole;

/// A line of points.
#[derive(Clone, Debug, PartialEq)]
pub struct Series {
    /// What the legend calls it.
    pub name: String,
    /// Places along x and y, in the order of drawing. One that is not finite, or not positive on a log axis, is a gap.
    pub points: Vec<(f64, f64)>,
    /// Drawn thin and pale under the others, without legend entry (raw values under a smoothed curve).
    pub faint: bool,
    /// Colour: index in the palette of eight; after the last, it begins again in dashes.
    pub color: usize,
}

/// How an axis spaces its values.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Scale {
    /// Equal differences are equally long.
    Linear,
    /// Equal factors are equally long.
    Log,
}

/// One coordinate system with lines.
#[derive(Clone, Debug, PartialEq)]
pub struct Panel {
    /// Above the panel.
    pub title: String,
    /// Below the x axis.
    pub x_label: String,
    /// Beside the y axis.
    pub y_label: String,
    /// Spacing of the x axis.
    pub x: Scale,
    /// Spacing of the y axis.
    pub y: Scale,
    /// The lines; of those that cross, a later one is on top.
    pub series: Vec<Series>,
    /// Vertical marks with a label, such as a suggested learning rate.
    pub marks: Vec<(f64, String)>,
}

/// A value with its interval in one group, for a comparison of variants.
#[derive(Clone, Debug, PartialEq)]
pub struct Bar {
    /// The height; one that is not finite, or not positive on a log axis, reads "n/a".
    pub value: f64,
    /// Lower and upper end of an interval around the value.
    pub interval: Option<(f64, f64)>,
    /// Individual values (one a seed or image), as dots.
    pub points: Vec<f64>,
}

/// Bars of one group (such as "RelMSE"), one a variant, with a y axis of their own.
///
/// On a linear axis bars stand on zero. Values that lie so near each other that they would look the same from there
/// are drawn as lines across instead, on an axis that does not start at zero. On a log axis, which has no zero, bars
/// start at the axis' end.
#[derive(Clone, Debug, PartialEq)]
pub struct BarPanel {
    /// Above the panel.
    pub title: String,
    /// Beside the y axis.
    pub y_label: String,
    /// Names of the variants, in the order of `bars`: below the bars if they fit, else in a legend.
    pub names: Vec<String>,
    /// One a variant.
    pub bars: Vec<Bar>,
    /// Spacing of the y axis.
    pub y: Scale,
}

/// A picture of panels side by side.
#[derive(Clone, Debug, PartialEq)]
pub enum Figure {
    /// Lines.
    Lines(Vec<Panel>),
    /// Bars.
    Bars(Vec<BarPanel>),
}

impl Figure {
    /// Draws to STEM.svg and STEM.png, panels side by side, or in rows if there are more than three; each file whole
    /// or not at all, and neither if drawing fails. Returns both paths.
    ///
    /// # Errors
    /// A stem without a file name, a file that cannot be written.
    pub fn write(&self, stem: &Path) -> anyhow::Result<[PathBuf; 2]> {
        let name = stem.to_string_lossy();
        let is_name = stem.file_name().is_some() && !name.ends_with(std::path::is_separator);
        ensure!(is_name, "{name}: names no file to draw to");
        let drawing = page::drawn(self, paint::Font::embedded()?);
        let svg = paint::svg(&drawing).with_context(|| format!("{name}.svg"))?;
        let png = paint::png(&drawing).with_context(|| format!("{name}.png"))?;
        let paths = ["svg", "png"].map(|kind| with_kind(stem, kind));
        for (path, bytes) in paths.iter().zip([svg.as_bytes(), &png]) {
            write_whole(path, |file| file.write_all(bytes))?;
        }
        Ok(paths)
    }
}

/// `STEM.KIND`; unlike `Path::with_extension`, a dot in the stem stays.
fn with_kind(stem: &Path, kind: &str) -> PathBuf {
    let mut path = OsString::from(stem);
    path.push(".");
    path.push(kind);
    path.into()
}
