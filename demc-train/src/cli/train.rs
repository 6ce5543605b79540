//! Training: flags to a resolved configuration, and what is printed around a run.

use std::path::PathBuf;
use std::process::ExitCode;

use clap::Args;
use demc_train::config::Config;
use demc_train::progress::say;
use demc_train::session::{Manner, Outcome, Session};

use super::{ComputeArguments, run_dir_set, stopped};

/// What a training is told.
#[derive(Debug, Args)]
pub struct Arguments {
    /// Configuration of the run
    // Optional beside a verb alone.
    #[arg(short, long, value_name = "FILE", required = true)]
    config: Option<PathBuf>,

    /// Directory of the run, instead of the configuration's run.dir (default: runs/ and the configuration's name)
    #[arg(short, long, value_name = "DIR")]
    run_dir: Option<PathBuf>,

    /// Continue the run in the run directory from its latest checkpoint, bit for bit
    #[arg(long)]
    resume: bool,

    #[command(flatten)]
    compute: ComputeArguments,

    /// Change a key of the configuration, such as train.steps=1000; can be given several times
    #[arg(short, long, value_name = "KEY=VALUE")]
    set: Vec<String>,

    /// Check configuration and data, tell how long the run will take, and stop; nothing is written
    #[arg(long)]
    check: bool,
}

/// Trains, or goes on.
pub fn run(arguments: Arguments) -> anyhow::Result<ExitCode> {
    let mut sets = arguments.set;
    sets.extend(arguments.run_dir.as_deref().map(run_dir_set));
    let config = arguments.config.expect("clap asks for it");
    let config = Config::load(&config, &sets)?;
    let device = arguments.compute.device()?;
    let manner = Manner {
        resume: arguments.resume,
        check: arguments.check,
    };
    let (root, dir) = (config.data.root.clone(), config.run.dir.clone());
    let session = Session::open(config, manner, &device, &arguments.compute.device)?;
    say(format!("demc-train: {}", session.headline()));
    say(format!("\n{}", session.run().config().to_toml()));
    say(format!("data: {} in {}", session.data, root.display()));
    for note in &session.notes {
        say(format!("note: {note}"));
    }
    let run = session.run();
    say(format!(
        "network: {} trainable parameters",
        run.parameters()
    ));
    say(format!(
        "patches: {} an epoch, {} a step",
        run.patches(),
        run.patches_per_step()
    ));
    if arguments.check {
        say("check: all is well; nothing was written");
        return Ok(ExitCode::SUCCESS);
    }
    say(format!("run: {}\n", dir.display()));
    match session.finish()? {
        Outcome::Stopped { signal, step } => return Ok(stopped(signal, step, "--resume goes on")),
        Outcome::Scored(Some((step, report))) => {
            say(format!("\nTest split, weights of step {step}:\n\n{report}"));
        }
        Outcome::Scored(None) => say("\nThe data set has no test split: nothing to score."),
    }
    say(format!("\nweights, pictures and scores: {}", dir.display()));
    Ok(ExitCode::SUCCESS)
}
