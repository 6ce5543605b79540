//! `demc-infer report`: writes an HTML report.

use std::io::Write;
use std::path::PathBuf;

use clap::Args;
use demc_program::cli::OverwriteFlag;
use demc_program::message::{self, printable};

use super::scenes::{Scenes, require_all};
use crate::report::{About, ReportPage};

/// Write an HTML report: denoised images beside noisy, reference and baseline images, with all
/// metrics.
///
/// The report is one file below 20 MB and needs no network. Its images are 8-bit JPEG with a
/// logarithmic curve, so that the exposure can be changed by 3 stops in both directions. All
/// numbers are computed from the full images. A scene that cannot be read or scored is reported and
/// skipped, and the exit code is 1.
#[derive(Args)]
#[command(after_help = "Examples:
  demc-infer report --data data/sample -o report.html
  demc-infer report --model runs/quickstart --data data/sample --baseline oidn=oidn/ -o report.html")]
pub struct Arguments {
    #[command(flatten)]
    scenes: Scenes,
    /// Output file
    #[arg(short, long, value_name = "FILE.html")]
    output: PathBuf,
    #[command(flatten)]
    overwrite: OverwriteFlag,
}

impl Arguments {
    pub fn run(self) -> anyhow::Result<()> {
        self.scenes
            .check_output(&self.output, self.overwrite.overwrite)?;
        let mut page = ReportPage::default();
        let report = self.scenes.score(
            |images, scenes| Ok(images.encode(scenes)?),
            |encoded, score| Ok(page.add(encoded, score)?),
        )?;
        // A page needs an image.
        if report.images.is_empty() {
            return require_all(&report);
        }
        let about = About {
            model: self.scenes.model_name(),
            data: self.scenes.data.display().to_string(),
            split: demc_data::Split::from(self.scenes.split).to_string(),
        };
        let html = page.html(&about, &report)?;
        demc_program::file::write_whole(&self.output, |file| file.write_all(html.as_bytes()))?;
        let summary = format!(
            "{}: {} images, {:.1} MB",
            self.output.display(),
            report.images.len(),
            html.len() as f64 / 1e6
        );
        message::status(printable(&summary));
        require_all(&report)
    }
}
