//! Which files a command may write. Every program asks here for each of its outputs, before any
//! expensive work.
//!
//! ```
//! use demc_program::output::{Directories, Outputs};
//!
//! let mut outputs = Outputs::default();
//! outputs.protect("Cargo.toml".as_ref(), "the manifest");
//! let refused = outputs.claim("Cargo.toml".as_ref(), true);
//! assert!(refused.is_err_and(|error| error.is_usage()));
//!
//! outputs.claim("new.txt".as_ref(), false)?;
//! outputs.prepare(Directories::Expect)?;
//! # Ok::<(), demc_program::output::OutputError>(())
//! ```

use std::collections::{BTreeMap, HashMap};
use std::ffi::OsString;
use std::fs;
use std::io;
use std::path::{Path, PathBuf};

use crate::file::{FileId, check_directory, check_replaceable, remove_abandoned, target_of};

/// The files of a command: those that it reads, and those that it will write.
#[derive(Debug, Default)]
pub struct Outputs {
    /// What each input is, for messages.
    inputs: HashMap<FileId, String>,
    outputs: HashMap<FileId, PathBuf>,
}

/// Whether the directories of outputs are created.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Directories {
    /// They must exist.
    Expect,
    /// Missing ones are created.
    Create,
}

/// Why an output is refused.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
#[allow(missing_docs, reason = "the messages explain the fields")]
pub enum OutputError {
    /// It is an input.
    #[error("output {} would replace {what}; name another file", path.display())]
    Input { path: PathBuf, what: String },
    /// It is another output, too.
    #[error("{} would be written twice; name another file", path.display())]
    Twice { path: PathBuf },
    /// It exists and is not to be replaced.
    #[error("{} exists; --overwrite replaces it", path.display())]
    Exists { path: PathBuf },
    /// It cannot be written.
    #[error("cannot write {}", path.display())]
    Write { path: PathBuf, source: io::Error },
}

impl OutputError {
    /// Whether the command line is wrong, rather than the file system.
    pub fn is_usage(&self) -> bool {
        !matches!(self, Self::Write { .. })
    }
}

impl Outputs {
    /// Notes a file that the command reads; no output may replace it. `what` is its name in
    /// messages, such as `the model`. The file may be missing.
    pub fn protect(&mut self, path: &Path, what: &str) {
        self.inputs
            .entry(FileId::of(path))
            .or_insert_with(|| what.to_owned());
    }

    /// Notes a file that the command will write. An existing one needs `overwrite`.
    ///
    /// # Errors
    /// An input; an output that was claimed before; a file that must not be replaced; a directory,
    /// a device, or a link without a target.
    pub fn claim(&mut self, path: &Path, overwrite: bool) -> Result<(), OutputError> {
        let owned = || path.to_owned();
        let id = FileId::of(path);
        if let Some(what) = self.inputs.get(&id) {
            let what = what.clone();
            return Err(OutputError::Input {
                path: owned(),
                what,
            });
        }
        let target = target_of(path).map_err(|source| OutputError::Write {
            path: owned(),
            source,
        })?;
        if target.exists() && !overwrite {
            return Err(OutputError::Exists { path: owned() });
        }
        match self.outputs.insert(id, owned()) {
            Some(_) => Err(OutputError::Twice { path: owned() }),
            None => Ok(()),
        }
    }

    /// Forgets a claimed file that is not written after all.
    pub fn release(&mut self, path: &Path) {
        self.outputs.remove(&FileId::of(path));
    }

