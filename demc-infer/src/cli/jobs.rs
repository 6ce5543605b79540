//! Pairs inputs with outputs and skips finished ones.

use std::collections::HashMap;
use std::ffi::OsStr;
use std::fs;
use std::path::{Path, PathBuf};

use demc_program::exit::UsageError;
use demc_program::message;
use demc_program::output::{OutputError, Outputs};

use super::inputs::Inputs;
use super::shard::Shard;

/// One image to denoise.
#[derive(Debug, PartialEq)]
pub struct Job {
    pub input: PathBuf,
    /// The file to write; `None` if it is finished.
    pub output: Option<PathBuf>,
    /// The preview to write; `None` if there is to be none, or one exists.
    pub preview: Option<PathBuf>,
}

/// All images of a command line.
#[derive(Debug)]
pub struct Jobs {
    pub list: Vec<Job>,
    /// Whether the outputs go to a directory.
    pub directory: bool,
    /// Number of finished images, which are not in the list.
    pub skipped: usize,
    /// Number of previews that exist without their image, and are kept.
    pub kept_previews: usize,
}

impl Jobs {
    /// Chooses an output for each input, with a preview if `previews` is set, before anything is
    /// read.
    ///
    /// # Errors
    /// Two inputs with the same output; several for one file.
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
                output: Some(output),
            });
        }
        Ok(Self {
            list,
            directory,
            skipped: 0,
            kept_previews: 0,
        })
    }

    /// Keeps the images of one shard.
    pub fn keep(&mut self, shard: Shard) {
        // No two have the same name.
        shard.keep(&mut self.list, |job| {
            job.input.file_name().map(ToOwned::to_owned)
        });
    }

    /// Notes all files to write. In a directory, existing ones are skipped later.
    ///
    /// # Errors
    /// An output or preview that is an input or another output; without `overwrite`, an existing
    /// file, unless the outputs go to a directory.
    pub fn claim(&self, outputs: &mut Outputs, overwrite: bool) -> Result<(), OutputError> {
        for job in &self.list {
            let what = format!("the input {}", job.input.display());
            outputs.protect(&job.input, &what);
        }
        let mut files = self
            .list
            .iter()
            .flat_map(|job| job.output.iter().chain(&job.preview));
        files.try_for_each(|file| outputs.claim(file, overwrite || self.directory))
    }

    /// Says how many images and previews are skipped.
    pub fn report_skipped(&self) {
        if self.skipped > 0 {
            let (done, all) = (self.skipped, self.skipped + self.list.len());
            message::say(format_args!(
                "note: {done} of {all} images already exist; --overwrite replaces them"
            ));
        }
        if self.kept_previews > 0 {
            let kept = self.kept_previews;
            message::say(format_args!(
                "note: existing previews are kept: {kept}; --overwrite replaces them"
            ));
        }
    }

    /// Removes what exists in the output directory, also from `outputs`. Files are written
    /// atomically, so an existing output is finished, unless its input is newer. Then its preview is
    /// written again, too.
    pub fn skip_done(&mut self, outputs: &mut Outputs) {
        let before = self.list.len();
        for Job {
            input,
            output,
            preview,
        } in &mut self.list
        {
            let modified = |path: &Path| fs::metadata(path).and_then(|found| found.modified());
            let made = output.as_deref().map(modified);
            if let Some(Ok(made)) = made
                && modified(input).is_ok_and(|changed| changed > made)
            {
                continue;
            }
            let mut take = |file: &mut Option<PathBuf>| {
                let existing = file.take_if(|file| file.exists());
                existing.inspect(|file| outputs.release(file))
            };
            take(output);
            let kept = take(preview);
            self.kept_previews += usize::from(kept.is_some() && output.is_some());
        }
        self.list
            .retain(|job| job.output.is_some() || job.preview.is_some());
        self.skipped += before - self.list.len();
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn jobs(files: Vec<PathBuf>, output: &Path, previews: bool) -> Result<Jobs, UsageError> {
        let several = files.len() > 1;
        let sequences = Vec::new();
        let inputs = Inputs {
            files,
            several,
            sequences,
        };
        Jobs::new(&inputs, output, previews)
    }

    fn outputs(inputs: &[&str], output: &str) -> Result<Vec<PathBuf>, String> {
        let files = inputs.iter().map(PathBuf::from).collect();
        let jobs = jobs(files, Path::new(output), false).map_err(|error| error.to_string())?;
        let outputs = jobs.list.into_iter().filter_map(|job| job.output);
        Ok(outputs.collect())
    }

    /// The error of claiming the files of a job list.
    fn refusal(jobs: &Jobs) -> String {
        let claimed = jobs.claim(&mut Outputs::default(), false);
        claimed.expect_err("refused").to_string()
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
        let jobs = jobs(vec![input], &dir.path().join("both.png"), true).expect("a job");
        let error = refusal(&jobs);
        assert!(error.contains("would be written twice"), "{error}");
        Ok(())
    }

    #[test]
    fn an_output_older_than_its_input_is_made_again() -> std::io::Result<()> {
        let dir = tempfile::tempdir()?;
        let (input, out) = (dir.path().join("a.exr"), dir.path().join("out"));
        fs::create_dir(&out)?;
        fs::write(&input, "")?;
        fs::write(out.join("a.exr"), "")?;
        fs::write(out.join("a.png"), "")?;
        let left = || {
            let mut jobs = jobs(vec![input.clone()], &out, true).expect("a job");
            jobs.skip_done(&mut Outputs::default());
            let files = |job: Job| job.output.into_iter().chain(job.preview);
            jobs.list.into_iter().flat_map(files).count()
        };
        assert_eq!(left(), 0);
        let later = std::time::SystemTime::now() + std::time::Duration::from_secs(60);
        fs::File::options()
            .write(true)
            .open(&input)?
            .set_modified(later)?;
        assert_eq!(left(), 2);
        Ok(())
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

    #[test]
    fn an_existing_file_is_skipped_in_a_directory_and_an_error_alone() -> std::io::Result<()> {
        let dir = tempfile::tempdir()?;
        let at = |name: &str| dir.path().join(name);
        for name in ["a.exr", "b.exr", "b.png", "c.png"] {
            fs::write(at(name), "")?;
        }
        let inputs = || ["x/a.exr", "x/b.exr", "x/c.exr"].map(PathBuf::from).into();
        let mut several = jobs(inputs(), dir.path(), false).expect("jobs");
        several.skip_done(&mut Outputs::default());
        assert_eq!((several.skipped, several.list.len()), (2, 1));
        let mut previews = jobs(inputs(), dir.path(), true).expect("jobs");
        previews.skip_done(&mut Outputs::default());
        let [a, c] = &previews.list[..] else {
            panic!("{previews:?}")
        };
        assert_eq!((&a.output, &a.preview), (&None, &Some(at("a.png"))));
        assert_eq!((&c.output, &c.preview), (&Some(at("c.exr")), &None));
        assert_eq!(previews.kept_previews, 1);
        for (output, exists) in [("a.exr", "a.exr"), ("c.exr", "c.png")] {
            let alone = jobs(vec!["x/a.exr".into()], &at(output), true).expect("a job");
            let error = refusal(&alone);
            let end = format!("{exists} exists; --overwrite replaces it");
            assert!(error.ends_with(&end), "{error}");
        }
        Ok(())
    }
}
