//! `demc-train ablate`: compares variants.

use std::path::PathBuf;

use crate::config::utf8;
use crate::ranks::Reduce;
use crate::record::progress::say;
use crate::run::signals::Outcome;
use crate::tools::ablation;
use crate::tools::ablation::comparison::Comparison;
use crate::tools::ablation::spec::AblationSpec;
use clap::Args;
use demc_program::message::printable;

use super::compute::{ComputeArguments, report_stop};

/// Train variants with several seeds each and compare them on the test split
///
/// The file names a base configuration, seeds and variants (see configs/ablation.toml). Rerun the
/// command to resume an ablation: complete runs are not repeated. Writes results.csv,
/// ablation.md, .json and .svg, and bars.svg to the directory of the ablation.
#[derive(Debug, Args)]
pub struct Arguments {
    /// File of the ablation
    #[arg(short, long, value_name = "FILE", required_unless_present = "results")]
    config: Option<PathBuf>,

    /// Train nothing: make the tables and the figure beside FILE, a results.csv, again
    #[arg(long, value_name = "FILE", conflicts_with_all = ["config", "run_dir", "set"])]
    results: Option<PathBuf>,

    /// Directory of the runs and the results, instead of dir in the file
    #[arg(short, long, value_name = "DIR")]
    run_dir: Option<PathBuf>,

    #[command(flatten)]
    compute: ComputeArguments,

    /// Override a key of every variant, such as train.steps=1000; KEY= removes it; can be repeated
    #[arg(short, long, value_name = "KEY=VALUE")]
    set: Vec<String>,
}

/// Trains and compares the variants.
pub fn run(arguments: Arguments, reduce: &Reduce) -> anyhow::Result<u8> {
    if let Some(results) = arguments.results {
        let (comparison, paths) = ablation::remake(&results)?;
        report(&comparison, paths);
        return Ok(0);
    }
    let config = arguments.config.expect("required without results");
    let spec = AblationSpec::load(&config, &arguments.set);
    let mut spec = reduce.agree(spec.map_err(Into::into))?;
    if let Some(dir) = arguments.run_dir {
        spec.dir = utf8("--run-dir", &dir)?.into();
    }
    let place = arguments.compute.place(reduce)?;
    for variant in &spec.variants {
        let model = &variant.config.model;
        say(format!(
            "{}: {model}, {} parameters, {:.0} GFLOP per megapixel",
            variant.name,
            model.parameter_count(),
            model.flops_per_pixel() / 1e3
        ));
    }
    for difference in spec.differences() {
        say(format!("note: not only the network differs: {difference}"));
    }
    match ablation::run(&spec, &place)? {
        Outcome::Stopped(stopped) => Ok(report_stop(stopped, "rerun the command to resume")),
        Outcome::Complete(None) => Ok(0),
        Outcome::Complete(Some(comparison)) => {
            let paths = ablation::write(&comparison, &spec.dir)?;
            report(&comparison, paths);
            Ok(0)
        }
    }
}

fn report(comparison: &Comparison, paths: [PathBuf; 4]) {
    say(format!("\n{}", ablation::markdown(comparison)));
    for path in paths {
        say(printable(&path.display().to_string()));
    }
}
