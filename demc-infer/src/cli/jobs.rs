//! Pairs inputs with outputs and skips finished ones.

use std::collections::{BTreeMap, HashMap};
use std::ffi::OsStr;
use std::fs;
use std::path::{Path, PathBuf};

use demc_data::image::exr::ExrFile;
use demc_data::image::rewrite::RECORD;
use demc_program::exit::UsageError;
use demc_program::message;
use demc_program::output::{OutputError, Outputs};

use super::inputs::Inputs;
use super::preview;
use super::record::Record;
use super::shard::Shard;

/// One image to denoise.
#[derive(Debug, PartialEq)]
pub struct Job {
    pub input: PathBuf,
    pub output: PathBuf,
    /// Whether the output is to be written; otherwise it is finished.
    pub is_due: bool,
    /// Whether the command may replace a file at the output's path.
    pub replaces: bool,
    /// The preview to write, if there is to be one.
    pub preview: Option<PathBuf>,
}

/// All images of a command line.
#[derive(Debug)]
pub struct Jobs {
    pub list: Vec<Job>,
    /// Whether the outputs go to a directory.
    pub directory: bool,
    /// Number of all images, with those that are not in the list.
    count: usize,
    /// Number of finished images, which are not in the list.
    skipped: usize,
    /// Existing files that are kept although they are not what the command asks for: their names by the
    /// reason.
    kept: BTreeMap<String, Vec<String>>,
}

/// What is at the path of an output or a preview.
#[derive(Debug, PartialEq)]
enum Existing {
    /// Nothing, or a file of this program that is out of date.
    Replaceable,
    /// The file that the command asks for.
    Finished,
    /// Another file, and in which way.
    Other(String),
}

impl Existing {
    /// The file at an output's path. Files are written atomically, so a file of this program is complete
    /// unless another one cut it.
    ///
    /// An input that cannot be read is reported when its turn comes.
    fn output(job: &Job, record: Option<Record>) -> Self {
        let Job { input, output, .. } = job;
        let opened = ExrFile::open(output).and_then(|mut file| {
            file.check_whole()?;
            Ok(file)
        });
        let then = match opened {
            Ok(file) => file.attribute(RECORD).and_then(|text| Record::parse(&text)),
            Err(demc_data::Error::File(error)) => {
                return Self::Other(format!("and cannot be read: {error}"));
            }
            Err(_) => return Self::Other("damaged, or not an EXR file".into()),
        };
        let Some(then) = then else {
            return Self::Other("not written by this program".into());
        };
        let Some(record) = record else {
            return Self::Replaceable;
        };
        match record.differences(&then) {
            same if same.is_empty() => Self::Finished,
            _ if record.differs_in_content(&then) && is_newer(input, output) => Self::Replaceable,
            options => Self::Other(format!("made with {options}")),
        }
    }

    /// The file at a preview's path.
    fn preview(preview: &Path, job: &Job, exposure: f32) -> Self {
        if !preview.exists() {
            return Self::Replaceable;
        }
        if !preview::is_own(preview) {
            return Self::Other("not written by this program".into());
        }
        let shown = preview::Shown::now(&job.output, exposure).ok();
        if !job.is_due && shown.is_some() && preview::shown(preview) == shown {
            Self::Finished
        } else {
            Self::Replaceable
        }
    }
}

/// Whether a file was changed after another one, or in the same tick of the clock.
fn is_newer(file: &Path, than: &Path) -> bool {
    let modified = |path: &Path| fs::metadata(path).and_then(|found| found.modified());
    modified(than).is_ok_and(|than| modified(file).is_ok_and(|file| file >= than))
}

