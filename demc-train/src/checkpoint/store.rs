//! Checkpoints as directories of files: written whole or not at all, checked against their checksums, thinned out. What the
//! files mean is not known here.
//!
//! A directory is filled under a temporary name; every file and the directory itself are on the disk before it gets its
//! name, and `latest` is moved on after that. So at any moment the newest directory without the temporary ending is
//! whole; what a disk or a hand does to it later shows in `SHA256SUMS`, which `sha256sum -c` reads too.

use std::fmt::Write as _;
use std::fs::{self, File};
use std::io::{Read, Write};
use std::path::{Path, PathBuf};

use anyhow::{Context, bail};
use demc_data::file::{sync_dir, write_whole};
use demc_infer::bundle::locate::{CHECKPOINTS, LATEST};
use sha2::{Digest, Sha256};

/// Checksums of a checkpoint's files, as `sha256sum` prints them.
const SUMS: &str = "SHA256SUMS";
/// Ending of a checkpoint that is being written.
const UNFINISHED: &str = ".tmp";
/// Bytes that are read at a time.
const PIECE: usize = 1 << 20;

/// Which checkpoints stay.
#[derive(Clone, Copy, Debug)]
pub struct Keep {
    /// So many of the newest.
    pub newest: usize,
    /// Those whose step is a multiple of this; 0: none.
    pub every: u64,
}

/// The checkpoints of a run.
#[derive(Clone, Debug)]
pub struct Store {
    run: PathBuf,
}

/// What a search for a checkpoint found.
#[derive(Clone, Debug, Default)]
pub struct Found {
    /// The checkpoint to go on from.
    pub intact: Option<PathBuf>,
    /// What is wrong with those that would have come before it.
    pub damaged: Vec<String>,
}

impl Store {
    /// The checkpoints of the run in `run`.
    pub fn new(run: &Path) -> Self {
        Store { run: run.into() }
    }

    fn all(&self) -> PathBuf {
        self.run.join(CHECKPOINTS)
    }

    /// Writes a checkpoint of step `step` that holds `files` and, under another name, the file `linked`; points `latest` at
    /// it and removes what `keep` does not keep.
    ///
    /// # Errors
    /// A file that cannot be written, with the checkpoint that is there: those before are untouched.
    pub fn write(
        &self,
        step: u64,
        files: &[(&str, Vec<u8>)],
        linked: Option<(&str, &Path)>,
        keep: Keep,
    ) -> anyhow::Result<()> {
        let name = format!("step-{step:08}");
        let unfinished = self.all().join(format!("{name}{UNFINISHED}"));
        let written = fill(&unfinished, files, linked).and_then(|()| {
            let finished = self.all().join(&name);
            // Only a damaged one can be there: a run does not go on from a step that it has yet to reach.
            remove(&finished)?;
            fs::rename(&unfinished, &finished).with_context(|| finished.display().to_string())?;
            sync(&self.all())?;
            write_whole(&self.run.join(LATEST), |file| writeln!(file, "{name}"))?;
            self.prune(&name, keep)
        });
        written.map_err(|error| {
            // What was being written is worth nothing, and its room may be needed.
            let _ = fs::remove_dir_all(&unfinished);
            let good = match self.newest_intact() {
                Ok(Found {
                    intact: Some(dir), ..
                }) => format!("the last good one is {}", dir.display()),
                _ => "there is none before it".into(),
            };
            error.context(format!("writing the checkpoint of step {step} ({good})"))
        })
    }

    /// Whether there is a checkpoint of this step, whole or not.
    pub fn has(&self, step: u64) -> bool {
        self.all().join(format!("step-{step:08}")).is_dir()
    }

