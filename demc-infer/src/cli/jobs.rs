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
    fn output(job: &Job, record: &Record) -> Self {
        let Job { input, output, .. } = job;
        if !output.exists() {
            return Self::Replaceable;
        }
        let opened = ExrFile::open(output).and_then(|mut file| {
            file.check_whole()?;
            Ok(file)
        });
        let then = match opened {
            Ok(file) => file.attribute(RECORD).and_then(|text| Record::parse(&text)),
            Err(_) => return Self::Other("damaged, or not an EXR file".into()),
        };
        let Some(then) = then else {
            return Self::Other("not written by this program".into());
        };
        if is_newer(input, output) {
            return Self::Replaceable;
        }
        match record.differences(&then) {
            same if same.is_empty() => Self::Finished,
            options => Self::Other(format!("made with {options}")),
        }
    }

    /// The file at a preview's path.
    fn preview(preview: &Path, job: &Job, exposure: f32) -> Self {
        if !preview.exists() {
            return Self::Replaceable;
        }
        match preview::exposure_of(preview) {
            None => Self::Other("not written by this program".into()),
            Some(then) if job.is_due || then != exposure.to_string() => Self::Replaceable,
            Some(_) if is_newer(&job.output, preview) => Self::Replaceable,
            Some(_) => Self::Finished,
        }
    }
}

/// Whether a file was changed after another one.
fn is_newer(file: &Path, than: &Path) -> bool {
    let modified = |path: &Path| fs::metadata(path).and_then(|found| found.modified());
    modified(than).is_ok_and(|than| modified(file).is_ok_and(|file| file > than))
}

