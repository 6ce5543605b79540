//! Output files that are complete or absent.

use std::fs::{self, File};
use std::io::{self, BufWriter, Write};
use std::path::{Path, PathBuf};

use crate::Error;

/// Writes `path` through `fill`: to a temporary name in the same directory, flushed to the disk,
/// mode 0644, then renamed. Readers of `path` see either the old or the new file. A symbolic link
/// stays, and its target is replaced.
///
/// # Errors
/// [`Error::Write`], naming `path`; the temporary file is removed. If `path` is a device, a FIFO or
/// a directory, the source has the kind [`io::ErrorKind::InvalidInput`], and nothing changes.
pub fn write_whole(
    path: &Path,
    fill: impl FnOnce(&mut BufWriter<File>) -> io::Result<()>,
) -> Result<(), Error> {
    let error = |source| Error::Write {
        path: path.to_owned(),
        source,
    };
    let target = target_of(path).map_err(error)?;
    let temporary = temporary_beside(&target).map_err(error)?;
    fill_and_rename(&temporary, &target, fill).map_err(|source| {
        // Reports the first error; the temporary file may not exist.
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
    fs::rename(temporary, path)?;
    sync_dir(path.parent().unwrap_or(Path::new("")))
}

/// Flushes the entries of a directory to the disk; without this, a crash may undo a rename.
///
/// # Errors
/// If the directory cannot be opened, or the disk fails.
pub fn sync_dir(dir: &Path) -> io::Result<()> {
    // Other systems cannot open a directory as a file.
    #[cfg(unix)]
    {
        let is_current = dir.as_os_str().is_empty();
        File::open(if is_current { Path::new(".") } else { dir })?.sync_all()?;
    }
    #[cfg(not(unix))]
    let _ = dir;
    Ok(())
}

/// The file to replace: `path`, or the target of a symbolic link. A rename would replace a link, a
/// FIFO, or the device `/dev/null` by a file.
fn target_of(path: &Path) -> io::Result<PathBuf> {
    let refused = |why: &str| Err(io::Error::new(io::ErrorKind::InvalidInput, why));
    match fs::symlink_metadata(path) {
        Err(error) if error.kind() == io::ErrorKind::NotFound => return Ok(path.to_owned()),
        found => found?,
    };
    match fs::canonicalize(path) {
        Err(error) if error.kind() == io::ErrorKind::NotFound => {
            refused("a symbolic link without a target")
        }
        Ok(target) if !fs::metadata(&target)?.is_file() => refused("not a regular file"),
        target => target,
    }
}

/// `DIR/.NAME.PID.tmp` for `DIR/NAME`: hidden, and different for each process.
fn temporary_beside(path: &Path) -> io::Result<PathBuf> {
    let name = path
        .file_name()
        .ok_or_else(|| io::Error::new(io::ErrorKind::InvalidInput, "the path names no file"))?;
    let mut hidden = std::ffi::OsString::from(".");
    hidden.push(name);
    hidden.push(format!(".{}.tmp", std::process::id()));
    Ok(path.with_file_name(hidden))
}
