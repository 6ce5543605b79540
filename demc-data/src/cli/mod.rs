//! The command line: arguments and dispatch.

mod doctor;
mod index;
mod inspect;
mod merge;
mod stats;

use std::ffi::OsString;
use std::path::PathBuf;

use crate::message::UsageError;
use crate::output::OutputError;
use crate::{Split, message};
use anyhow::Result;
use clap::{Args, CommandFactory, Parser, Subcommand};

/// Prepares and inspects images and data sets for training a DEMC denoiser.
///
/// Exit status: 0 success, 1 a file or data set cannot be used, 2 wrong arguments.
#[derive(Parser)]
#[command(version, max_term_width = 100)]
struct Cli {
    #[command(subcommand)]
    command: DataCommand,
}

#[derive(Subcommand)]
enum DataCommand {
    /// Show the contents of OpenEXR files: size, channels, and each channel's type and range.
    ///
    /// Channel names appear as a channel layout must spell them: `Layer.channel` in a file of
    /// several parts. Minimum, maximum and mean exclude NaN and infinite samples; the last column
    /// counts these. Training and denoising refuse a file that has any. A file that cannot be read
    /// is reported; the other files are shown, and the exit status is 1.
    Inspect(InspectArguments),
    /// Measure a data set: scenes, sizes, patches, and each feature's mean and standard deviation.
    ///
    /// Training normalises features with these numbers. They cover every pixel of the split; normal
    /// and position exclude misses (`mask.A` = 0). The command checks every file's header and reads
    /// the split's files completely.
    Stats(StatsArguments),
    /// Join the channels of several OpenEXR files in one file.
    ///
    /// `FILE` keeps its channel names; `NAME=FILE` puts `NAME.` before each of them. Samples keep
    /// their types and bits. Attributes of later files are added if the earlier ones lack them. All
    /// files must have one size and data window.
    Merge(MergeArguments),
    /// Write the manifest.json of a directory of scenes.
    ///
    /// Each OpenEXR file in the directory and below becomes a scene; other files, hidden files, and
    /// linked directories are ignored and counted. Sizes come from the headers. Every file must fit one
    /// layout and have a reference. A base scene must not be in both splits.
    Index(IndexArguments),
    /// Look for mistakes in a data set that training would not report.
    ///
    /// It checks the manifest, exposures, the pixel filter, references, duplicates, and features, and
    /// prints one line per problem: the scenes concerned, what was measured, and the likely cause.
    /// The exit status is 1 if there are problems.
    Doctor(DoctorArguments),
}

#[derive(Args)]
#[command(after_help = "Example:\n  demc-data inspect data/sample/train/*.exr")]
struct InspectArguments {
    /// OpenEXR files: half, float or uint channels, one part or several, scan lines or tiles
    #[arg(required = true, value_name = "FILE")]
    files: Vec<PathBuf>,
    /// Print one JSON array instead of tables
    #[arg(long)]
    json: bool,
}

#[derive(Args)]
#[command(
    after_help = "Examples:\n  demc-data stats data/sample\n  demc-data stats renders --layout my-renderer.toml --json"
)]
struct StatsArguments {
    /// Directory of the data set, with its manifest.json
    #[arg(value_name = "DIR")]
    root: PathBuf,
    /// Channel layout: demc-exr, mitsuba3, pbrt-v4, cycles, luxcore, fbksd, or a TOML file
    #[arg(long, default_value = "demc-exr")]
    layout: String,
    /// The split to measure
    #[arg(long, default_value = "train", value_parser = parse_split, value_name = "train|test")]
    split: Split,
    /// Print one JSON object instead of a table
    #[arg(long)]
    json: bool,
}

#[derive(Args)]
#[command(
    after_help = "Example:\n  demc-data merge -o scene.exr noisy.exr albedo=noisy.albedo.exr ref=reference.exr"
)]
struct MergeArguments {
    /// The file to write
    #[arg(short, long, value_name = "OUT.exr")]
    output: PathBuf,
    /// Files to join; a path with `=` in its first directory or name is written as `./PATH`
    #[arg(required = true, value_name = "[NAME=]FILE")]
    files: Vec<OsString>,
    /// Remove `LAYER.` from the channel names of files with a NAME, such as ViewLayer.Combined
    #[arg(long, value_name = "LAYER")]
    strip: Option<String>,
    /// Replace an existing output
    #[arg(long)]
    overwrite: bool,
}

