//! `demc-train ablate`: which variant is better, and by how much.

use std::path::PathBuf;
use std::process::ExitCode;

use clap::Args;
use demc_train::ablation::{self, Ended, Spec};
use demc_train::progress::say;

use super::{ComputeArguments, stopped};

/// Train variants alike, from several seeds each, and compare them on the test split
///
/// The file names a base configuration, seeds and variants (see configs/ablation.toml). Complete runs are not trained again
/// and one that was stopped goes on, so the same command continues an ablation. It ends with ablation.md, .csv, .json, .svg
/// and .png in the ablation's directory.
#[derive(Debug, Args)]
pub struct Arguments {
    /// The ablation
    #[arg(short, long, value_name = "FILE")]
    config: PathBuf,

    /// Directory of the runs and of the result, instead of the file's
    #[arg(short, long, value_name = "DIR")]
    run_dir: Option<PathBuf>,

    #[command(flatten)]
    compute: ComputeArguments,

    /// Change a key of every variant's configuration, such as train.steps=1000; can be given several times
    #[arg(short, long, value_name = "KEY=VALUE")]
    set: Vec<String>,
}

/// Trains and compares.
pub fn run(arguments: Arguments) -> anyhow::Result<ExitCode> {
    let mut spec = Spec::load(&arguments.config, &arguments.set)?;
    if let Some(dir) = arguments.run_dir {
        spec.dir = dir;
    }
    let device = arguments.compute.device()?;
    for variant in &spec.variants {
        let model = &variant.config.model;
        say(format!(
            "{}: {model}, {} parameters, {:.0} GFLOP for a megapixel",
            variant.name,
            model.parameter_count(),
            model.flops_per_pixel() / 1e3
        ));
    }
    for difference in spec.differences() {
        say(format!("note: not only the network differs: {difference}"));
    }
    match ablation::run(&spec, &device, &arguments.compute.device)? {
        Ended::Stopped { signal, step } => Ok(stopped(signal, step, "the same command goes on")),
        Ended::Done(comparison) => {
            let paths = ablation::write(&comparison, &spec.dir)?;
            say(format!("\n{}", ablation::markdown(&comparison)));
            for path in paths {
                say(path.display());
            }
            Ok(ExitCode::SUCCESS)
        }
    }
}