impl Jobs {
    /// Chooses an output for each input, with a preview if `previews` is set, before anything is
    /// read.
    ///
    /// # Errors
    /// Two inputs with the same output; several for one file; a file that is not named as an EXR file.
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
        for job in &self.list {
            let what = format!("the input {}", job.input.display());
            outputs.protect(&job.input, &what);
        }
        let mut files = self
            .list
            .iter()
            .flat_map(|job| std::iter::once(&job.output).chain(&job.preview));
        files.try_for_each(|file| outputs.claim(file, true))
    }

    /// Removes what is finished, and existing files that the command may not replace, also from `outputs`. An
    /// output that this program wrote is made again if its input is newer.
    pub fn skip_existing(&mut self, record: &Record, exposure: f32, outputs: &mut Outputs) {
        for mut job in std::mem::take(&mut self.list) {
            let found = Existing::output(&job, record);
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
mod tests {
    use demc_data::ChannelLayout;
    use demc_data::image::rewrite::{WriteOptions, rewrite};

    use super::*;

    fn jobs(files: Vec<PathBuf>, output: &Path, previews: bool) -> Result<Jobs, UsageError> {
        let several = files.len() > 1;
        let sequences = Vec::new();
        let inputs = Inputs {
            files,
            several,
            sequences,
            empty: Vec::new(),
        };
        Jobs::new(&inputs, output, previews)
    }

    fn outputs(inputs: &[&str], output: &str) -> Result<Vec<PathBuf>, String> {
        let files = inputs.iter().map(PathBuf::from).collect();
        let jobs = jobs(files, Path::new(output), false).map_err(|error| error.to_string())?;
        Ok(jobs.list.into_iter().map(|job| job.output).collect())
    }

    /// The error of claiming the files of a job list.
    fn refusal(jobs: &Jobs) -> String {
        let claimed = jobs.claim(&mut Outputs::default());
        claimed.expect_err("refused").to_string()
    }

    /// Writes an image with a record.
    fn write_image(path: &Path, record: &Record) {
        let options = WriteOptions {
            record: Some(&record.text()),
            ..WriteOptions::default()
        };
        let sample = "../data/sample/test/gen-table-test-1.exr".as_ref();
        let layout = ChannelLayout::resolve("demc-exr").expect("a preset");
        let mut input = ExrFile::open(sample).expect("the sample");
        let window = input.channel("R").expect("red").window;
        let color = vec![0.5; 3 * window.width * window.height];
        rewrite(&mut input, &layout, &color, path, &options).expect("written");
    }

    fn write_preview(path: &Path, image: &Path, exposure: f32) {
        let layout = ChannelLayout::resolve("demc-exr").expect("a preset");
        preview::write(path, image, &layout, exposure).expect("written");
    }

    fn set_time(path: &Path, seconds: u64) {
        let time = std::time::SystemTime::now() + std::time::Duration::from_secs(seconds);
        let file = fs::File::options().write(true).open(path).expect("a file");
        file.set_modified(time).expect("a time");
    }

    #[test]
    fn one_input_makes_a_file_and_several_fill_a_directory() {
        assert_eq!(outputs(&["a.exr"], "out.exr"), Ok(vec!["out.exr".into()]));
        assert_eq!(outputs(&["x/a.exr"], "out/"), Ok(vec!["out/a.exr".into()]));
        let both = vec!["out/a.exr".into(), "out/b.exr".into()];
        assert_eq!(outputs(&["x/a.exr", "b.exr"], "out"), Ok(both));
    }

    #[test]
    fn equal_file_names_are_refused() {
        let error = outputs(&["x/a.exr", "y/a.exr"], "out").expect_err("collision");
        assert!(
            error.starts_with("x/a.exr and y/a.exr have the same file name"),
            "{error}"
        );
    }

    #[test]
    fn an_input_is_never_replaced() -> std::io::Result<()> {
        let dir = tempfile::tempdir()?;
        let [input, picture] = ["a.exr", "pin.png"].map(|name| dir.path().join(name));
        fs::write(&input, "")?;
        fs::write(&picture, "")?;
        let out = dir.path().join("pin.exr");
        for (input, output) in [
            (&input, input.as_path()),
            (&input, dir.path()),
            (&picture, &out),
        ] {
            let jobs = jobs(vec![input.clone()], output, true).expect("a job");
            let error = refusal(&jobs);
            assert!(error.contains("would replace the input"), "{error}");
        }
        Ok(())
    }

    /// What is left to write of one input `a.exr` in `dir`, and what was kept.
    fn left(dir: &Path, record: &Record, exposure: f32) -> (bool, bool, Vec<String>) {
        let inputs = vec![dir.join("in/a.exr")];
        let mut jobs = jobs(inputs, &dir.join("out/"), true).expect("a job");
        jobs.skip_existing(record, exposure, &mut Outputs::default());
        let job = jobs.list.first();
        let due = job.is_some_and(|job| job.is_due);
        let preview = job.is_some_and(|job| job.preview.is_some());
        (due, preview, jobs.kept.into_keys().collect())
    }

    #[test]
    fn existing_files_are_finished_outdated_or_of_another_kind() {
        let dir = tempfile::tempdir().expect("a directory");
        let at = |name: &str| dir.path().join(name);
        let record = Record::of_model("quality", "1a");
        let found = |record: &Record| left(dir.path(), record, 0.0);
        for folder in ["in", "out"] {
            fs::create_dir(at(folder)).expect("a directory");
        }
        fs::write(at("in/a.exr"), "").expect("a file");
        let nothing = Vec::new();
        assert_eq!(found(&record), (true, true, nothing.clone()), "missing");

        write_image(&at("out/a.exr"), &record);
        assert_eq!(found(&record), (false, true, nothing.clone()), "no preview");
        write_preview(&at("out/a.png"), &at("out/a.exr"), 0.0);
        assert_eq!(found(&record), (false, false, nothing.clone()), "finished");
        assert_eq!(
            left(dir.path(), &record, 1.5),
            (false, true, nothing.clone())
        );
        set_time(&at("out/a.exr"), 60);
        assert_eq!(
            found(&record),
            (false, true, nothing.clone()),
            "old preview"
        );
        set_time(&at("in/a.exr"), 120);
        assert_eq!(found(&record), (true, true, nothing), "newer input");

        // Without --overwrite, what another command or program made stays.
        let fast = Record::of_model("fast", "2b");
        set_time(&at("out/a.exr"), 180);
        let kept = vec!["made with --model quality instead of fast".to_owned()];
        assert_eq!(found(&fast), (false, false, kept));
        let whole = fs::read(at("out/a.exr")).expect("an image");
        for length in [100, whole.len() - 1] {
            fs::write(at("out/a.exr"), &whole[..length]).expect("a file");
            let kept = vec!["damaged, or not an EXR file".to_owned()];
            assert_eq!(found(&record), (false, false, kept), "{length} bytes");
        }
        fs::copy("../data/sample/test/gen-table-test-1.exr", at("out/a.exr")).expect("copied");
        let kept = vec!["not written by this program".to_owned()];
        assert_eq!(found(&record), (false, false, kept.clone()));
        fs::remove_file(at("out/a.exr")).expect("removed");
        fs::write(at("out/a.png"), "a photograph").expect("a file");
        assert_eq!(found(&record), (true, false, kept), "a foreign preview");
    }

    #[test]
    fn an_output_is_an_exr_file() {
        for output in ["o.png", "o.tif", "-", "o", "/dev/stdout"] {
            let error = outputs(&["a.exr"], output).expect_err("no EXR file");
            assert!(
                error.starts_with(&format!("-o {output}: an output")),
                "{error}"
            );
        }
        assert!(outputs(&["a.exr"], "o.EXR").is_ok());
    }

    #[test]
    fn a_file_cannot_take_several_images() -> std::io::Result<()> {
        let file = tempfile::NamedTempFile::new()?;
        let inputs = vec!["a.exr".into(), "b.exr".into()];
        let error = jobs(inputs, file.path(), false)
            .expect_err("file")
            .to_string();
        assert!(
            error.ends_with("is a file; 2 input(s) need a directory"),
            "{error}"
        );
        Ok(())
    }
}
