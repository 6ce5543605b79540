//! Output files that are complete or absent, and text files of bounded size.

use std::collections::HashSet;
use std::ffi::{OsStr, OsString};
use std::fs::{self, File, TryLockError};
use std::hash::{BuildHasher, RandomState};
use std::io::{self, BufWriter, Read, Write};
use std::path::{Path, PathBuf};
use std::sync::OnceLock;
use std::time::Duration;

/// Age from which a temporary file of another computer, or on a file system without locks, counts as
/// abandoned. Ours: no file takes that long.
const ABANDONED: Duration = Duration::from_secs(24 * 3600);

/// Largest configuration or channel layout in bytes (ours: those of this project have 4 KB).
pub const MAX_CONFIGURATION: u64 = 1 << 20;

/// A file that cannot be read or written. The reason is the source.
#[derive(Debug, thiserror::Error)]
#[allow(missing_docs, reason = "the messages explain the fields")]
pub enum FileError {
    /// It could not be opened or read.
    #[error("cannot read {}", path.display())]
    Read { path: PathBuf, source: io::Error },
    /// It could not be written; no partial file remains.
    #[error("cannot write {}", path.display())]
    Write { path: PathBuf, source: io::Error },
}

/// Opens a regular file to read it. Opening a FIFO would wait for a writer, and a device may not end.
///
/// # Errors
/// A file that cannot be opened or is not a regular file.
pub fn open_regular(path: &Path) -> io::Result<File> {
    if fs::metadata(path)?.is_file() {
        return File::open(path);
    }
    Err(io::Error::new(
        io::ErrorKind::InvalidInput,
        "not a regular file",
    ))
}

/// What a file is, whatever its path: hard and symbolic links to it have the same id.
#[derive(Debug, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub enum FileId {
    /// Device and inode of an existing file.
    #[cfg(unix)]
    Inode(u64, u64),
    /// A path without links.
    Path(PathBuf),
}

impl FileId {
    /// The id of an existing file.
    ///
    /// # Errors
    /// A file that is missing or out of reach.
    pub fn of_existing(path: &Path) -> io::Result<Self> {
        #[cfg(unix)]
        {
            use std::os::unix::fs::MetadataExt;
            let found = fs::metadata(path)?;
            Ok(Self::Inode(found.dev(), found.ino()))
        }
        #[cfg(not(unix))]
        fs::canonicalize(path).map(Self::Path)
    }

    /// The id of a file that may be missing.
    pub fn of(path: &Path) -> Self {
        Self::of_existing(path).unwrap_or_else(|_| {
            let parent = match path.parent() {
                Some(parent) if parent != Path::new("") => parent,
                _ => Path::new("."),
            };
            let resolved = fs::canonicalize(path).or_else(|_| match path.file_name() {
                Some(name) => Ok(fs::canonicalize(parent)?.join(name)),
                None => std::path::absolute(path),
            });
            let absolute = resolved.or_else(|_| std::path::absolute(path));
            Self::Path(absolute.unwrap_or_else(|_| path.to_owned()))
        })
    }
}

/// The text of a file. Reading stops at `most` bytes, because a device may not end.
///
/// # Errors
/// A file that cannot be read, has more bytes, or is not UTF-8.
pub fn read_text(path: &Path, most: u64) -> io::Result<String> {
    text_of(File::open(path)?, most)
}

/// As [`read_text`], for a regular file: opening a FIFO would wait for a writer.
///
/// # Errors
/// As [`read_text`] and [`open_regular`].
pub fn read_regular_text(path: &Path, most: u64) -> io::Result<String> {
    text_of(open_regular(path)?, most)
}

fn text_of(file: File, most: u64) -> io::Result<String> {
    let mut text = String::new();
    file.take(most + 1).read_to_string(&mut text)?;
    if text.len() as u64 > most {
        let why = format!("more than {most} bytes, the limit; name another file");
        return Err(io::Error::new(io::ErrorKind::InvalidData, why));
    }
    Ok(text)
}

