//! What commands write: files, text, and JSON.

use std::io::Write;
use std::path::Path;

use demc_program::exit::UsageError;
use demc_program::file::write_whole;
use demc_program::message;
use demc_program::output::{Directories, OutputError, Outputs};

/// Checks the only output of a command, which replaces an existing file with `overwrite`, but no input.
pub fn check_output(mut outputs: Outputs, path: &Path, overwrite: bool) -> Result<(), OutputError> {
    outputs.claim(path, overwrite)?;
    outputs.prepare(Directories::Expect)
}

/// Fails for a path that JSON cannot hold.
pub fn utf8_for_json(path: &Path) -> Result<(), UsageError> {
    match path.to_str() {
        Some(_) => Ok(()),
        None => Err(UsageError(format!(
            "{}: not UTF-8, as JSON requires; rename it or omit --json",
            path.display()
        ))),
    }
}

/// Writes `text` and a newline to stdout if `path` is `-`, otherwise to a file.
pub fn write_text(path: &Path, text: &str) -> anyhow::Result<()> {
    if path == Path::new("-") {
        return Ok(message::result(text)?);
    }
    write_whole(path, |file| file.write_all(format!("{text}\n").as_bytes()))?;
    Ok(())
}
