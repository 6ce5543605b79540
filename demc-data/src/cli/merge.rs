//! `demc-data merge`.

use std::ffi::OsString;
use std::path::PathBuf;

use crate::exr::ExrFile;
use crate::exr::merge::{MergeInput, merge};
use crate::message::{self, printable};
use crate::output::{Directories, Outputs};
use anyhow::Result;

use super::{MergeArguments, UsageError};

/// A file argument: `FILE` or `NAME=FILE`.
#[derive(Debug, PartialEq, Eq)]
struct Source {
    prefix: Option<String>,
    path: PathBuf,
}

/// Joins the files and prints one line.
pub fn run(args: &MergeArguments) -> Result<()> {
    let output = args.output.as_path();
    let files = args.files.iter();
    let sources: Vec<Source> = files.map(Source::parse).collect::<Result<_, _>>()?;
    let mut outputs = Outputs::default();
    for Source { path, .. } in &sources {
        outputs.protect(path, &format!("the input {}", path.display()));
    }
    outputs.claim(output, args.overwrite)?;
    outputs.prepare(Directories::Expect)?;
    let mut inputs = Vec::with_capacity(sources.len());
    for Source { prefix, path } in sources {
        let file = ExrFile::open(&path)?;
        // Files without a name keep their channels' names.
        let strip = args.strip.clone().filter(|_| prefix.is_some());
        inputs.push(MergeInput {
            file,
            prefix,
            strip,
        });
    }
    if let Some(strip) = &args.strip {
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
    Ok(())
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
