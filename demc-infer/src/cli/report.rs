//! `demc-infer report`: a page to look at.

use std::io::Write;
use std::path::PathBuf;

use clap::Args;
use demc_infer::report::{About, Page};

use super::scenes::Scenes;

/// Write one HTML file that shows a model's images beside the noisy ones, the references and other programs', with all
/// metrics.
///
/// The file needs no network and no other file, and stays below 20 MB. Its images are 8-bit JPEG of a logarithmic curve,
/// so that exposure can be changed by 3 stops to both sides; all numbers are computed from the full images.
#[derive(Args)]
#[command(after_help = "Examples:
  demc-infer report --data data/sample -o report.html
  demc-infer report --model runs/quickstart --data data/sample --baseline oidn=oidn/ -o report.html")]
pub struct Report {
    #[command(flatten)]
    scenes: Scenes,
    /// The page
    #[arg(short, long, value_name = "FILE.html")]
    output: PathBuf,
}

impl Report {
    /// Scores every scene of the split and writes the page, whole or not at all.
    pub fn run(self) -> anyhow::Result<()> {
        let mut page = Page::default();
        let report = self.scenes.score(
            |views, scenes| Ok(views.encode(scenes)?),
            |encoded, score| Ok(page.add(encoded, score)?),
        )?;
        let about = About {
            model: self.scenes.model_name(),
            data: self.scenes.data.display().to_string(),
            split: demc_data::Split::from(self.scenes.split).to_string(),
        };
        let html = page.html(&about, &report)?;
        demc_data::file::write_whole(&self.output, |file| file.write_all(html.as_bytes()))?;
        super::print(&format!(
            "{}: {} images, {:.1} MB",
            self.output.display(),
            report.images.len(),
            html.len() as f64 / 1e6
        ))
    }
}
