//! Pairs inputs with outputs and skips finished ones.

use std::collections::HashMap;
use std::ffi::OsStr;
use std::fs;
use std::path::{Path, PathBuf};

use super::UsageError;
use super::inputs::Inputs;

/// One image to denoise.
#[derive(Debug, PartialEq)]
pub struct Job {
    pub input: PathBuf,
    pub output: PathBuf,
}

impl Job {
    pub fn preview(&self) -> PathBuf {
        self.output.with_extension("png")
    }

    fn is_done(&self) -> bool {
        let modified = |path: &Path| fs::metadata(path).and_then(|found| found.modified());
        match (modified(&self.input), modified(&self.output)) {
            (Ok(input), Ok(output)) => input <= output,
            (_, output) => output.is_ok(),
        }
    }
}

/// All images of a command line.
#[derive(Debug)]
pub struct Jobs {
    pub list: Vec<Job>,
    /// Whether the outputs go to a directory.
    pub directory: bool,
    /// Number of finished images, which are not in the list.
    pub skipped: usize,
}

impl Jobs {
    /// Chooses an output for each input, before anything is read.
    ///
    /// # Errors
    /// Two inputs with the same output, or an output that is an input.
    pub fn new(inputs: &Inputs, output: &Path) -> Result<Self, UsageError> {
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
                output,
            });
        }
        let originals: Vec<_> = inputs
            .files
            .iter()
            .filter_map(|input| fs::canonicalize(input).ok())
            .collect();
        for job in &list {
            if fs::canonicalize(&job.output).is_ok_and(|output| originals.contains(&output)) {
                return Err(UsageError(format!(
                    "output {} would replace an input",
                    job.output.display()
                )));
            }
        }
        Ok(Self {
            list,
            directory,
            skipped: 0,
        })
    }

    /// Removes finished images from the list. Outputs are written atomically, so an existing output
    /// is finished, unless its input is newer. With `previews`, its preview must exist, too.
    ///
    /// # Errors
    /// The only output exists, so there is nothing to do.
    pub fn skip_done(&mut self, previews: bool) -> Result<(), UsageError> {
        if let (false, [job]) = (self.directory, &self.list[..])
            && job.output.exists()
        {
            let output = job.output.display();
            return Err(UsageError(format!(
                "{output} exists; --overwrite replaces it"
            )));
        }
        let before = self.list.len();
        self.list
            .retain(|job| !job.is_done() || previews && !job.preview().exists());
        self.skipped += before - self.list.len();
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn jobs(files: Vec<PathBuf>, output: &Path) -> Result<Jobs, UsageError> {
        let several = files.len() > 1;
        let sequences = Vec::new();
        let inputs = Inputs {
            files,
            several,
            sequences,
        };
        Jobs::new(&inputs, output)
    }

    fn outputs(inputs: &[&str], output: &str) -> Result<Vec<PathBuf>, String> {
        let files = inputs.iter().map(PathBuf::from).collect();
        let jobs = jobs(files, Path::new(output)).map_err(|error| error.to_string())?;
        Ok(jobs.list.into_iter().map(|job| job.output).collect())
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
        let input = dir.path().join("a.exr");
        fs::write(&input, "")?;
        for output in [&input, dir.path()] {
            let error = jobs(vec![input.clone()], output).expect_err("input");
            assert!(
                error.to_string().ends_with("would replace an input"),
                "{error}"
            );
        }
        Ok(())
    }

    #[test]
    fn an_output_older_than_its_input_is_made_again() -> std::io::Result<()> {
        let dir = tempfile::tempdir()?;
        let (input, out) = (dir.path().join("a.exr"), dir.path().join("out"));
        fs::create_dir(&out)?;
        fs::write(&input, "")?;
        fs::write(out.join("a.exr"), "")?;
        let left = || {
            let mut jobs = jobs(vec![input.clone()], &out).expect("a job");
            jobs.skip_done(false).expect("a directory");
            jobs.list.len()
        };
        assert_eq!(left(), 0);
        let later = std::time::SystemTime::now() + std::time::Duration::from_secs(60);
        fs::File::options()
            .write(true)
            .open(&input)?
            .set_modified(later)?;
        assert_eq!(left(), 1);
        Ok(())
    }

    #[test]
    fn a_file_cannot_take_several_images() -> std::io::Result<()> {
        let file = tempfile::NamedTempFile::new()?;
        let inputs = vec!["a.exr".into(), "b.exr".into()];
        let error = jobs(inputs, file.path()).expect_err("file").to_string();
        assert!(
            error.ends_with("is a file; 2 input(s) need a directory"),
            "{error}"
        );
        Ok(())
    }

    #[test]
    fn an_existing_output_is_skipped_in_a_directory_and_an_error_alone() -> std::io::Result<()> {
        let dir = tempfile::tempdir()?;
        fs::write(dir.path().join("a.exr"), "")?;
        let inputs = || vec!["x/a.exr".into(), "x/b.exr".into()];
        let mut several = jobs(inputs(), dir.path()).expect("jobs");
        several.skip_done(false).expect("one is left");
        assert_eq!((several.skipped, several.list.len()), (1, 1));
        fs::write(dir.path().join("b.exr"), "")?;
        fs::write(dir.path().join("b.png"), "")?;
        let mut previews = jobs(inputs(), dir.path()).expect("jobs");
        previews.skip_done(true).expect("a.png is missing");
        assert_eq!((previews.skipped, previews.list.len()), (1, 1));
        let mut alone = jobs(vec!["x/a.exr".into()], &dir.path().join("a.exr")).expect("a job");
        let error = alone.skip_done(false).expect_err("it exists").to_string();
        assert!(
            error.ends_with("a.exr exists; --overwrite replaces it"),
            "{error}"
        );
        Ok(())
    }
}
