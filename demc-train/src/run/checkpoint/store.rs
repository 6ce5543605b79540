//! Checkpoints as directories of files: written atomically, verified by checksums, removed when
//! old. This module does not interpret the files.
//!
//! A directory is filled under a temporary name. All files and the directory are synced to disk
//! before it gets its final name; `latest` is updated last. So the newest directory with a final
//! name is always complete. `SHA256SUMS`, which `sha256sum -c` reads too, reveals later damage.

use std::fmt::Write as _;
use std::fs::{self, File};
use std::io::Write;
use std::path::{Path, PathBuf};

use anyhow::{Context, bail};
use demc_infer::bundle::checksum::{SUMS, sums};
use demc_infer::bundle::locate::{CHECKPOINTS, LATEST};
use demc_program::checksum::{sha256, sha256_of};
use demc_program::file::{sync_dir, write_whole};

/// Suffix of an unfinished checkpoint.
const UNFINISHED: &str = ".tmp";

/// The checkpoints of a run.
#[derive(Clone, Debug)]
pub struct CheckpointStore {
    run: PathBuf,
}

/// The result of a search for an intact checkpoint.
#[derive(Clone, Debug, Default)]
pub struct CheckpointSearch {
    /// The checkpoint to resume from.
    pub intact: Option<PathBuf>,
    /// Damage of the checkpoints that would have been preferred.
    pub damaged: Vec<String>,
}

impl CheckpointStore {
    /// The checkpoints of the run in `run`.
    pub fn new(run: &Path) -> Self {
        CheckpointStore { run: run.into() }
    }

    fn all(&self) -> PathBuf {
        self.run.join(CHECKPOINTS)
    }

    /// Writes a checkpoint of `step` with `files` and, under a new name, the existing file
    /// `linked`. Then updates `latest` and removes all but the `keep` newest checkpoints.
    ///
    /// # Errors
    /// A file that cannot be written, with the last intact checkpoint. Earlier checkpoints stay.
    pub fn write(
        &self,
        step: u64,
        files: &[(&str, Vec<u8>)],
        linked: Option<(&str, &Path)>,
        keep: usize,
    ) -> anyhow::Result<()> {
        let name = format!("step-{step:08}");
        let unfinished = self.all().join(format!("{name}{UNFINISHED}"));
        let written = fill(&unfinished, files, linked).and_then(|()| {
            let finished = self.all().join(&name);
            // Only a damaged checkpoint can have this name: a resumed run starts before this step.
            remove(&finished)?;
            fs::rename(&unfinished, &finished).with_context(|| finished.display().to_string())?;
            sync(&self.all())?;
            write_whole(&self.run.join(LATEST), |file| writeln!(file, "{name}"))?;
            self.prune(&name, keep)
        });
        written.map_err(|error| {
            // The unfinished checkpoint is useless and takes disk space.
            let _ = fs::remove_dir_all(&unfinished);
            let last = match self.newest_intact() {
                Ok(CheckpointSearch {
                    intact: Some(dir), ..
                }) => format!("the last intact checkpoint is {}", dir.display()),
                _ => "there is no earlier checkpoint".into(),
            };
            error.context(format!("writing the checkpoint of step {step} ({last})"))
        })
    }

    /// Whether a checkpoint of this step exists, intact or not.
    pub fn has(&self, step: u64) -> bool {
        self.all().join(format!("step-{step:08}")).is_dir()
    }

    /// The checkpoint that `latest` names, or else the newest intact one.
    ///
    /// # Errors
    /// A directory that cannot be read.
    pub fn newest_intact(&self) -> anyhow::Result<CheckpointSearch> {
        let mut found = CheckpointSearch::default();
        let mut names = self.names()?;
        names.sort_by_key(|name| std::cmp::Reverse(step_of(name)));
        match fs::read_to_string(self.run.join(LATEST)) {
            Ok(text) => match names.iter().position(|name| name == text.trim()) {
                Some(index) => names[..=index].rotate_right(1),
                None => found.damaged.push(format!(
                    "{}: names the missing checkpoint `{}`",
                    self.run.join(LATEST).display(),
                    text.trim()
                )),
            },
            Err(_) if names.is_empty() => {}
            Err(error) => found
                .damaged
                .push(format!("{}: {error}", self.run.join(LATEST).display())),
        }
        for name in names {
            let dir = self.all().join(&name);
            match verify(&dir) {
                Ok(()) => {
                    found.intact = Some(dir);
                    break;
                }
                Err(error) => found.damaged.push(format!("{error:#}")),
            }
        }
        Ok(found)
    }

    /// The names of all finished checkpoints. Other files are ignored.
    fn names(&self) -> anyhow::Result<Vec<String>> {
        let names = names_in(&self.all())?.into_iter();
        Ok(names.filter(|name| step_of(name).is_some()).collect())
    }

    /// Removes what a killed run left: unfinished checkpoints, and all but the `keep` newest
    /// keep beside `newest`.
    ///
    /// # Errors
    /// A checkpoint that cannot be removed.
    pub fn remove_old(&self, newest: &Path, keep: usize) -> anyhow::Result<()> {
        let name = newest.file_name().and_then(|name| name.to_str());
        self.prune(name.unwrap_or_default(), keep)
    }

