//! The command line: flags, exit codes, and what is printed where.
//!
//! Results go to stdout, progress and errors to stderr. Exit code 0: done; 1: the run, or a file of it, failed; 2: the
//! command line asks for something that cannot be.

mod check;
mod cost;
mod denoise;
mod evaluate;
mod export;
mod import;
mod inputs;
mod inspect;
mod jobs;
mod report;
mod scenes;
mod tiling;
mod writing;

use std::fs;
use std::path::{Path, PathBuf};

use clap::{Args, Parser, Subcommand};
use demc_infer::compute::ComputeFlags;
use demc_infer::{Bundle, BundleError, BundleFile, Ensemble, device};

/// Use a trained DEMC network: denoise renders, score it, move its weights out and in.
#[derive(Parser)]
#[command(
    version,
    after_help = "MODEL is a run directory of demc-train (its best weights), a checkpoint \
    directory, or a file that `export` wrote.\n\nExit code: 0 done, 1 something failed, 2 wrong command line."
)]
pub struct Arguments {
    #[command(subcommand)]
    command: Command,
}

#[derive(Subcommand)]
enum Command {
    Denoise(denoise::Denoise),
    Cost(cost::Cost),
    Check(check::Check),
    Evaluate(evaluate::Evaluate),
    Export(export::Export),
    Import(import::Import),
    Inspect(inspect::Inspect),
    Report(report::Report),
}

/// Something asked for on the command line that cannot be: exit code 2.
#[derive(Debug, thiserror::Error)]
#[error("{0}")]
pub struct Usage(String);

/// Runs the command.
pub fn run(arguments: Arguments) -> anyhow::Result<()> {
    match arguments.command {
        Command::Denoise(command) => command.run(),
        Command::Cost(command) => command.run(),
        Command::Check(command) => command.run(),
        Command::Evaluate(command) => command.run(),
        Command::Export(command) => command.run(),
        Command::Import(command) => command.run(),
        Command::Inspect(command) => command.run(),
        Command::Report(command) => command.run(),
    }
}

/// `--model`, which every command has.
#[derive(Args)]
struct Model {
    /// Run directory, checkpoint directory or exported file [default: the model that comes with the program, models/README.md]
    #[arg(long = "model", value_name = "MODEL")]
    path: Option<PathBuf>,
}

/// The model that comes with the program; `models/README.md` is its card.
const OWN_MODEL: &[u8] = include_bytes!("../../../models/demc.safetensors");
/// What errors and `inspect` call it.
const OWN_MODEL_NAME: &str = "the model that comes with demc-infer";

/// `--device` and how it computes, for the commands that do.
#[derive(Args)]
struct DeviceFlag {
    /// What computes: flex (CPU, always there), or ndarray, wgpu[:N], cuda[:N] where built in
    #[arg(long = "device", value_name = "DEVICE", default_value = "flex")]
    name: String,
    #[command(flatten)]
    compute: ComputeFlags,
}

/// `--ensemble`, for the commands that denoise.
#[derive(Args)]
struct EnsembleFlag {
    /// Denoise an image as it is (1), and its mirror images (4), and those with rows as columns (8), and take the mean: a little
    /// better, and as many times slower
    #[arg(long = "ensemble", value_name = "LOOKS", default_value = "1")]
    looks: Ensemble,
}

impl Model {
    /// Reads the file that was named, or the program's own.
    fn read(&self) -> Result<BundleFile, BundleError> {
        match &self.path {
            Some(path) => BundleFile::read(path),
            None => BundleFile::parse(OWN_MODEL_NAME.into(), OWN_MODEL),
        }
    }

    /// Loads onto the device called `name`.
    fn load_onto(&self, device: &DeviceFlag) -> anyhow::Result<Bundle> {
        let usage = |error: &dyn std::error::Error| Usage(error.to_string());
        device.compute.apply().map_err(|error| usage(&error))?;
        let device = device::parse(&device.name).map_err(|error| usage(&error))?;
        Ok(self.read()?.into_bundle(&device)?)
    }
}

/// Counts negative radiance, to be reported once whatever the number of images.
#[derive(Default)]
struct Clamped {
    samples: usize,
    images: usize,
}

impl Clamped {
    /// An image with `samples` negative values that were set to 0.
    fn count(&mut self, samples: usize) {
        self.samples += samples;
        self.images += usize::from(samples > 0);
    }

    /// Says it on stderr, if there is anything to say.
    fn report(self) {
        let Self { samples, images } = self;
        if samples > 0 {
            eprintln!("note: {samples} negative radiance sample(s) in {images} image(s) set to 0");
        }
    }
}

/// Refuses an output that would replace an input: `inputs` are files and what a message calls them.
fn not_an_input(output: &Path, inputs: &[(&Path, &str)]) -> Result<(), Usage> {
    let Ok(target) = fs::canonicalize(output) else {
        return Ok(());
    };
    for (input, name) in inputs {
        if fs::canonicalize(input).is_ok_and(|input| input == target) {
            let output = output.display();
            return Err(Usage(format!("output {output} would replace {name}")));
        }
    }
    Ok(())
}

/// Writes `text` and a line end to stdout for `-`, else to a file.
fn write_text(path: &Path, text: &str) -> anyhow::Result<()> {
    if path == Path::new("-") {
        return print(text);
    }
    demc_data::file::write_whole(path, |file| {
        std::io::Write::write_all(file, format!("{text}\n").as_bytes())
    })?;
    Ok(())
}

/// Prints a line to stdout. A reader that has heard enough (`| head`) is no failure.
fn print(text: &str) -> anyhow::Result<()> {
    use std::io::{ErrorKind, Write};
    match writeln!(std::io::stdout(), "{text}") {
        Err(error) if error.kind() != ErrorKind::BrokenPipe => Err(error.into()),
        _ => Ok(()),
    }
}
