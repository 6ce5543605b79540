//! `demc-infer evaluate`: a table of scores over a data set's split.

use std::path::{Path, PathBuf};

use clap::Args;
use demc_infer::Report;
use demc_infer::evaluate::Difference;
use demc_model::metrics::{self, METRICS, Metric};
use serde::Serialize;

use super::Usage;
use super::scenes::Scenes;

/// Score a model on images with references: RelMSE and SSIM of the noisy, a black and the denoised image.
///
/// Prints a table; the last row is the mean over images. A score near the reference's own residual means nothing,
/// and neither does being better than the noisy image: compare with the black one, or with other programs' images by
/// --baseline. Differences from those are paired by image, with a 95 % bootstrap interval.
#[derive(Args)]
#[command(after_help = "Examples:
  demc-infer evaluate --model runs/quickstart --data data/sample
  demc-infer evaluate --data data/sample --metrics smape,flip --baseline oidn=oidn/
  demc-infer evaluate --model runs/quickstart --data data/sample --json - | jq .mean")]
pub struct Evaluate {
    #[command(flatten)]
    scenes: Scenes,
    /// Columns beside RelMSE and SSIM: `all`, or some of relmse@afgsa, relmse@sbmc, mrse@pbrt, relmse-trimmed, smape,
    /// psnr, flip, energy-bias
    #[arg(long, value_name = "A,B", value_delimiter = ',')]
    metrics: Vec<String>,
    /// Write the scores in all metrics as JSON to FILE; `-` for stdout, in place of the table
    #[arg(long, value_name = "FILE")]
    json: Option<PathBuf>,
}

/// What `--json` writes.
#[derive(Serialize)]
struct Json<'a> {
    #[serde(flatten)]
    report: &'a Report,
    #[serde(skip_serializing_if = "Vec::is_empty")]
    differences: Vec<Difference>,
}

impl Evaluate {
    /// Scores every scene of the split.
    pub fn run(self) -> anyhow::Result<()> {
        let more = chosen(&self.metrics)?;
        let report = self.scenes.score(|_, _| Ok(()), |(), _| Ok(()))?;
        // The table first: it is not lost where the file cannot be written.
        if self.json.as_deref() != Some(Path::new("-")) {
            let headlines = METRICS[..2].iter().map(|metric| metric.name);
            let more_names = more.iter().map(|metric| metric.name);
            let names: Vec<_> = headlines.chain(more_names).collect();
            let mut text = report.table(&more);
            for sentence in report.sentences(&names) {
                text += &format!("\n\n{sentence}.");
            }
            super::print(&text)?;
        }
        let Some(path) = &self.json else {
            return Ok(());
        };
        let mut differences = report.differences();
        differences.retain(|difference| difference.against != "noisy");
        let json = Json {
            report: &report,
            differences,
        };
        super::write_text(path, &serde_json::to_string_pretty(&json)?)
    }
}

/// The metrics of these names; all but the headlines for `all`.
fn chosen(names: &[String]) -> Result<Vec<&'static Metric>, Usage> {
    if names.iter().any(|name| name == "all") {
        return Ok(METRICS[2..].iter().collect());
    }
    let mut found: Vec<&Metric> = Vec::new();
    for name in names {
        let known = METRICS.map(|metric| metric.name).join(", ");
        let metric = metrics::find(name)
            .ok_or_else(|| Usage(format!("--metrics: no metric {name:?}; there are {known}")))?;
        let is_new = found.iter().all(|other| other.name != metric.name);
        if is_new && METRICS[2..].iter().any(|other| other.name == metric.name) {
            found.push(metric);
        }
    }
    Ok(found)
}
