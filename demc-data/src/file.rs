//! Output files that appear whole or not at all.

use std::fs::{self, File};
use std::io::{self, BufWriter, Write};
use std::path::{Path, PathBuf};

use crate::Error;

/// Writes `path` through `fill`: to a temporary name in the same directory, flushed to the disk, mode 0644,
/// then renamed. Whoever looks at `path` sees the old file or the new one, never a part. A symbolic link
/// stays: the file that it leads to is replaced.
///
/// # Errors
/// [`Error::Write`], naming `path`; the temporary file is removed. Its source is of the kind
/// [`io::ErrorKind::InvalidInput`] if a device, a FIFO or a directory is in the way, which is left alone.
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
    fs::rename(temporary, path)?;
    sync_dir(path.parent().unwrap_or(Path::new("")))
}

/// Brings the names in a directory to the disk: without that, a crash may undo a rename.
///
/// # Errors
/// A directory that cannot be opened, or a disk that fails.
pub fn sync_dir(dir: &Path) -> io::Result<()> {
    // Elsewhere a directory cannot be opened like a file.
    #[cfg(unix)]
    {
        let here = dir.as_os_str().is_empty();
        File::open(if here { Path::new(".") } else { dir })?.sync_all()?;
    }
    #[cfg(not(unix))]
    let _ = dir;
    Ok(())
}

/// The file that `path` stands for: itself, or what a symbolic link leads to. A rename would replace a link,
/// a FIFO, or the device `/dev/null`, by a file.
fn target_of(path: &Path) -> io::Result<PathBuf> {
    let refused = |why: &str| Err(io::Error::new(io::ErrorKind::InvalidInput, why));
    match fs::symlink_metadata(path) {
        Err(error) if error.kind() == io::ErrorKind::NotFound => return Ok(path.to_owned()),
        found => found?,
    };
    match fs::canonicalize(path) {
        Err(error) if error.kind() == io::ErrorKind::NotFound => {
            refused("a symbolic link that leads nowhere")
        }
        Ok(target) if !fs::metadata(&target)?.is_file() => refused("not a regular file"),
        target => target,
    }
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
