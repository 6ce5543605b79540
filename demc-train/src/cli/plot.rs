//! `demc-train plot`: draws the curves of runs.

use std::path::PathBuf;

use crate::record::progress::say;
use crate::tools::chart::with_extension;
use crate::tools::plot::{PlotOptions, plot};
use clap::Args;
use demc_infer::bundle::locate;
use demc_program::cli::OverwriteFlag;
use demc_program::message::printable;
use demc_program::output::{Directories, Outputs};

/// Draw loss and validation curves of one or more runs as SVG
///
/// Panels: training loss (smoothed, raw values in a pale colour), validation RelMSE and SSIM. A run
/// in progress can be drawn too.
#[derive(Debug, Args)]
pub struct Arguments {
    /// Run directories
    #[arg(required = true, value_name = "RUN")]
    runs: Vec<PathBuf>,

    /// Output file, with or without .svg (default: curves.svg in the first run, which is replaced)
    #[arg(short, long, value_name = "FILE")]
    out: Option<PathBuf>,

    #[command(flatten)]
    overwrite: OverwriteFlag,

    /// Smoothing of the training loss: weight of earlier values, 0 to below 1
    #[arg(long, value_name = "WEIGHT", default_value_t = 0.9)]
    smooth: f64,

    /// Linear instead of logarithmic axes for loss and RelMSE
    #[arg(long)]
    linear: bool,
}

/// Draws the curves.
pub fn run(arguments: Arguments) -> anyhow::Result<u8> {
    let Arguments {
        runs,
        out,
        overwrite,
        smooth,
        linear,
    } = arguments;
    let replaces = overwrite.overwrite || out.is_none();
    let stem = out.unwrap_or_else(|| runs[0].join("curves"));
    let mut outputs = Outputs::default();
    for file in runs.iter().flat_map(|run| locate::files(run)) {
        outputs.protect(&file, "a file of a run");
    }
    outputs.claim(&with_extension(&stem, "svg")?, replaces)?;
    outputs.prepare(Directories::Expect)?;
    let drawn = plot(&runs, &stem, &PlotOptions { smooth, linear })?;
    for note in drawn.notes {
        say(format!("note: {}", printable(&note)));
    }
    say(printable(&drawn.path.display().to_string()));
    Ok(0)
}
