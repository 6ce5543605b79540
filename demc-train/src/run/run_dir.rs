//! The run directory: its files and its lock.
//!
//! ```text
//! config.toml       the resolved configuration, which repeats the run
//! layout.toml       the channel layout, if it is not a preset
//! run.json          versions, device, scenes and checksums of their files, statistics, train.init
//! metrics.jsonl     one object per line, see `metrics_log`
//! tensorboard/      metrics and pictures for TensorBoard
//! latest, checkpoints/, best.safetensors
//! strips/           pictures of every validation and of the test split
//! test.json         scores of the test split
//! ```

use std::collections::BTreeMap;
use std::fs::{self, File};
use std::io::Write;
use std::path::{Path, PathBuf};

use anyhow::{Context, bail, ensure};
use demc_infer::bundle::locate::{BEST, LATEST};
use demc_program::exit::UsageError;
use demc_program::file::{remove_abandoned, write_whole};

use crate::config::Config;
use crate::record::metrics_log::METRICS;
use crate::run::checkpoint::store::CheckpointStore;
use crate::run::data::TrainingData;
use crate::run::run_record::{CONFIG, LAYOUT, OWN_FILES, RUN, RecordedSetup, RunRecord, is_usable};

/// Locked by the training process.
const LOCK: &str = "lock";
/// The directory of the pictures of validations and of the test split.
const STRIPS: &str = "strips";
/// Scores of the test split.
pub const SCORES: &str = "test.json";
/// Files that show that a directory contains a run.
const TRACES: [&str; 4] = [RUN, METRICS, "checkpoints", LATEST];

/// The files in `dir` that a run replaces if they exist.
pub fn replaced_files(dir: &Path) -> Vec<PathBuf> {
    let mut names = vec![METRICS, LATEST, BEST, SCORES, "strips/test.png"];
    if !dir.join(CONFIG).exists() {
        names.push(LAYOUT);
    }
    let strips = fs::read_dir(dir.join(STRIPS)).into_iter().flatten();
    let mut files: Vec<PathBuf> = names.into_iter().map(|name| dir.join(name)).collect();
    for strip in strips.flatten().map(|entry| entry.path()) {
        if !files.contains(&strip) {
            files.push(strip);
        }
    }
    files
}

/// The directory of a run.
#[derive(Debug)]
pub struct RunDir {
    path: PathBuf,
    /// Held while the run writes.
    lock: Option<File>,
}

impl RunDir {
    /// The directory of a run, if it is free or contains the same run and `resume` is set. Writes
    /// nothing.
    ///
    /// If the saved configuration is missing or damaged, that of the newest intact checkpoint is
    /// used.
    ///
    /// # Errors
    /// A directory with a run that is not to be resumed, or with another run: each differing key is
    /// named. A directory without a run, but with a file of a run's name.
    pub fn claim(config: &Config, resume: bool) -> anyhow::Result<Self> {
        let path = config.run_dir().to_path_buf();
        let dir = RunDir {
            path: path.clone(),
            lock: None,
        };
        let trace = OWN_FILES.iter().chain(&TRACES);
        let Some(trace) = trace.into_iter().find(|name| path.join(name).exists()) else {
            if let Some(file) = replaced_files(&path).iter().find(|file| file.exists()) {
                let problem = format!(
                    "{}: belongs to no run, and a run would replace it; move it, or name another directory \
                     with --run-dir",
                    file.display()
                );
                return Err(UsageError(problem).into());
            }
            return Ok(dir);
        };
        let saved = dir.saved_config()?;
        if resume
            && saved.is_none()
            && !matches!(read_record(&path.join(RUN))?, StoredRecord::Intact(_))
        {
            bail!(
                "{}: has {trace}, but no configuration, record, or checkpoint of a run; move the file, or name \
                 another directory with --run-dir",
                path.display()
            );
        }
        if let Some(saved) = saved {
            let differences = config.differences(&saved);
            ensure!(
                differences.is_empty(),
                "{}: contains a run with another configuration: {}; undo the edit, or name another directory with --run-dir",
                path.display(),
                differences.join("; ")
            );
        }
        if !resume {
            bail!(
                "{}: already contains a run ({trace}); --resume resumes it, --run-dir names another directory",
                path.display()
            );
        }
        Ok(dir)
    }

    /// The directory for a process that writes nothing into it.
    pub fn unclaimed(config: &Config) -> Self {
        RunDir {
            path: config.run_dir().to_path_buf(),
            lock: None,
        }
    }

    /// The configuration of the run in the directory: its own, or that of the newest intact
    /// checkpoint if it is missing or damaged. `None` without either.
    fn saved_config(&self) -> anyhow::Result<Option<Config>> {
        if let Ok(saved) = Config::load(&self.path.join(CONFIG), &[]) {
            return Ok(Some(saved));
        }
        let copy = copy_in_checkpoint(&self.path, CONFIG)?;
        Ok(copy.map(|copy| Config::load(&copy, &[])).transpose()?)
    }