    /// Checks that the claimed files can be written, and removes what killed processes left of
    /// them. Each directory is tried with one temporary file.
    ///
    /// # Errors
    /// [`OutputError::Write`].
    pub fn prepare(&self, directories: Directories) -> Result<(), OutputError> {
        let mut names: BTreeMap<PathBuf, Vec<OsString>> = BTreeMap::new();
        for path in self.outputs.values() {
            // A symbolic link stays, so its target's directory counts.
            let target = target_of(path).unwrap_or_else(|_| path.clone());
            let directory = target.parent().unwrap_or(Path::new("")).to_owned();
            let name = target.file_name().unwrap_or_default().to_owned();
            names.entry(directory).or_default().push(name);
        }
        for (directory, mut names) in names {
            names.sort();
            let create = directories == Directories::Create && !directory.as_os_str().is_empty();
            let created = if create {
                fs::create_dir_all(&directory)
            } else {
                Ok(())
            };
            remove_abandoned(&directory, Some(&names));
            let error = |name: &OsString| {
                let path = directory.join(name);
                move |source| OutputError::Write { path, source }
            };
            created
                .and_then(|()| check_directory(&directory.join(&names[0])))
                .map_err(error(&names[0]))?;
            for name in &names {
                check_replaceable(&directory.join(name)).map_err(error(name))?;
            }
        }
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::file::temporary_name;

    fn message(result: Result<(), OutputError>) -> String {
        result.expect_err("refused").to_string()
    }

    #[test]
    fn inputs_and_outputs_are_files_and_not_paths() {
        let dir = tempfile::tempdir().expect("a directory");
        let at = |name: &str| dir.path().join(name);
        fs::create_dir(at("sub")).expect("a directory");
        fs::write(at("in"), "").expect("a file");
        fs::hard_link(at("in"), at("hard")).expect("a link");
        #[cfg(unix)]
        std::os::unix::fs::symlink("in", at("soft")).expect("a link");
        let mut outputs = Outputs::default();
        outputs.protect(&at("in"), "the input");
        outputs.protect(&at("missing"), "nothing");
        for name in ["in", "sub/../in", "hard", "soft"] {
            let error = message(outputs.claim(&at(name), true));
            assert!(error.contains("would replace the input"), "{error}");
        }
        outputs.claim(&at("new"), false).expect("free");
        let error = message(outputs.claim(&at("sub/../new"), true));
        assert!(error.contains("would be written twice"), "{error}");
        let error = message(outputs.claim(&at("sub"), true));
        assert!(error.starts_with("cannot write"), "{error}");
    }

    #[test]
    fn an_existing_file_needs_overwrite() {
        let dir = tempfile::tempdir().expect("a directory");
        let path = dir.path().join("a");
        fs::write(&path, "mine").expect("a file");
        let mut outputs = Outputs::default();
        let error = message(outputs.claim(&path, false));
        assert!(
            error.ends_with("a exists; --overwrite replaces it"),
            "{error}"
        );
        outputs.claim(&path, true).expect("may be replaced");
        outputs.prepare(Directories::Expect).expect("writable");
        assert_eq!(fs::read(&path).expect("a file"), b"mine");
    }

    #[test]
    fn directories_exist_or_are_created() {
        let dir = tempfile::tempdir().expect("a directory");
        let mut outputs = Outputs::default();
        outputs
            .claim(&dir.path().join("a/b/c"), false)
            .expect("free");
        let error = outputs.prepare(Directories::Expect).expect_err("missing");
        assert!(!error.is_usage());
        outputs.prepare(Directories::Create).expect("created");
        assert_eq!(
            fs::read_dir(dir.path().join("a/b")).expect("made").count(),
            0
        );
    }

    #[test]
    fn leftovers_of_dead_processes_are_removed() {
        const DAY: std::time::Duration = std::time::Duration::from_secs(24 * 3600);
        let dir = tempfile::tempdir().expect("a directory");
        let here = |name: &str, process| dir.path().join(temporary_name(name.as_ref(), process));
        // Above the largest process id.
        let stale = here("out.exr", 4_199_999_999);
        let other = here("other.exr", 4_199_999_999);
        let living = here("out.exr", 1);
        let locked = here("out.exr", 4_199_999_998);
        let elsewhere = dir.path().join(".out.exr.0badc0de-1-4199999999.tmp");
        let long_ago = dir.path().join(".out.exr.0badc0de-1-1.tmp");
        for path in [&stale, &other, &living, &locked, &elsewhere, &long_ago] {
            fs::write(path, "half").expect("a file");
        }
        let lock = fs::File::open(&locked).expect("a file");
        lock.lock().expect("a lock");
        let old = fs::File::options()
            .write(true)
            .open(&long_ago)
            .expect("a file");
        let before = std::time::SystemTime::now() - 2 * DAY;
        old.set_modified(before).expect("an old file");
        let mut outputs = Outputs::default();
        outputs
            .claim(&dir.path().join("out.exr"), false)
            .expect("free");
        outputs.prepare(Directories::Expect).expect("writable");
        assert!(!stale.exists() && !long_ago.exists());
        assert!(other.exists() && locked.exists() && elsewhere.exists());
        assert_eq!(living.exists(), Path::new("/proc/1").exists());
    }
}
