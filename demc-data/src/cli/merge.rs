//! `demc-data merge`.

use std::ffi::OsString;
use std::path::PathBuf;

use anyhow::Result;
use clap::Args;
use demc_program::cli::OverwriteFlag;
use demc_program::exit::{self, UsageError};
use demc_program::message::{self, printable};
use demc_program::output::{Directories, Outputs};

use crate::image::exr::ExrFile;
use crate::image::exr::merge::{MergeInput, merge};

#[derive(Args)]
#[command(
    after_help = "Example:\n  demc-data merge -o scene.exr noisy.exr albedo=noisy.albedo.exr ref=reference.exr"
)]
pub struct Arguments {
    /// The file to write
    #[arg(short, long, value_name = "OUT.exr")]
    output: PathBuf,
    /// Files to join; a path with `=` in its first directory or name is written as `./PATH`
    #[arg(required = true, value_name = "[NAME=]FILE")]
    files: Vec<OsString>,
    /// Remove `LAYER.` from the channel names of files with a NAME, such as ViewLayer.Combined
    #[arg(long, value_name = "LAYER")]
    strip: Option<String>,
    #[command(flatten)]
    overwrite: OverwriteFlag,
}

/// A file argument: `FILE` or `NAME=FILE`.
#[derive(Debug, PartialEq, Eq)]
struct Source {
    prefix: Option<String>,
    path: PathBuf,
}

impl Arguments {
    /// Joins the files and prints one line.
    pub fn run(&self) -> Result<u8> {
        let output = self.output.as_path();
        let sources: Vec<Source> = self
            .files
            .iter()
            .map(Source::parse)
            .collect::<Result<_, _>>()?;
        let mut outputs = Outputs::default();
        for Source { path, .. } in &sources {
            outputs.protect(path, &format!("the input {}", path.display()));
        }
        outputs.claim(output, self.overwrite.overwrite)?;
        outputs.prepare(Directories::Expect)?;
        let mut inputs = Vec::with_capacity(sources.len());
        for Source { prefix, path } in sources {
            let file = ExrFile::open(&path)?;
            // Files without a name keep their channels' names.
            let strip = self.strip.clone().filter(|_| prefix.is_some());
            inputs.push(MergeInput {
                file,
                prefix,
                strip,
            });
        }
        if let Some(strip) = &self.strip {
            let start = format!("{strip}.");
            let named = inputs.iter().filter(|input| input.prefix.is_some());
            let mut channels = named.flat_map(|input| input.file.channels());
            if !channels.any(|channel| channel.name.starts_with(&start)) {
                return Err(UsageError(format!(
                    "--strip {}: no channel of a file with a NAME starts with it",
                    printable(strip)
                ))
                .into());
            }
        }
        let merged = merge(&mut inputs, output)?;
        if !merged.conflicts.is_empty() {
            let names = merged.conflicts.join(", ");
            message::say(format_args!(
                "note: the files differ in {names}; the first value is kept"
            ));
        }
        let summary = format!(
            "{}: {} channels of {} files: {}",
            output.display(),
            merged.channels.len(),
            inputs.len(),
            merged.channels.join(", ")
        );
        message::status(printable(&summary));
        Ok(exit::SUCCESS)
    }
}

impl Source {
    /// Text before the first `=` is the name, unless it contains a path separator.
    fn parse(argument: &OsString) -> Result<Self, UsageError> {
        let bytes = argument.as_encoded_bytes();
        let start = bytes.iter().find(|byte| b"=/\\".contains(byte));
        if argument.to_str().is_none() && start == Some(&b'=') {
            let shown = printable(&argument.to_string_lossy());
            return Err(UsageError(format!(
                "{shown}: NAME=FILE must be UTF-8; rename the file"
            )));
        }
        let split = argument.to_str().and_then(|text| text.split_once('='));
        let Some((name, file)) = split.filter(|(name, _)| !name.contains(['/', '\\'])) else {
            return Ok(Self {
                prefix: None,
                path: argument.into(),
            });
        };
        if name.is_empty() || name.contains(char::is_control) || file.is_empty() {
            let argument = printable(&argument.to_string_lossy());
            return Err(UsageError(format!("{argument}: expected NAME=FILE")));
        }
        Ok(Self {
            prefix: Some(name.to_owned()),
            path: file.into(),
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn parsed(argument: &str) -> (Option<String>, String) {
        let source = Source::parse(&argument.into()).expect(argument);
        (source.prefix, source.path.display().to_string())
    }

    #[test]
    fn a_name_ends_at_the_first_equals_sign() {
        let named = |name: &str, path: &str| (Some(name.to_owned()), path.to_owned());
        let plain = |path: &str| (None, path.to_owned());
        assert_eq!(parsed("a.exr"), plain("a.exr"));
        assert_eq!(parsed("ref=a=b.exr"), named("ref", "a=b.exr"));
        assert_eq!(parsed("View 1.ref=a.exr"), named("View 1.ref", "a.exr"));
        assert_eq!(parsed("./ref=a.exr"), plain("./ref=a.exr"));
        for bad in ["=a.exr", "ref=", "a\u{1b}[2J=a.exr"] {
            assert!(Source::parse(&bad.into()).is_err(), "{bad:?}");
        }
    }
}
