//! The command line: arguments and dispatch.

mod doctor;
mod index;
mod inspect;
mod merge;
mod number;
mod stats;

use std::ffi::OsString;

use anyhow::Result;
use clap::{CommandFactory, Parser, Subcommand};

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
    Inspect(inspect::Arguments),
    /// Measure a data set: scenes, sizes, patches, and each feature's mean and standard deviation.
    ///
    /// Training normalises features with these numbers. They cover every pixel of the split; normal
    /// and position exclude misses (`mask.A` = 0). The command checks every file's header and reads
    /// the split's files completely.
    Stats(stats::Arguments),
    /// Join the channels of several OpenEXR files in one file.
    ///
    /// `FILE` keeps its channel names; `NAME=FILE` puts `NAME.` before each of them. Samples keep
    /// their types and bits. Attributes of later files are added if the earlier ones lack them. All
    /// files must have one size and data window.
    Merge(merge::Arguments),
    /// Write the manifest.json of a directory of scenes.
    ///
    /// Each OpenEXR file in the directory and below becomes a scene; other files, hidden files, and
    /// linked directories are ignored and counted. Sizes come from the headers. Every file must fit one
    /// layout and have a reference. A base scene must not be in both splits.
    Index(index::Arguments),
    /// Look for mistakes in a data set that training would not report.
    ///
    /// It checks the manifest, exposures, the pixel filter, references, duplicates, and features, and
    /// prints one line per problem: the scenes concerned, what was measured, and the likely cause.
    /// The exit status is 1 if there are problems.
    Doctor(doctor::Arguments),
}

/// The command line's description, for manuals and completions.
pub fn command() -> clap::Command {
    Cli::command()
}

/// Runs the program with its name and arguments. Returns the exit code.
pub fn main(arguments: impl IntoIterator<Item = OsString>) -> u8 {
    demc_program::cli::main(arguments, Cli::run)
}

impl Cli {
    /// Runs the command and returns its exit code; `inspect` has already reported the files that it
    /// could not read.
    ///
    /// # Errors
    /// An error that ended the command and is not yet reported.
    fn run(self) -> Result<u8> {
        match self.command {
            DataCommand::Inspect(command) => command.run(),
            DataCommand::Stats(command) => command.run(),
            DataCommand::Doctor(command) => command.run(),
            DataCommand::Index(command) => command.run(),
            DataCommand::Merge(command) => command.run(),
        }
    }
}