    /// Compares the scenes with those of the start of the run, if its record is intact.
    ///
    /// # Errors
    /// Each scene that differs, by name.
    pub fn check_scenes(&self, data: &TrainingData) -> anyhow::Result<()> {
        let path = self.path.join(RUN);
        match read_record(&path)? {
            StoredRecord::Intact(record) => record.check_scenes(&path, data),
            StoredRecord::Missing | StoredRecord::Damaged => Ok(()),
        }
    }

    /// Compares the files of scenes with those of the start of the run, if its record is intact.
    ///
    /// # Errors
    /// Each scene that differs, by name.
    pub fn check_files(&self, checksums: &BTreeMap<String, String>) -> anyhow::Result<()> {
        let path = self.path.join(RUN);
        match read_record(&path)? {
            StoredRecord::Intact(record) => record.check_files(&path, checksums),
            StoredRecord::Missing | StoredRecord::Damaged => Ok(()),
        }
    }

    /// Locks the directory, if it exists, against other training processes. Removes incomplete files
    /// of killed ones.
    ///
    /// # Errors
    /// A directory that another process has locked.
    pub fn lock_if_present(&mut self) -> anyhow::Result<()> {
        if self.path.is_dir() {
            self.lock()?;
            for dir in [self.path.clone(), self.path.join(STRIPS)] {
                remove_abandoned(&dir, None);
            }
        }
        Ok(())
    }

    /// The directory.
    pub fn path(&self) -> &Path {
        &self.path
    }

    /// Creates and locks the directory. Writes configuration and record of a new run; compares the
    /// record of a resumed one. Returns notes: changed versions or device, and damaged files, which
    /// are written again.
    ///
    /// # Errors
    /// A directory that cannot be written or is in use; other scenes, statistics or layout than at
    /// the start of the run.
    pub fn open(
        &mut self,
        config: &Config,
        data: &TrainingData,
        facts: RecordedSetup,
    ) -> anyhow::Result<Vec<String>> {
        let made = fs::create_dir_all(&self.path);
        made.with_context(|| format!("cannot create {}", self.path.display()))?;
        if self.lock.is_none() {
            self.lock()?;
        }
        let mut notes = Vec::new();
        let damaged = |path: &Path| format!("{} was damaged: written again", path.display());
        let saved = self.path.join(CONFIG);
        if !fs::read(&saved).is_ok_and(|bytes| is_usable(CONFIG, &bytes)) {
            notes.extend(saved.exists().then(|| damaged(&saved)));
            let mut saved = config.clone();
            if config.data.layout.ends_with(".toml") {
                self.write(LAYOUT, toml::to_string(&data.layout)?.as_bytes())?;
                saved.data.layout = self.path.join(LAYOUT).to_string_lossy().into_owned();
            }
            self.write(CONFIG, saved.to_toml().as_bytes())?;
        }
        let path = self.path.join(RUN);
        let now = RunRecord::new(data, facts);
        match read_record(&path)? {
            StoredRecord::Intact(first) => {
                first.check_data(&path, data)?;
                first.check_patches(&path, &now)?;
                notes.extend(first.version_note(&now));
                return Ok(notes);
            }
            StoredRecord::Damaged => notes.push(damaged(&path)),
            StoredRecord::Missing => {}
        }
        self.write(RUN, &serde_json::to_vec_pretty(&now)?)?;
        Ok(notes)
    }

    fn lock(&mut self) -> anyhow::Result<()> {
        let path = self.path.join(LOCK);
        let file = File::create(&path).with_context(|| path.display().to_string())?;
        if file.try_lock().is_err() {
            bail!(
                "{}: in use by another training process",
                self.path.display()
            );
        }
        self.lock = Some(file);
        Ok(())
    }

    /// Writes a file of the run, complete or not at all.
    ///
    /// # Errors
    /// A file that cannot be written.
    pub fn write(&self, name: &str, bytes: &[u8]) -> anyhow::Result<()> {
        Ok(write_whole(&self.path.join(name), |file| {
            file.write_all(bytes)
        })?)
    }
}

/// The copy of a run's file in its newest intact checkpoint, if there is one.
///
/// # Errors
/// A directory that cannot be read.
pub fn copy_in_checkpoint(run: &Path, name: &str) -> anyhow::Result<Option<PathBuf>> {
    let checkpoint = CheckpointStore::new(run).newest_intact()?.intact;
    Ok(checkpoint
        .map(|dir| dir.join(name))
        .filter(|copy| copy.exists()))
}

/// What a run directory has as its record.
enum StoredRecord {
    Missing,
    Damaged,
    Intact(Box<RunRecord>),
}

fn read_record(path: &Path) -> anyhow::Result<StoredRecord> {
    match fs::read(path) {
        Ok(bytes) => Ok(match serde_json::from_slice(&bytes) {
            Ok(record) => StoredRecord::Intact(record),
            Err(_) => StoredRecord::Damaged,
        }),
        Err(error) if error.kind() == std::io::ErrorKind::NotFound => Ok(StoredRecord::Missing),
        Err(error) => Err(error).with_context(|| path.display().to_string()),
    }
}