    /// Removes unfinished checkpoints and all but the `keep` newest, but never `name`.
    fn prune(&self, name: &str, keep: usize) -> anyhow::Result<()> {
        let all = self.all();
        for entry in names_in(&all)? {
            if entry.strip_suffix(UNFINISHED).and_then(step_of).is_some() {
                remove(&all.join(entry))?;
            }
        }
        let mut old: Vec<(u64, String)> = self
            .names()?
            .into_iter()
            // Anything else of such a name is of another program, or damaged.
            .filter(|entry| entry != name && all.join(entry).join(SUMS).is_file())
            .filter_map(|entry| Some((step_of(&entry)?, entry)))
            .collect();
        old.sort();
        old.truncate((old.len() + 1).saturating_sub(keep));
        for (_, entry) in old {
            remove(&all.join(entry))?;
        }
        Ok(())
    }
}

fn step_of(name: &str) -> Option<u64> {
    let digits = name.strip_prefix("step-")?;
    let is_name = digits.len() >= 8 && digits.bytes().all(|b| b.is_ascii_digit());
    is_name.then(|| digits.parse().ok()).flatten()
}

fn names_in(dir: &Path) -> anyhow::Result<Vec<String>> {
    if !dir.exists() {
        return Ok(Vec::new());
    }
    let entries = fs::read_dir(dir).with_context(|| dir.display().to_string())?;
    let names: std::io::Result<Vec<String>> = entries
        .map(|entry| Ok(entry?.file_name().to_string_lossy().into_owned()))
        .collect();
    names.with_context(|| dir.display().to_string())
}

fn fill(
    dir: &Path,
    files: &[(&str, Vec<u8>)],
    linked: Option<(&str, &Path)>,
) -> anyhow::Result<()> {
    remove(dir)?;
    fs::create_dir_all(dir).with_context(|| dir.display().to_string())?;
    let mut list = String::new();
    for (name, bytes) in files {
        write_synced(&dir.join(name), bytes)?;
        let _ = writeln!(list, "{}  {name}", sha256([&bytes[..]]));
    }
    if let Some((name, from)) = linked {
        let to = dir.join(name);
        // Some file systems have no hard links.
        fs::hard_link(from, &to)
            .or_else(|_| fs::copy(from, &to).map(drop))
            .with_context(|| to.display().to_string())?;
        let _ = writeln!(list, "{}  {name}", sha256_of(&to)?);
    }
    write_synced(&dir.join(SUMS), list.as_bytes())?;
    sync(dir)
}

fn write_synced(path: &Path, bytes: &[u8]) -> anyhow::Result<()> {
    let write = || {
        let mut file = File::create(path)?;
        file.write_all(bytes)?;
        file.sync_all()
    };
    write().with_context(|| path.display().to_string())
}

fn sync(dir: &Path) -> anyhow::Result<()> {
    sync_dir(dir).with_context(|| dir.display().to_string())
}

/// Fails with the first file that does not match its checksum, or has none. Hidden files are those of
/// a file system or a desktop, such as `.nfs0001`.
fn verify(dir: &Path) -> anyhow::Result<()> {
    let sums = sums(dir)?;
    for (sum, name) in &sums {
        let file = dir.join(name);
        if sha256_of(&file)? != *sum {
            bail!("{}: damaged, its checksum differs", file.display());
        }
    }
    let is_ours = |file: &str| file != SUMS && !file.starts_with('.');
    let is_listed = |file: &str| sums.iter().any(|(_, name)| name == file);
    let unlisted = names_in(dir)?
        .into_iter()
        .find(|file| is_ours(file) && !is_listed(file));
    if let Some(file) = unlisted {
        bail!("{}: no checksum in {SUMS}", dir.join(file).display());
    }
    Ok(())
}

