//! Charts as SVG: lines over steps or learning rates, and named values.
//!
//! `plotters` draws axes, meshes, series and legends. This module adds the range and labels of axes
//! (`axis`), the contents of a panel (`lines`, `categories`), its
//! `frame`, and the layout of panels (`page`). Text uses the viewer's `sans-serif` font, so no font is read here.

mod axis;
mod categories;
pub mod figure;
mod frame;
mod lines;
mod page;
#[cfg(test)]
mod tests;

use std::ffi::OsString;
use std::io::Write;
use std::path::{Path, PathBuf};

use anyhow::{Context, ensure};
use demc_program::file::write_whole;
use plotters::prelude::*;

use figure::{CategoryFigure, Figure};
use frame::Area;
use page::FigurePage;

/// Drawing units per pixel of the shown picture. `plotters` rounds coordinates to whole units; half
/// a pixel is fine enough on dense displays.
const DENSITY: u32 = 2;

impl Figure {
    /// Writes STEM.svg, complete or not at all: panels side by side, in rows if there are more than
    /// three. Returns its path.
    ///
    /// # Errors
    /// A stem without a file name; a file that cannot be written.
    pub fn write(&self, stem: &Path) -> anyhow::Result<PathBuf> {
        let page = FigurePage::new(self);
        write_svg(stem, page.size(), |root| page.draw(root))
    }
}

impl CategoryFigure {
    /// Writes STEM.svg, complete or not at all: panels side by side. Returns its path.
    ///
    /// # Errors
    /// As [`Figure::write`].
    pub fn write(&self, stem: &Path) -> anyhow::Result<PathBuf> {
        write_svg(stem, self.size(), |root| self.draw(root))
    }
}

/// `STEM.EXTENSION`. Unlike `Path::with_extension`, it keeps a dot in the stem, except that of `.svg`.
///
/// # Errors
/// A stem without a file name.
pub fn with_extension(stem: &Path, extension: &str) -> anyhow::Result<PathBuf> {
    let is_directory = stem.as_os_str().as_encoded_bytes().ends_with(b"/");
    ensure!(
        stem.file_name().is_some() && !is_directory,
        "{}: expected a file name",
        stem.display()
    );
    let mut path = match stem.extension() {
        Some(svg) if svg == "svg" => stem.with_extension("").into_os_string(),
        _ => OsString::from(stem),
    };
    path.push(".");
    path.push(extension);
    Ok(path.into())
}

/// Writes STEM.svg with what `draw` draws on this many drawing units.
fn write_svg(
    stem: &Path,
    size: (u32, u32),
    draw: impl for<'a> FnOnce(&Area<SVGBackend<'a>>) -> DrawResult<(), SVGBackend<'a>>,
) -> anyhow::Result<PathBuf> {
    let path = with_extension(stem, "svg")?;
    let mut text = String::new();
    let root = SVGBackend::with_string(&mut text, size).into_drawing_area();
    draw(&root).with_context(|| path.display().to_string())?;
    drop(root);
    let attributes = |width, height| format!("width=\"{width}\" height=\"{height}\"");
    let shown = attributes(size.0 / DENSITY, size.1 / DENSITY);
    let svg = text.replacen(&attributes(size.0, size.1), &shown, 1);
    write_whole(&path, |file| file.write_all(svg.as_bytes()))?;
    Ok(path)
}