impl Jobs {
    /// Chooses an output for each input, with a preview if `previews` is set, before anything is
    /// read.
    ///
    /// # Errors
    /// A single input that does not exist; two inputs with the same output; several for one file; a file that is
    /// not named as an EXR file.
    pub fn new(inputs: &Inputs, output: &Path, previews: bool) -> Result<Self, UsageError> {
        let named_as_directory = output
            .as_os_str()
            .to_string_lossy()
            .ends_with(std::path::is_separator);
        let directory = inputs.several || output.is_dir() || named_as_directory;
        if directory && output.exists() && !output.is_dir() {
            return Err(UsageError(format!(
                "-o {} is a file; {} input(s) need a directory",
                output.display(),
                inputs.files.len()
            )));
        }
        let extension = output.extension().and_then(OsStr::to_str);
        if !directory && !extension.is_some_and(|found| found.eq_ignore_ascii_case("exr")) {
            if let Some(input) = inputs.files.iter().find(|input| !input.exists()) {
                // It may have been meant as a pattern, whose outputs go to a directory.
                return Err(UsageError(format!("{}: no such file", input.display())));
            }
            return Err(UsageError(format!(
                "-o {}: an output is an EXR file, named NAME.exr, or a directory, named DIR/; --png writes a preview \
                 beside it",
                output.display()
            )));
        }
        let mut taken: HashMap<&OsStr, &Path> = HashMap::new();
        let mut list = Vec::with_capacity(inputs.files.len());
        for input in &inputs.files {
            let name = input
                .file_name()
                .ok_or_else(|| UsageError(format!("{} has no file name", input.display())))?;
            if let Some(other) = taken.insert(name, input) {
                return Err(UsageError(format!(
                    "{} and {} have the same file name; denoise them into different directories",
                    other.display(),
                    input.display()
                )));
            }
            let output = if directory {
                output.join(name)
            } else {
                output.into()
            };
            list.push(Job {
                input: input.clone(),
                preview: previews.then(|| output.with_extension("png")),
                output,
                is_due: true,
                replaces: true,
            });
        }
        Ok(Self {
            count: list.len(),
            list,
            directory,
            skipped: 0,
            kept: BTreeMap::new(),
        })
    }

    /// Keeps the images of one shard.
    pub fn keep(&mut self, shard: Shard) {
        // No two have the same name.
        shard.keep(&mut self.list, |job| {
            job.input.file_name().map(ToOwned::to_owned)
        });
        self.count = self.list.len();
    }

    /// Notes all files to write. Existing ones are skipped later.
    ///
    /// # Errors
    /// An output or preview that is an input or another output.
    pub fn claim(&self, outputs: &mut Outputs) -> Result<(), OutputError> {
        let mut files = self
            .list
            .iter()
            .flat_map(|job| std::iter::once(&job.output).chain(&job.preview));
        files.try_for_each(|file| outputs.claim(file, true))
    }

    /// Removes what is finished, and existing files that the command may not replace, also from `outputs`. An
    /// output that this program wrote is made again if its input has changed since then. `record` is that of an
    /// input, if it can be read.
    pub fn skip_existing(
        &mut self,
        record: impl Fn(&Path) -> Option<Record>,
        exposure: f32,
        outputs: &mut Outputs,
    ) {
        for mut job in std::mem::take(&mut self.list) {
            let found = if job.output.exists() {
                Existing::output(&job, record(&job.input))
            } else {
                job.replaces = false;
                Existing::Replaceable
            };
            if found != Existing::Replaceable {
                outputs.release(&job.output);
                job.is_due = false;
            }
            if let Existing::Other(why) = &found {
                self.keep_other(why, &job.output);
            }
            let is_made = !matches!(found, Existing::Other(_));
            if let Some(path) = job.preview.take() {
                let found = if is_made {
                    Existing::preview(&path, &job, exposure)
                } else {
                    Existing::Finished
                };
                match found {
                    Existing::Replaceable => job.preview = Some(path),
                    Existing::Finished => outputs.release(&path),
                    Existing::Other(why) => {
                        outputs.release(&path);
                        self.keep_other(&why, &path);
                    }
                }
            }
            if job.is_due || job.preview.is_some() {
                self.list.push(job);
            } else if is_made {
                self.skipped += 1;
            }
        }
    }

    fn keep_other(&mut self, why: &str, file: &Path) {
        let files = self.kept.entry(why.to_owned()).or_default();
        files.push(file.display().to_string());
    }

    /// Says which images are skipped. Returns the number of files that are kept although they are not what the
    /// command asks for.
    ///
    /// # Errors
    /// The output that is not in a directory, or its preview, is such a file.
    pub fn report_skipped(&self) -> Result<usize, UsageError> {
        if self.skipped > 0 {
            let (done, all) = (self.skipped, self.count);
            message::say(format_args!(
                "note: {done} of {all} images already exist; --overwrite replaces them"
            ));
        }
        for (why, files) in &self.kept {
            let more = match files.len() - 1 {
                0 => String::new(),
                more => format!(" (and {more} more)"),
            };
            let line = format!("{}{more} exists, {why}; --overwrite replaces it", files[0]);
            if !self.directory {
                return Err(UsageError(line));
            }
            message::say(format_args!("error: {line}"));
        }
        Ok(self.kept.values().map(Vec::len).sum())
    }
}

#[cfg(test)]
mod tests;