/// Writes `path` through `fill`: to a temporary name in the same directory, flushed to the disk,
/// then renamed. Readers of `path` see either the old or the new file. A symbolic link stays, and
/// its target is replaced. The file has the permissions of the one that it replaces, or follows the
/// umask.
///
/// # Errors
/// [`FileError::Write`], naming `path`; the temporary file is removed. If `path` is a device, a FIFO or
/// a directory, the source has the kind [`io::ErrorKind::InvalidInput`], and nothing changes.
pub fn write_whole(
    path: &Path,
    fill: impl FnOnce(&mut BufWriter<File>) -> io::Result<()>,
) -> Result<(), FileError> {
    let error = |source| FileError::Write {
        path: path.to_owned(),
        source,
    };
    let target = target_of(path).map_err(error)?;
    let (temporary, file) = create_beside(&target).map_err(error)?;
    fill_and_rename(file, &temporary, &target, fill).map_err(|source| {
        // Reports the first error.
        let _ = fs::remove_file(&temporary);
        error(source)
    })
}

fn fill_and_rename(
    file: File,
    temporary: &Path,
    path: &Path,
    fill: impl FnOnce(&mut BufWriter<File>) -> io::Result<()>,
) -> io::Result<()> {
    let mut writer = BufWriter::new(file);
    fill(&mut writer)?;
    writer.flush()?;
    writer.get_ref().sync_all()?;
    fs::rename(temporary, path)?;
    sync_dir(path.parent().unwrap_or(Path::new("")))
}

/// Checks that [`write_whole`] can create `path` or a file beside it: creates its temporary file
/// and removes it.
///
/// # Errors
/// As [`write_whole`].
pub(crate) fn check_directory(path: &Path) -> io::Result<()> {
    let (temporary, _) = create_beside(path)?;
    fs::remove_file(temporary)
}

/// Checks that `path` is missing or not write-protected.
///
/// # Errors
/// A file without write permission.
pub(crate) fn check_replaceable(path: &Path) -> io::Result<()> {
    match File::options().write(true).open(path) {
        Err(error) if error.kind() != io::ErrorKind::NotFound => Err(error),
        _ => Ok(()),
    }
}

/// Creates the temporary file for `target`, with its permissions, and locks it.
fn create_beside(target: &Path) -> io::Result<(PathBuf, File)> {
    let temporary = temporary_beside(target)?;
    // A process with the same id was killed here.
    if is_abandoned(&temporary, host(), std::process::id()) {
        fs::remove_file(&temporary)?;
    }
    let mut options = File::options();
    options.write(true).create_new(true);
    #[cfg(unix)]
    let file = {
        use std::os::unix::fs::{OpenOptionsExt, PermissionsExt};
        let mode = |found: fs::Metadata| found.permissions().mode() & 0o777;
        let wanted = fs::metadata(target).ok().map(mode);
        let file = options.mode(wanted.unwrap_or(0o666)).open(&temporary)?;
        if let Some(wanted) =
            wanted.filter(|wanted| file.metadata().map(mode).ok() != Some(*wanted))
        {
            file.set_permissions(PermissionsExt::from_mode(wanted))?;
        }
        file
    };
    #[cfg(not(unix))]
    let file = options.open(&temporary)?;
    // Other processes see that the file is in use. Not every file system has locks.
    let _ = file.try_lock();
    Ok((temporary, file))
}

/// Removes the temporary files in `dir` that killed processes left of files with these names, or
/// of all files. Those of living processes stay. A file that cannot be removed does no harm.
pub fn remove_abandoned(dir: &Path, names: Option<&[OsString]>) {
    let stems: Option<HashSet<OsString>> =
        names.map(|names| names.iter().map(|name| hidden_stem(name)).collect());
    let is_current = dir.as_os_str().is_empty();
    let entries = fs::read_dir(if is_current { Path::new(".") } else { dir });
    for entry in entries.into_iter().flatten().flatten() {
        let hidden = entry.file_name();
        if let Some(name) = TemporaryName::parse(&hidden)
            && stems.as_ref().is_none_or(|stems| stems.contains(name.stem))
            && is_abandoned(&entry.path(), name.host, name.process)
        {
            let _ = fs::remove_file(entry.path());
        }
    }
}

