//! `demc-infer evaluate`: prints a table of scores for a data set's split.

use std::path::{Path, PathBuf};

use clap::Args;
use demc_model::metrics::{self, METRICS, Metric};
use demc_program::cli::OverwriteFlag;
use demc_program::exit::UsageError;
use demc_program::message;
use serde::Serialize;

use super::outputs::write_text;
use super::scenes::{Scenes, require_all};
use crate::Report;
use crate::evaluate::Difference;

/// Score a model on images with references: RelMSE and SSIM of the noisy, an all-black and the
/// denoised image.
///
/// Prints a table. The last row is the mean over images. At few samples per pixel, the black image
/// often scores better than the noisy one, so compare with both. A score near the reference's
/// residual has no meaning.
///
/// The data set's manifest and headers are checked first. A scene that cannot be read or scored is
/// then reported and skipped, and the exit code is 1.
///
/// --baseline adds other programs' images of the same scenes. Differences from them are paired by
/// image, with 95 % intervals over base scenes.
#[derive(Args)]
#[command(after_help = "Examples:
  demc-infer evaluate --model runs/quickstart --data data/sample
  demc-infer evaluate --data data/sample --metrics smape,flip --baseline oidn=oidn/
  demc-infer evaluate --model runs/quickstart --data data/sample --json - | jq .mean")]
pub struct Arguments {
    #[command(flatten)]
    scenes: Scenes,
    /// Metrics in addition to RelMSE and SSIM: `all`, or some of relmse@afgsa, relmse@sbmc,
    /// mrse@pbrt, relmse-trimmed, smape, psnr, flip, energy-bias
    #[arg(long, value_name = "A,B", value_delimiter = ',')]
    metrics: Vec<String>,
    /// Write all metrics as JSON to FILE; `-` prints them on stdout instead of the table
    #[arg(long, value_name = "FILE")]
    json: Option<PathBuf>,
    #[command(flatten)]
    overwrite: OverwriteFlag,
}

#[derive(Serialize)]
struct ScoresJson<'a> {
    #[serde(flatten)]
    report: &'a Report,
    #[serde(skip_serializing_if = "Vec::is_empty")]
    differences: Vec<Difference>,
}

impl Arguments {
    pub fn run(self) -> anyhow::Result<()> {
        let more = find_metrics(&self.metrics)?;
        if let Some(path) = self.json.as_deref().filter(|path| *path != Path::new("-")) {
            self.scenes.check_output(path, self.overwrite.overwrite)?;
        }
        let report = self.scenes.score(|_, _| Ok(()), |(), _| Ok(()))?;
        // The table comes first, so that a failed write does not lose it.
        if self.json.as_deref() != Some(Path::new("-")) && !report.images.is_empty() {
            let headlines = METRICS[..2].iter().map(|metric| metric.name);
            let more_names = more.iter().map(|metric| metric.name);
            let names: Vec<_> = headlines.chain(more_names).collect();
            let mut text = report.table(&more);
            for sentence in report.sentences(&names) {
                text += &format!("\n\n{sentence}.");
            }
            message::result(&text)?;
        }
        if let Some(path) = &self.json {
            let mut differences = report.differences();
            differences.retain(|difference| difference.against != "noisy");
            let json = ScoresJson {
                report: &report,
                differences,
            };
            write_text(path, &message::json(&json)?)?;
        }
        require_all(&report)
    }
}

fn find_metrics(names: &[String]) -> Result<Vec<&'static Metric>, UsageError> {
    if names.iter().any(|name| name == "all") {
        return Ok(METRICS[2..].iter().collect());
    }
    let mut found: Vec<&Metric> = Vec::new();
    for name in names {
        let known = METRICS.map(|metric| metric.name).join(", ");
        let metric = metrics::find(name).ok_or_else(|| {
            UsageError(format!(
                "--metrics: unknown metric {name:?}; known: {known}"
            ))
        })?;
        let is_new = found.iter().all(|other| other.name != metric.name);
        if is_new && METRICS[2..].iter().any(|other| other.name == metric.name) {
            found.push(metric);
        }
    }
    Ok(found)
}
