//! Output files that appear whole or not at all.

use std::fs::{self, File};
use std::io::{self, BufWriter, Write};
use std::path::{Path, PathBuf};

use crate::Error;

/// Writes `path` through `fill`: to a temporary name in the same directory, flushed to the disk, mode 0644,
/// then renamed. Whoever looks at `path` sees the old file or the new one, never a part.
///
/// # Errors
/// [`Error::Write`], naming `path`; the temporary file is removed.
pub fn write_whole(
    path: &Path,
    fill: impl FnOnce(&mut BufWriter<File>) -> io::Result<()>,
) -> Result<(), Error> {
    let error = |source| Error::Write {
        path: path.to_owned(),
        source,
    };
    let temporary = temporary_beside(path).map_err(error)?;
    fill_and_rename(&temporary, path, fill).map_err(|source| {
        // The first error is the one to report: there may be nothing to remove.
        let _ = fs::remove_file(&temporary);
        error(source)
    })
}

fn fill_and_rename(
    temporary: &Path,
    path: &Path,
    fill: impl FnOnce(&mut BufWriter<File>) -> io::Result<()>,
) -> io::Result<()> {
    let mut writer = BufWriter::new(File::create(temporary)?);
    fill(&mut writer)?;
    writer.flush()?;
    let file = writer.get_ref();
    #[cfg(unix)]
    file.set_permissions(std::os::unix::fs::PermissionsExt::from_mode(0o644))?;
    file.sync_all()?;
    fs::rename(temporary, path)
}

/// `DIR/.NAME.PID.tmp` for `DIR/NAME`: hidden, and two processes do not meet in it.
fn temporary_beside(path: &Path) -> io::Result<PathBuf> {
    let name = path
        .file_name()
        .ok_or_else(|| io::Error::new(io::ErrorKind::InvalidInput, "the path names no file"))?;
    let mut hidden = std::ffi::OsString::from(".");
    hidden.push(name);
    hidden.push(format!(".{}.tmp", std::process::id()));
    Ok(path.with_file_name(hidden))
}
