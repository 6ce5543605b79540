//! Training: the default of `demc-train`.

use std::path::{Path, PathBuf};
use std::process::ExitCode;

use clap::Args;
use demc_data::message::printable;
use demc_train::config::Config;
use demc_train::record::progress::say;
use demc_train::run::session::{Session, SessionOptions, SessionOutcome};

use super::compute::{ComputeArguments, stopped};

/// Arguments of a training.
#[derive(Debug, Args)]
pub struct Arguments {
    /// Configuration of the run
    // Absent only with a subcommand.
    #[arg(short, long, value_name = "FILE", required = true)]
    config: Option<PathBuf>,

    /// Run directory, instead of run.dir in the configuration (default: runs/ and the
    /// configuration's name)
    #[arg(short, long, value_name = "DIR")]
    run_dir: Option<PathBuf>,

    /// Resume the run in the run directory from its latest checkpoint, bit for bit
    #[arg(long)]
    resume: bool,

    #[command(flatten)]
    compute: ComputeArguments,

    /// Override a key of the configuration, such as train.steps=1000; KEY= removes it; can be
    /// repeated
    #[arg(short, long, value_name = "KEY=VALUE")]
    set: Vec<String>,

    /// Check configuration and data and print the estimated duration; writes nothing
    #[arg(long)]
    check: bool,
}

/// A path in one line.
fn shown(path: &Path) -> String {
    printable(&path.display().to_string())
}

/// The edit that sets the run directory.
fn run_dir_set(dir: &Path) -> String {
    let dir = toml::Value::String(dir.to_string_lossy().into_owned());
    format!("run.dir={dir}")
}

/// Trains a run, new or resumed.
pub fn run(arguments: Arguments) -> anyhow::Result<ExitCode> {
    let mut sets = arguments.set;
    sets.extend(arguments.run_dir.as_deref().map(run_dir_set));
    let config = arguments.config.expect("clap requires it");
    let config = Config::load(&config, &sets)?;
    let device = arguments.compute.device()?;
    let options = SessionOptions {
        resume: arguments.resume,
        check: arguments.check,
    };
    let (root, dir) = (config.data.root.clone(), config.run_dir().to_path_buf());
    let session = Session::open(config, options, &device, &arguments.compute.device)?;
    say(format!("demc-train: {}", session.headline()));
    say(format!("\n{}", session.run().config().to_toml()));
    say(format!("data: {} in {}", session.data, shown(&root)));
    for note in &session.notes {
        say(format!("note: {}", printable(note)));
    }
    let run = session.run();
    say(format!(
        "network: {} trainable parameters",
        run.parameters()
    ));
    say(format!(
        "patches: {} per epoch, {} per step",
        run.patches(),
        run.config().patches_per_step()
    ));
    if arguments.check {
        say("check: configuration and data are valid; nothing was written");
        return Ok(ExitCode::SUCCESS);
    }
    say(format!("run: {}\n", shown(&dir)));
    match session.finish()? {
        SessionOutcome::Stopped { signal, step } => {
            return Ok(stopped(signal, step, "--resume resumes the run"));
        }
        SessionOutcome::Complete { kept, scores } => {
            say(format!("\n{kept}"));
            match scores {
                Some((step, report)) => {
                    say(format!("\nTest split, weights of step {step}:\n\n{report}"));
                }
                None => say("\nNo scores: the data set has no test split."),
            }
        }
    }
    say(format!("\nweights, pictures and scores: {}", shown(&dir)));
    Ok(ExitCode::SUCCESS)
}
