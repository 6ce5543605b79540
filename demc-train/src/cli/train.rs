//! Training: the default of `demc-train`.

use std::num::NonZero;
use std::path::{Path, PathBuf};

use crate::config::{Config, ConfigError, utf8};
use crate::ranks::Reduce;
use crate::record::progress::say;
use crate::run::run_dir::copy_in_checkpoint;
use crate::run::run_record::CONFIG;
use crate::run::session::{Session, SessionOptions};
use crate::run::signals::Outcome;
use crate::run::training::scores::TestScores;
use clap::Args;
use demc_program::message::printable;

use super::compute::{ComputeArguments, report_stop};

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

    /// With --check: also predict the time of a step on this many MPI ranks, one per node
    #[arg(long, value_name = "N", requires = "check")]
    ranks: Option<NonZero<u16>>,

    /// With --ranks: bandwidth of the network between the nodes, in GB/s
    #[arg(long, value_name = "GB/S", requires = "ranks", default_value_t = 1.25)]
    bandwidth: f64,
}

/// A path in one line.
fn shown(path: &Path) -> String {
    printable(&path.display().to_string())
}

/// The edit that sets the run directory.
fn run_dir_set(dir: &Path) -> Result<String, ConfigError> {
    let dir = toml::Value::String(utf8("--run-dir", dir)?.to_owned());
    Ok(format!("run.dir={dir}"))
}

/// Adds where an intact copy of a run's own configuration is.
fn with_copy(error: ConfigError, config: &Path) -> ConfigError {
    let run = config.parent().filter(|_| config.ends_with(CONFIG));
    let copy = run.and_then(|run| copy_in_checkpoint(run, CONFIG).ok().flatten());
    match copy {
        Some(copy) => ConfigError::Source(format!(
            "{:#}; {} is an intact copy",
            anyhow::Error::new(error),
            copy.display()
        )),
        None => error,
    }
}

/// Trains a run, new or resumed.
pub fn run(arguments: Arguments, reduce: &Reduce) -> anyhow::Result<u8> {
    let mut sets = arguments.set;
    if let Some(dir) = &arguments.run_dir {
        sets.push(reduce.agree(run_dir_set(dir).map_err(Into::into))?);
    }
    let file = arguments.config.expect("clap requires it");
    let config = Config::load(&file, &sets).map_err(|error| with_copy(error, &file));
    let config = reduce.agree(config.map_err(Into::into))?;
    let place = arguments.compute.place(reduce)?;
    let options = SessionOptions {
        resume: arguments.resume,
        check: arguments.check,
    };
    let (root, dir) = (config.data.root.clone(), config.run_dir().to_path_buf());
    let session = Session::open(config, options, &place)?;
    session.check_outputs(&[file])?;
    say(format!("demc-train: {}", session.headline()));
    if let Some(placement) = &session.placement {
        say(placement);
    }
    say(format!("\n{}", session.run().config().to_toml()));
    say(format!("data: {} in {}", session.data, shown(&root)));
    for warning in &session.warnings {
        say(format!("warning: {}", printable(warning)));
    }
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
    if let Some(count) = arguments.ranks {
        say(session.predict(usize::from(count.get()), arguments.bandwidth)?);
    }
    if arguments.check {
        say(match session.warnings.len() {
            0 => "check: configuration and data are valid; nothing was written".to_owned(),
            _ => {
                "check: training is possible, but see the warnings; nothing was written".to_owned()
            }
        });
        return Ok(0);
    }
    say(format!("run: {}\n", shown(&dir)));
    let finished = match session.finish()? {
        Outcome::Complete(finished) => finished,
        Outcome::Stopped(stopped) => return Ok(report_stop(stopped, "--resume resumes the run")),
    };
    say(format!("\n{}", finished.kept));
    match finished.scores {
        Some(TestScores { step, report }) => {
            say(format!("\nTest split, weights of step {step}:\n\n{report}"));
        }
        None => say("\nNo scores: the data set has no test split."),
    }
    say(format!("\nweights, pictures and scores: {}", shown(&dir)));
    Ok(0)
}
