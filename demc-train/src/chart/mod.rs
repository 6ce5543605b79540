//! Charts as SVG and PNG: lines over steps, bars with intervals.
//!
//! `plotters` draws: its charts, meshes, series and legends. What is here is what it does not choose: how far an axis
//! reaches and which values it names (`axis`), and what a panel shows (`lines`, `bars`, around them `page`). Nothing
//! is read from the system: the font for the PNG is embedded, the SVG asks for the generic `sans-serif`.

mod axis;
mod bars;
mod lines;
mod page;
#[cfg(test)]
mod tests;

use std::ffi::OsString;
use std::io::Write;
use std::path::{Path, PathBuf};

use anyhow::{Context, anyhow, ensure};
use demc_data::file::write_whole;
use plotters::prelude::*;
use plotters::style::register_font;

use page::Page;

/// The files have this many pixels for one that the SVG asks for: text stays sharp on dense displays.
const DENSITY: u32 = 2;

/// A line of points.
#[derive(Clone, Debug, PartialEq)]
pub struct Series {
    /// What the legend calls it.
    pub name: String,
    /// Places along x and y, in the order of drawing. One that is not finite, or not positive on a log axis, is a gap.
    pub points: Vec<(f64, f64)>,
    /// Drawn thin and pale under the others, without legend entry (raw values under a smoothed curve).
    pub faint: bool,
    /// Colour: index in the palette of eight; after the last, it begins again greyer.
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
        register_font(
            FontFamily::SansSerif.as_str(),
            FontStyle::Normal,
            epaint_default_fonts::UBUNTU_LIGHT,
        )
        .map_err(|_| anyhow!("the embedded font cannot be read"))?;
        let page = Page::of(self);
        let svg = svg(&page).with_context(|| format!("{name}.svg"))?;
        let png = png(&page).with_context(|| format!("{name}.png"))?;
        let paths = ["svg", "png"].map(|kind| with_kind(stem, kind));
        for (path, bytes) in paths.iter().zip([svg.as_bytes(), &png]) {
            write_whole(path, |file| file.write_all(bytes))?;
        }
        Ok(paths)
    }
}

/// `STEM.KIND`; unlike `Path::with_extension`, a dot in the stem stays.
pub(crate) fn with_kind(stem: &Path, kind: &str) -> PathBuf {
    let mut path = OsString::from(stem);
    path.push(".");
    path.push(kind);
    path.into()
}

/// The text of an SVG file.
fn svg(page: &Page) -> anyhow::Result<String> {
    let mut text = String::new();
    let size = page.size();
    let root = SVGBackend::with_string(&mut text, size).into_drawing_area();
    page.draw(&root, false)?;
    drop(root);
    let sides = |width, height| format!("width=\"{width}\" height=\"{height}\"");
    let shown = sides(size.0 / DENSITY, size.1 / DENSITY);
    Ok(text.replacen(&sides(size.0, size.1), &shown, 1))
}

/// The bytes of a PNG file.
fn png(page: &Page) -> anyhow::Result<Vec<u8>> {
    let (width, height) = page.size();
    let mut pixels = vec![255; width as usize * height as usize * 3];
    let root = BitMapBackend::with_buffer(&mut pixels, (width, height)).into_drawing_area();
    page.draw(&root, true)?;
    drop(root);
    let mut bytes = Vec::new();
    let mut encoder = png::Encoder::new(&mut bytes, width, height);
    encoder.set_color(png::ColorType::Rgb);
    encoder.set_depth(png::BitDepth::Eight);
    let mut writer = encoder.write_header().context("PNG header")?;
    writer.write_image_data(&pixels)?;
    writer.finish()?;
    Ok(bytes)
}