fn remove(dir: &Path) -> anyhow::Result<()> {
    if dir.exists() {
        fs::remove_dir_all(dir).with_context(|| dir.display().to_string())
    } else {
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn run(steps: &[u64], keep: usize) -> (tempfile::TempDir, CheckpointStore) {
        let dir = tempfile::tempdir().unwrap();
        let store = CheckpointStore::new(dir.path());
        for step in steps {
            let files = [("a file", step.to_string().into_bytes())];
            store.write(*step, &files, None, keep).unwrap();
        }
        (dir, store)
    }

    fn remaining(store: &CheckpointStore) -> Vec<String> {
        let mut names = names_in(&store.all()).unwrap();
        names.sort();
        names
    }

    #[test]
    fn the_newest_and_other_files_are_kept() {
        let (dir, store) = run(&[1], 2);
        let all = dir.path().join(CHECKPOINTS);
        for name in ["step-00000003.tmp", "keep-me", "step-1"] {
            fs::create_dir(all.join(name)).unwrap();
        }
        fs::write(all.join("notes.txt"), "mine").unwrap();
        for step in 2..=10 {
            store.write(step, &[], None, 2).unwrap();
        }
        let kept = [
            "keep-me",
            "notes.txt",
            "step-00000009",
            "step-00000010",
            "step-1",
        ];
        assert_eq!(remaining(&store), kept);
        let latest = fs::read_to_string(dir.path().join(LATEST)).unwrap();
        assert_eq!(latest, "step-00000010\n");
    }

    #[test]
    fn only_checkpoints_count() {
        let (dir, store) = run(&[1, 2], 2);
        fs::write(dir.path().join("checkpoints/step-00000009"), "").unwrap();
        fs::create_dir(dir.path().join("checkpoints/step-00000008")).unwrap();
        store.write(3, &[], None, 2).unwrap();
        let kept = [
            "step-00000002",
            "step-00000003",
            "step-00000008",
            "step-00000009",
        ];
        assert_eq!(remaining(&store), kept);
    }

    #[test]
    fn what_a_killed_run_left_is_removed() {
        let (dir, store) = run(&[1, 2, 3], 9);
        std::fs::create_dir(dir.path().join("checkpoints/step-00000004.tmp")).unwrap();
        let newest = dir.path().join("checkpoints/step-00000003");
        store.remove_old(&newest, 2).unwrap();
        assert_eq!(remaining(&store), ["step-00000002", "step-00000003"]);
    }

    #[test]
    fn a_damaged_checkpoint_is_named_and_the_previous_one_used() {
        let (dir, store) = run(&[5, 6], 2);
        let dir_of = |step: u64| store.all().join(format!("step-{step:08}"));
        assert_eq!(store.newest_intact().unwrap().intact, Some(dir_of(6)));
        fs::write(dir_of(6).join(".nfs0001"), "").unwrap();
        assert_eq!(store.newest_intact().unwrap().intact, Some(dir_of(6)));
        fs::write(dir_of(6).join("a file"), "7").unwrap();
        let found = store.newest_intact().unwrap();
        assert_eq!(found.intact, Some(dir_of(5)));
        let [damage] = &found.damaged[..] else {
            panic!("{found:?}")
        };
        assert!(damage.contains("step-00000006/a file: damaged"), "{damage}");
        fs::write(dir_of(5).join("another file"), "7").unwrap();
        let found = store.newest_intact().unwrap();
        assert!(found.intact.is_none());
        assert!(found.damaged[1].contains("no checksum"), "{found:?}");
        fs::remove_file(dir_of(5).join("a file")).unwrap();
        let found = store.newest_intact().unwrap();
        assert!(found.intact.is_none() && found.damaged.len() == 2);
        drop(dir);
    }

    #[test]
    fn latest_decides_and_may_be_missing() {
        let (dir, store) = run(&[5, 6, 7], 2);
        let latest = dir.path().join(LATEST);
        let newest = |store: &CheckpointStore| {
            let found = store.newest_intact().unwrap();
            let intact = found.intact.map(|dir| {
                let name = dir
                    .file_name()
                    .map(|name| name.to_string_lossy().into_owned());
                name.unwrap()
            });
            (intact.unwrap_or_default(), found.damaged.len())
        };
        fs::write(&latest, "step-00000006\n").unwrap();
        assert_eq!(newest(&store), ("step-00000006".into(), 0));
        fs::write(&latest, "").unwrap();
        assert_eq!(newest(&store), ("step-00000007".into(), 1));
        fs::remove_file(&latest).unwrap();
        assert_eq!(newest(&store), ("step-00000007".into(), 1));
        fs::remove_dir_all(dir.path().join(CHECKPOINTS)).unwrap();
        assert_eq!(newest(&store), (String::new(), 0));
    }

    #[test]
    fn a_linked_file_outlives_its_original() {
        let (dir, store) = run(&[1], 2);
        let best = dir.path().join("best");
        fs::write(&best, "weights").unwrap();
        store.write(2, &[], Some(("kept", &best)), 2).unwrap();
        fs::remove_file(&best).unwrap();
        let found = store.newest_intact().unwrap();
        let kept = found.intact.unwrap().join("kept");
        assert_eq!(fs::read_to_string(kept).unwrap(), "weights");
    }

    #[test]
    fn checksums_equal_those_of_sha256sum() {
        let (dir, store) = run(&[7], 2);
        let sums = fs::read_to_string(store.all().join("step-00000007").join(SUMS)).unwrap();
        // printf 7 | sha256sum
        let expected = "7902699be42c8a8e46fbbb4501726517e86b22c56a189f7625a6da49081b2451  a file\n";
        assert_eq!(sums, expected);
        drop(dir);
    }

    #[test]
    fn a_failed_write_names_the_last_intact_checkpoint() {
        let (dir, store) = run(&[1], 2);
        let missing = dir.path().join("missing");
        let error = store.write(2, &[], Some(("kept", &missing)), 2);
        let error = format!("{:#}", error.unwrap_err());
        assert!(
            error.contains("step 2 (the last intact checkpoint is ")
                && error.contains("step-00000001"),
            "{error}"
        );
        assert_eq!(remaining(&store), ["step-00000001"]);
    }
}