#[derive(Args)]
#[command(after_help = "Example:\n  demc-data doctor data/sample")]
struct DoctorArguments {
    /// Directory of the data set, with its manifest.json
    #[arg(value_name = "DIR")]
    root: PathBuf,
    /// Channel layout: a preset or a TOML file; by default the preset that fits the first file
    #[arg(long, value_name = "PRESET|FILE")]
    layout: Option<String>,
    /// Patch size of training in pixels
    #[arg(long, default_value_t = 128, value_name = "PIXELS")]
    patch_size: usize,
    /// Print one JSON object instead of lines
    #[arg(long)]
    json: bool,
}

#[derive(Args)]
#[command(
    after_help = "Examples:\n  demc-data index renders --test 'kitchen*'\n  demc-data index renders --test 'bath/*' --base '^([^/]+)/'"
)]
struct IndexArguments {
    /// Directory of the scenes
    #[arg(value_name = "DIR")]
    root: PathBuf,
    /// Glob pattern of the test scenes: relative paths or file names (repeatable)
    #[arg(long, value_name = "PATTERN")]
    test: Vec<String>,
    /// Regular expression whose only group is the base scene, searched in the relative path without
    /// extension; by default the file name without the number at its end
    #[arg(long, value_name = "REGEX")]
    base: Option<String>,
    /// Channel layout: a preset or a TOML file; by default the preset that fits each file
    #[arg(long, value_name = "PRESET|FILE")]
    layout: Option<String>,
    /// Replace an existing manifest; keys of its scenes that this command does not set stay
    #[arg(long)]
    overwrite: bool,
}

/// The command line's description, for manuals and completions.
pub fn command() -> clap::Command {
    Cli::command()
}

/// Runs the program with its name and arguments. Returns the exit code.
pub fn main(arguments: impl IntoIterator<Item = OsString>) -> u8 {
    let cli = match Cli::try_parse_from(arguments) {
        Ok(cli) => cli,
        Err(shown) => return message::usage(&shown),
    };
    if let Some(note) = &crate::parallel::threads().note {
        message::say(format_args!("note: {note}"));
    }
    match cli.run() {
        Ok(status) => status,
        Err(error) => {
            report(&error);
            let refused = error.downcast_ref().is_some_and(OutputError::is_usage);
            if error.is::<UsageError>() || refused {
                2
            } else {
                1
            }
        }
    }
}

impl Cli {
    /// Runs the command and returns its exit status; `inspect` has already reported the files that
    /// it could not read.
    ///
    /// # Errors
    /// An error that ended the command and is not yet reported.
    fn run(self) -> Result<u8> {
        match self.command {
            DataCommand::Inspect(args) => inspect::run(&args.files, args.json),
            DataCommand::Stats(args) => {
                stats::run(&args.root, &args.layout, args.split, args.json).map(|()| 0)
            }
            DataCommand::Doctor(args) => doctor::run(
                &args.root,
                args.layout.as_deref(),
                args.patch_size,
                args.json,
            ),
            DataCommand::Index(args) => index::run(&args).map(|()| 0),
            DataCommand::Merge(args) => merge::run(&args).map(|()| 0),
        }
    }
}

/// Prints an error as one line on standard error.
fn report(error: &anyhow::Error) {
    message::say(format_args!("error: {error:#}"));
}

fn parse_split(text: &str) -> Result<Split, String> {
    match text {
        "train" => Ok(Split::Train),
        "test" => Ok(Split::Test),
        _ => Err("expected train or test".to_owned()),
    }
}

/// About six significant digits, in at most eleven characters.
fn number(value: f64) -> String {
    match value.abs() {
        0.0 => "0".to_owned(),
        1e-4..1e6 => format!("{value:.5}"),
        _ => format!("{value:.4e}"),
    }
}