/// Whether no process writes the temporary file of `process` on `host` any more. Writers hold a
/// lock, but few network file systems show it to other computers.
fn is_abandoned(temporary: &Path, host: &str, process: u32) -> bool {
    let Ok(found) = fs::symlink_metadata(temporary) else {
        return false;
    };
    let is_here = host == self::host();
    let lives =
        process != std::process::id() && Path::new("/proc").join(process.to_string()).exists();
    if !found.is_file() || is_here && lives {
        return false;
    }
    let Ok(file) = File::options().write(true).open(temporary) else {
        return false;
    };
    let age = found.modified().ok().and_then(|at| at.elapsed().ok());
    let is_old = age.is_some_and(|age| age > ABANDONED);
    match file.try_lock() {
        Ok(()) => is_here || is_old,
        Err(TryLockError::WouldBlock) => false,
        Err(TryLockError::Error(_)) => is_old,
    }
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
pub(crate) fn target_of(path: &Path) -> io::Result<PathBuf> {
    let refused = |why: &str| Err(io::Error::new(io::ErrorKind::InvalidInput, why));
    if path.as_os_str().as_encoded_bytes().ends_with(b"/") {
        return refused("the path names a directory; name a file");
    }
    match fs::symlink_metadata(path) {
        Err(error) if error.kind() == io::ErrorKind::NotFound => return Ok(path.to_owned()),
        found => found?,
    };
    // A pipe behind `/dev/stdout` has no canonical path.
    if fs::metadata(path).is_ok_and(|found| !found.is_file() && !found.is_dir()) {
        return refused("not a regular file");
    }
    match fs::canonicalize(path) {
        Err(error) if error.kind() == io::ErrorKind::NotFound => {
            refused("a symbolic link without a target")
        }
        Ok(target) if target.is_dir() => refused("is a directory; name a file"),
        target => target,
    }
}

/// `DIR/.NAME.HOST-PID.tmp` for `DIR/NAME`: hidden, and different for each process of all computers.
fn temporary_beside(path: &Path) -> io::Result<PathBuf> {
    let name = path
        .file_name()
        .ok_or_else(|| io::Error::new(io::ErrorKind::InvalidInput, "the path names no file"))?;
    Ok(path.with_file_name(temporary_name(name, std::process::id())))
}

/// `.NAME.HOST-PID.tmp`: what `process` of this computer calls the file `name` while it writes it.
pub fn temporary_name(name: &OsStr, process: u32) -> OsString {
    let mut hidden = hidden_stem(name);
    hidden.push(format!(".{}-{process}.tmp", host()));
    hidden
}

/// The name of the processes that share their ids with this one: the kernel's boot, and the
/// container. Elsewhere than on Linux it is random, for this process alone.
fn host() -> &'static str {
    static HOST: OnceLock<String> = OnceLock::new();
    HOST.get_or_init(|| {
        linux_host().unwrap_or_else(|| format!("{:016x}", RandomState::new().hash_one(())))
    })
}

/// The start of the boot's random id, and the number of the process namespace.
fn linux_host() -> Option<String> {
    let boot = fs::read_to_string("/proc/sys/kernel/random/boot_id").ok()?;
    let namespace = fs::read_link("/proc/self/ns/pid").ok()?;
    let digits = |text: &str| {
        text.chars()
            .filter(char::is_ascii_digit)
            .collect::<String>()
    };
    Some(format!(
        "{}-{}",
        boot.get(..8)?,
        digits(namespace.to_str()?)
    ))
}

/// `.NAME`.
fn hidden_stem(name: &OsStr) -> OsString {
    let mut hidden = OsString::from(".");
    hidden.push(name);
    hidden
}

/// The parts of `.NAME.HOST-PID.tmp`.
struct TemporaryName<'a> {
    /// `.NAME`.
    stem: &'a OsStr,
    host: &'a str,
    process: u32,
}

impl<'a> TemporaryName<'a> {
    /// `None` for other names.
    fn parse(hidden: &'a OsStr) -> Option<Self> {
        let hidden = Path::new(hidden);
        let with_process = Path::new(hidden.file_stem()?);
        let (host, process) = with_process.extension()?.to_str()?.rsplit_once('-')?;
        let stem = with_process.file_stem()?;
        let is_hidden = stem.as_encoded_bytes().starts_with(b".");
        (is_hidden && hidden.extension()? == "tmp").then_some(Self {
            stem,
            host,
            process: process.parse().ok()?,
        })
    }
}
