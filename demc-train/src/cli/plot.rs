//! `demc-train plot`: the curves of runs.

use std::path::PathBuf;
use std::process::ExitCode;

use clap::Args;
use demc_train::plot::{PlotOptions, plot};
use demc_train::progress::say;

/// Draw loss and validation curves of one or many runs to SVG and PNG
///
/// Panels over the steps: training loss (smoothed, the raw values pale beneath), and validation RelMSE and SSIM where a run has any.
/// A run that is still going can be drawn at any time.
#[derive(Debug, Args)]
pub struct Arguments {
    /// Run directories
    #[arg(required = true, value_name = "RUN")]
    runs: Vec<PathBuf>,

    /// Files to write, without ending (default: curves in the first run)
    #[arg(short, long, value_name = "STEM")]
    out: Option<PathBuf>,

    /// How much of the training loss's curve comes from the lines before, 0 to below 1
    #[arg(long, value_name = "WEIGHT", default_value_t = 0.9)]
    smooth: f64,

    /// Linear instead of logarithmic axes for loss and RelMSE
    #[arg(long)]
    linear: bool,
}

/// Draws.
pub fn run(arguments: Arguments) -> anyhow::Result<ExitCode> {
    let Arguments {
        runs,
        out,
        smooth,
        linear,
    } = arguments;
    let stem = out.unwrap_or_else(|| runs[0].join("curves"));
    let [svg, png] = plot(&runs, &stem, &PlotOptions { smooth, linear })?;
    say(format!("{}\n{}", svg.display(), png.display()));
    Ok(ExitCode::SUCCESS)
}
