//! Charts as SVG: lines over steps or learning rates.
//!
//! `plotters` draws axes, meshes, series and legends. This module adds the range and labels of axes
//! (`axis`), the contents of a panel (`lines`), its `frame`, and the layout of panels (`page`). Text uses the viewer's `sans-serif` font, so no font is read here.

mod axis;
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

use figure::Figure;
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
        let path = with_extension(stem, "svg")?;
        let svg = svg(&FigurePage::new(self)).with_context(|| path.display().to_string())?;
        write_whole(&path, |file| file.write_all(svg.as_bytes()))?;
        Ok(path)
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

fn svg(page: &FigurePage) -> anyhow::Result<String> {
    let mut text = String::new();
    let size = page.size();
    let root = SVGBackend::with_string(&mut text, size).into_drawing_area();
    page.draw(&root)?;
    drop(root);
    let attributes = |width, height| format!("width=\"{width}\" height=\"{height}\"");
    let shown = attributes(size.0 / DENSITY, size.1 / DENSITY);
    Ok(text.replacen(&attributes(size.0, size.1), &shown, 1))
}
