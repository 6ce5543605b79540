//! `demc-infer denoise`: EXR in, EXR out, one file after another.

use std::collections::HashMap;
use std::ffi::OsStr;
use std::fs;
use std::path::{Path, PathBuf};

use anyhow::Context;
use clap::{Args, ValueEnum};
use demc_infer::Bundle;

use super::{Clamped, DeviceFlag, Model, Usage};
use crate::progress::Progress;

/// Denoise OpenEXR images of any size.
///
/// The channels are those of the layout that the model was trained with; `demc-infer inspect` shows it. The output has
/// the channels R, G, B in linear HDR. Negative radiance counts as 0.
///
/// A file that fails is reported, the others are still denoised, and the exit code is 1 in the end.
#[derive(Args)]
#[command(after_help = "Examples:
  demc-infer denoise noisy.exr -o clean.exr
  demc-infer denoise --model runs/quickstart noisy.exr -o clean.exr
  demc-infer denoise --model demc.safetensors frames/*.exr -o denoised/")]
pub struct Denoise {
    #[command(flatten)]
    model: Model,
    /// Noisy images with their feature channels
    #[arg(value_name = "IN.exr", required = true)]
    inputs: Vec<PathBuf>,
    /// Output: a file for one input; a directory, made if needed, for several. Existing files are
    /// replaced, but never an input
    #[arg(short, long, value_name = "OUT")]
    output: PathBuf,
    /// Type of the output channels: half is what renderers write (11 bits of precision, up to 65504)
    #[arg(long, value_enum, default_value = "half")]
    precision: Precision,
    #[command(flatten)]
    device: DeviceFlag,
}

#[derive(Clone, Copy, ValueEnum)]
enum Precision {
    /// 16-bit floating point
    Half,
    /// 32-bit floating point
    Float,
}

impl Denoise {
    /// Denoises all inputs.
    pub fn run(self) -> anyhow::Result<()> {
        let jobs = jobs(&self.inputs, &self.output)?;
        let bundle = self.model.load_onto(&self.device)?;
        let into_directory = jobs.iter().any(|job| job.output != self.output);
        if into_directory {
            fs::create_dir_all(&self.output)
                .with_context(|| format!("cannot create {}", self.output.display()))?;
        }
        let precision = match self.precision {
            Precision::Half => demc_data::Precision::Half,
            Precision::Float => demc_data::Precision::Float,
        };
        let progress = Progress::new(jobs.len());
        let mut clamped = Clamped::default();
        let mut failed = 0;
        for job in &jobs {
            progress.start(job.input.display());
            match job.run(&bundle, precision) {
                Ok(samples) => clamped.count(samples),
                Err(error) if jobs.len() == 1 => return Err(error),
                Err(error) => {
                    failed += 1;
                    progress.line(format_args!("error: {error:#}"));
                }
            }
            progress.advance();
        }
        progress.finish();
        clamped.report();
        anyhow::ensure!(
            failed == 0,
            "{failed} of {} images not denoised",
            jobs.len()
        );
        Ok(())
    }
}

/// One image to denoise.
#[derive(Debug, PartialEq)]
struct Job {
    input: PathBuf,
    output: PathBuf,
}

impl Job {
    /// Returns the number of negative samples that were set to 0.
    fn run(&self, bundle: &Bundle, precision: demc_data::Precision) -> anyhow::Result<usize> {
        let frame = demc_data::read_frame(&self.input, &bundle.meta.layout)?;
        let rgb = bundle.denoise(&frame)?;
        demc_data::write_rgb(&self.output, frame.width, frame.height, &rgb, precision)?;
        Ok(frame.clamped)
    }
}

/// Where each input goes. Refuses, before anything is read, two inputs for one output and an output that is an input.
fn jobs(inputs: &[PathBuf], output: &Path) -> Result<Vec<Job>, Usage> {
    let named_as_directory = output
        .as_os_str()
        .to_string_lossy()
        .ends_with(std::path::is_separator);
    let directory = inputs.len() > 1 || output.is_dir() || named_as_directory;
    if directory && output.exists() && !output.is_dir() {
        return Err(Usage(format!(
            "-o {} is a file; {} input(s) need a directory",
            output.display(),
            inputs.len()
        )));
    }
    let mut taken: HashMap<&OsStr, &Path> = HashMap::new();
    let mut jobs = Vec::with_capacity(inputs.len());
    for input in inputs {
        let name = input
            .file_name()
            .ok_or_else(|| Usage(format!("{} names no file", input.display())))?;
        if let Some(other) = taken.insert(name, input) {
            return Err(Usage(format!(
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
        jobs.push(Job {
            input: input.clone(),
            output,
        });
    }
    let originals: Vec<_> = inputs
        .iter()
        .filter_map(|input| fs::canonicalize(input).ok())
        .collect();
    for job in &jobs {
        if fs::canonicalize(&job.output).is_ok_and(|output| originals.contains(&output)) {
            return Err(Usage(format!(
                "output {} would replace an input",
                job.output.display()
            )));
        }
    }
    Ok(jobs)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn outputs(inputs: &[&str], output: &str) -> Result<Vec<PathBuf>, String> {
        let inputs: Vec<_> = inputs.iter().map(PathBuf::from).collect();
        let jobs = jobs(&inputs, Path::new(output)).map_err(|error| error.to_string())?;
        Ok(jobs.into_iter().map(|job| job.output).collect())
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
            let error = jobs(std::slice::from_ref(&input), output).expect_err("input");
            assert!(
                error.to_string().ends_with("would replace an input"),
                "{error}"
            );
        }
        Ok(())
    }

    #[test]
    fn a_file_cannot_take_several_images() -> std::io::Result<()> {
        let file = tempfile::NamedTempFile::new()?;
        let inputs = ["a.exr".into(), "b.exr".into()];
        let error = jobs(&inputs, file.path()).expect_err("file").to_string();
        assert!(
            error.ends_with("is a file; 2 input(s) need a directory"),
            "{error}"
        );
        Ok(())
    }
}