    /// The checkpoint that `latest` names, or else the newest that is whole.
    ///
    /// # Errors
    /// A directory that cannot be read.
    pub fn newest_intact(&self) -> anyhow::Result<Found> {
        let mut found = Found::default();
        let mut names = self.names()?;
        names.sort_by_key(|name| std::cmp::Reverse(step_of(name)));
        match fs::read_to_string(self.run.join(LATEST)) {
            Ok(text) => match names.iter().position(|name| name == text.trim()) {
                Some(place) => names[..=place].rotate_right(1),
                None => found.damaged.push(format!(
                    "{}: names `{}`, which is not there",
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

    /// The names of all finished checkpoints. What is not named like one is not ours.
    fn names(&self) -> anyhow::Result<Vec<String>> {
        let names = names_in(&self.all())?.into_iter();
        Ok(names.filter(|name| step_of(name).is_some()).collect())
    }

    /// Removes what `keep` does not keep, but never `name`, and what unfinished checkpoints left behind.
    fn prune(&self, name: &str, keep: Keep) -> anyhow::Result<()> {
        let all = self.all();
        for entry in names_in(&all)? {
            if entry.strip_suffix(UNFINISHED).and_then(step_of).is_some() {
                remove(&all.join(entry))?;
            }
        }
        let mut old: Vec<(u64, String)> = self
            .names()?
            .into_iter()
            .filter(|entry| entry != name)
            .filter_map(|entry| Some((step_of(&entry)?, entry)))
            .collect();
        old.sort();
        old.truncate((old.len() + 1).saturating_sub(keep.newest));
        for (step, entry) in old {
            if keep.every == 0 || !step.is_multiple_of(keep.every) {
                remove(&all.join(entry))?;
            }
        }
        Ok(())
    }
}

/// The step of a checkpoint named like ours.
fn step_of(name: &str) -> Option<u64> {
    let digits = name.strip_prefix("step-")?;
    let ours = digits.len() >= 8 && digits.bytes().all(|b| b.is_ascii_digit());
    ours.then(|| digits.parse().ok()).flatten()
}

fn names_in(dir: &Path) -> anyhow::Result<Vec<String>> {
    if !dir.exists() {
        return Ok(Vec::new());
    }
    let entries = fs::read_dir(dir).with_context(|| dir.display().to_string())?;
    let names = entries.map(|entry| Ok(entry?.file_name().to_string_lossy().into_owned()));
    let names: std::io::Result<Vec<String>> = names.collect();
    names.with_context(|| dir.display().to_string())
}

fn fill(
    dir: &Path,
    files: &[(&str, Vec<u8>)],
    linked: Option<(&str, &Path)>,
) -> anyhow::Result<()> {
    remove(dir)?;
    fs::create_dir_all(dir).with_context(|| dir.display().to_string())?;
    let mut sums = String::new();
    for (name, bytes) in files {
        write_synced(&dir.join(name), bytes)?;
        let _ = writeln!(sums, "{}  {name}", hex(&Sha256::digest(bytes)));
    }
    if let Some((name, from)) = linked {
        let to = dir.join(name);
        // Not every file system has links.
        fs::hard_link(from, &to)
            .or_else(|_| fs::copy(from, &to).map(drop))
            .with_context(|| to.display().to_string())?;
        let _ = writeln!(sums, "{}  {name}", sha256_of(&to)?);
    }
    write_synced(&dir.join(SUMS), sums.as_bytes())?;
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

/// Fails with the first file that is not what its checksum says.
fn verify(dir: &Path) -> anyhow::Result<()> {
    let path = dir.join(SUMS);
    let text = fs::read_to_string(&path).with_context(|| path.display().to_string())?;
    for line in text.lines() {
        let Some((sum, name)) = line.split_once("  ") else {
            bail!("{}: a line without a checksum: {line}", path.display());
        };
        let file = dir.join(name);
        if sha256_of(&file)? != sum {
            bail!("{}: damaged, not what its checksum says", file.display());
        }
    }
    if text.is_empty() {
        bail!("{}: empty", path.display());
    }
    Ok(())
}

/// The SHA-256 of a file, in hexadecimal digits.
///
/// # Errors
/// A file that cannot be read.
pub fn sha256_of(path: &Path) -> anyhow::Result<String> {
    let read = || -> std::io::Result<String> {
        let mut file = File::open(path)?;
        let (mut sum, mut piece) = (Sha256::new(), vec![0; PIECE]);
        loop {
            match file.read(&mut piece)? {
                0 => return Ok(hex(&sum.finalize())),
                read => sum.update(&piece[..read]),
            }
        }
    };
    read().with_context(|| path.display().to_string())
}

fn hex(bytes: &[u8]) -> String {
    bytes.iter().fold(String::new(), |mut text, byte| {
        let _ = write!(text, "{byte:02x}");
        text
    })
}

fn remove(dir: &Path) -> anyhow::Result<()> {
    match dir.exists() {
        true => fs::remove_dir_all(dir).with_context(|| dir.display().to_string()),
        false => Ok(()),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const TWO: Keep = Keep {
        newest: 2,
        every: 0,
    };

    /// A run with these checkpoints, of one file each.
    fn run(steps: &[u64], keep: Keep) -> (tempfile::TempDir, Store) {
        let dir = tempfile::tempdir().unwrap();
        let store = Store::new(dir.path());
        for step in steps {
            let files = [("a file", step.to_string().into_bytes())];
            store.write(*step, &files, None, keep).unwrap();
        }
        (dir, store)
    }

    fn left(store: &Store) -> Vec<String> {
        let mut names = names_in(&store.all()).unwrap();
        names.sort();
        names
    }

    #[test]
    fn the_newest_and_every_mth_stay_and_what_is_not_ours() {
        let (dir, store) = run(&[1], TWO);
        let all = dir.path().join(CHECKPOINTS);
        for name in ["step-00000003.tmp", "keep-me", "step-1"] {
            fs::create_dir(all.join(name)).unwrap();
        }
        fs::write(all.join("notes.txt"), "mine").unwrap();
        let keep = Keep {
            newest: 2,
            every: 4,
        };
        for step in 2..=10 {
            store.write(step, &[], None, keep).unwrap();
        }
        let kept = ["step-00000004", "step-00000008", "step-00000009"];
        let kept = [&["keep-me", "notes.txt", "step-00000004"][..], &kept[1..]].concat();
        assert_eq!(
            left(&store),
            [&kept[..], &["step-00000010", "step-1"]].concat()
        );
        let latest = fs::read_to_string(dir.path().join(LATEST)).unwrap();
        assert_eq!(latest, "step-00000010\n");
    }

    #[test]
    fn a_damaged_checkpoint_is_named_and_the_one_before_it_found() {
        let (dir, store) = run(&[5, 6], TWO);
        let at = |step: u64| store.all().join(format!("step-{step:08}"));
        assert_eq!(store.newest_intact().unwrap().intact, Some(at(6)));
        fs::write(at(6).join("a file"), "7").unwrap();
        let found = store.newest_intact().unwrap();
        assert_eq!(found.intact, Some(at(5)));
        let [damage] = &found.damaged[..] else {
            panic!("{found:?}")
        };
        assert!(damage.contains("step-00000006/a file: damaged"), "{damage}");
        fs::remove_file(at(5).join("a file")).unwrap();
        let found = store.newest_intact().unwrap();
        assert!(found.intact.is_none() && found.damaged.len() == 2);
        drop(dir);
    }

    #[test]
    fn latest_is_believed_and_its_loss_is_no_harm() {
        let (dir, store) = run(&[5, 6, 7], TWO);
        let latest = dir.path().join(LATEST);
        let newest = |store: &Store| {
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
        let (dir, store) = run(&[1], TWO);
        let best = dir.path().join("best");
        fs::write(&best, "weights").unwrap();
        store.write(2, &[], Some(("kept", &best)), TWO).unwrap();
        fs::remove_file(&best).unwrap();
        let found = store.newest_intact().unwrap();
        let kept = found.intact.unwrap().join("kept");
        assert_eq!(fs::read_to_string(kept).unwrap(), "weights");
    }

    #[test]
    fn sums_are_those_of_sha256sum() {
        let (dir, store) = run(&[7], TWO);
        let sums = fs::read_to_string(store.all().join("step-00000007").join(SUMS)).unwrap();
        // printf 7 | sha256sum
        let expected = "7902699be42c8a8e46fbbb4501726517e86b22c56a189f7625a6da49081b2451  a file\n";
        assert_eq!(sums, expected);
        drop(dir);
    }

    #[test]
    fn a_failed_write_names_the_last_good_one() {
        let (dir, store) = run(&[1], TWO);
        let missing = dir.path().join("missing");
        let error = store.write(2, &[], Some(("kept", &missing)), TWO);
        let error = format!("{:#}", error.unwrap_err());
        assert!(
            error.contains("step 2 (the last good one is ") && error.contains("step-00000001"),
            "{error}"
        );
        assert_eq!(left(&store), ["step-00000001"]);
    }
}
