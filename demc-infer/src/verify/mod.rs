//! Whether an exported file computes what this program does: it is run where it will be used, through Python, on synthetic
//! frames, and compared.

mod synthetic;

use std::fs;
use std::io::Write;
use std::path::{Path, PathBuf};
use std::process::{Command, Output, Stdio};

use rand::SeedableRng;
use rand_chacha::ChaCha8Rng;

use crate::bundle::tensors::f32_bytes;
use crate::{Bundle, DenoiseError};

/// Largest deviation that passes.
pub const TOLERANCE: f32 = 1e-4;
/// Images, height and width of the batches that are compared: square, neither, and several at a time.
pub const SIZES: [[usize; 3]; 4] = [[1, 32, 32], [1, 96, 160], [2, 224, 32], [1, 256, 256]];
/// Epsilon of RelMSE (Eq. 5).
const RELMSE_EPSILON: f32 = 0.001;
/// What the frames are drawn from.
const SEED: u64 = 20190101;
/// Exit code of the script where a package is missing.
const NO_PACKAGE: i32 = 3;
const SCRIPT: &str = include_str!("run.py");

/// What runs the file.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Runtime {
    /// An ONNX file.
    OnnxRuntime,
    /// A bundle, with the package of `python/`.
    PyTorch,
}

impl Runtime {
    /// What the script calls it, and what `pip install` takes for it; `./python` is in this project's repository.
    fn words(self) -> [&'static str; 2] {
        match self {
            Runtime::OnnxRuntime => ["onnx", "numpy onnxruntime"],
            Runtime::PyTorch => ["torch", "./python"],
        }
    }
}

/// How far a batch lies from this program's.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Deviation {
    /// Images, height and width.
    pub size: [usize; 3],
    /// Largest difference, as a share of the batch's largest value.
    pub of_largest: f32,
    /// Largest difference of a value as a share of `sqrt(x^2 + 0.001)`, which is how RelMSE (Eq. 5) weighs it: of the value
    /// itself, and of 0.03 where it is dark.
    pub of_value: f32,
}

impl Deviation {
    /// Of two batches of this size.
    fn of(size: [usize; 3], found: &[f32], expected: &[f32]) -> Self {
        let largest = expected.iter().fold(0.0f32, |m, x| m.max(x.abs()));
        let worst = |share: &dyn Fn(f32, f32) -> f32| {
            let shares = found.iter().zip(expected).map(|(f, e)| share(*f, *e));
            // NaN agrees with nothing; equal zeros agree.
            shares.fold(
                0.0f32,
                |m, x| if x.is_nan() { f32::INFINITY } else { m.max(x) },
            )
        };
        Self {
            size,
            of_largest: worst(&|f, e| match (f - e).abs() {
                0.0 => 0.0,
                difference => difference / largest,
            }),
            of_value: worst(&|f, e| (f - e).abs() / (e * e + RELMSE_EPSILON).sqrt()),
        }
    }

    /// Whether both are within [`TOLERANCE`].
    pub fn passes(&self) -> bool {
        self.of_largest <= TOLERANCE && self.of_value <= TOLERANCE
    }
}

/// What was found.
#[derive(Debug, Clone, PartialEq)]
pub struct Verification {
    /// Name and version of what ran the file.
    pub runtime: String,
    /// One for each of [`SIZES`].
    pub deviations: Vec<Deviation>,
}

/// Why a file could not be compared.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum VerifyError {
    /// No such interpreter.
    #[error("cannot run {python}; --python or DEMC_PYTHON names another interpreter")]
    Python {
        /// What was tried.
        python: PathBuf,
        /// Why it failed.
        source: std::io::Error,
    },
    /// It lacks what runs the file.
    #[error("{0} cannot import what runs the file ({0} -m pip install {packages}): {detail}", python.display())]
    Packages {
        /// The interpreter.
        python: PathBuf,
        /// What `pip install` takes.
        packages: &'static str,
        /// What it could not import.
        detail: String,
    },
    /// It does not take the file.
    #[error("{} in {}: {detail}", file.display(), python.display())]
    Run {
        /// The interpreter.
        python: PathBuf,
        /// The file.
        file: PathBuf,
        /// The last line that it said.
        detail: String,
    },
    /// No place for the frames.
    #[error("a temporary file")]
    Temporary(#[from] std::io::Error),
    /// This program cannot denoise a frame.
    #[error(transparent)]
    Denoise(#[from] DenoiseError),
}

/// Runs `file` in `python` and compares with `expected`, on frames that are the same each time for the same statistics.
///
/// # Errors
/// An interpreter, or a package of it, that is not there; a file that it cannot run. A deviation is none: see
/// [`Deviation::passes`].
pub fn verify(
    file: &Path,
    runtime: Runtime,
    python: &Path,
    expected: &Bundle,
) -> Result<Verification, VerifyError> {
    let folder = tempfile::tempdir()?;
    let mut rng = ChaCha8Rng::seed_from_u64(SEED);
    let mut outputs = Vec::with_capacity(SIZES.len());
    for (i, [batch, height, width]) in SIZES.into_iter().enumerate() {
        let (mut colors, mut features, mut output) = (Vec::new(), Vec::new(), Vec::new());
        for _ in 0..batch {
            let statistics = &expected.meta.normalizer.features;
            let frame = synthetic::frame([height, width], statistics, &mut rng);
            output.extend(expected.denoise(&frame)?);
            colors.extend(frame.color);
            features.extend(frame.features);
        }
        fs::write(folder.path().join(format!("{i}.color")), f32_bytes(&colors))?;
        fs::write(
            folder.path().join(format!("{i}.features")),
            f32_bytes(&features),
        )?;
        outputs.push(output);
    }
    let runtime = run(file, runtime, python, folder.path())?;
    let mut deviations = Vec::with_capacity(SIZES.len());
    for ((i, size), expected) in SIZES.into_iter().enumerate().zip(outputs) {
        let bytes = fs::read(folder.path().join(format!("{i}.output")))?;
        let words = bytes.as_chunks().0.iter();
        let found: Vec<f32> = words.map(|word| f32::from_le_bytes(*word)).collect();
        if found.len() != expected.len() {
            return Err(VerifyError::Run {
                python: python.into(),
                file: file.into(),
                detail: format!("{} values instead of {}", found.len(), expected.len()),
            });
        }
        deviations.push(Deviation::of(size, &found, &expected));
    }
    Ok(Verification {
        runtime,
        deviations,
    })
}

/// Lets Python answer the folder's inputs. Returns name and version of the runtime.
fn run(file: &Path, runtime: Runtime, python: &Path, folder: &Path) -> Result<String, VerifyError> {
    let [kind, packages] = runtime.words();
    let start = |source| VerifyError::Python {
        python: python.into(),
        source,
    };
    let mut child = Command::new(python)
        .args(["-c", SCRIPT, kind])
        .args([file, folder])
        .stdin(Stdio::piped())
        .stdout(Stdio::piped())
        .stderr(Stdio::piped())
        .spawn()
        .map_err(start)?;
    let sizes = format!("{SIZES:?}");
    if let Some(mut stdin) = child.stdin.take() {
        // Where it has ended already, its exit code and last words say why.
        let _ = stdin.write_all(sizes.as_bytes());
    }
    let Output {
        status,
        stdout,
        stderr,
    } = child.wait_with_output().map_err(start)?;
    let last_line = |bytes: &[u8]| {
        let text = String::from_utf8_lossy(bytes);
        let line = text.lines().rev().find(|line| !line.trim().is_empty());
        line.unwrap_or("it said nothing").trim().to_string()
    };
    match status.code() {
        Some(0) => Ok(last_line(&stdout)),
        Some(NO_PACKAGE) => Err(VerifyError::Packages {
            python: python.into(),
            packages,
            detail: last_line(&stderr),
        }),
        _ => Err(VerifyError::Run {
            python: python.into(),
            file: file.into(),
            detail: last_line(&stderr),
        }),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::bundle::testing::bundle;
    use demc_model::Variant;

    #[test]
    fn deviations_are_of_the_largest_and_of_each_value() {
        let size = [1, 1, 1];
        let deviation = Deviation::of(size, &[10.0, 0.01, 0.0], &[10.0, 0.0, 0.0]);
        assert!((deviation.of_largest - 1e-3).abs() < 1e-9);
        assert!((deviation.of_value - 0.01 / 0.001f32.sqrt()).abs() < 1e-6);
        assert!(!deviation.passes());
        assert!(Deviation::of(size, &[0.0, 2.0], &[0.0, 2.0]).passes());
        for nan in [[f32::NAN, 2.0], [0.0, f32::NAN]] {
            assert!(!Deviation::of(size, &nan, &[0.0, 2.0]).passes());
        }
        assert!(!Deviation::of(size, &[1e-3], &[0.0]).passes());
    }

    #[test]
    fn a_synthetic_frame_is_one_that_a_model_takes() {
        let bundle = bundle(Variant::Demc);
        let statistics = &bundle.meta.normalizer.features;
        let mut rng = ChaCha8Rng::seed_from_u64(1);
        let frame = synthetic::frame([64, 96], statistics, &mut rng);
        assert!(bundle.check_statistics(&frame).is_ok());
        assert_eq!(frame.color.len(), 3 * 64 * 96);
        assert!(frame.color.iter().any(|x| *x > 10.0), "no firefly");
        let black = frame.color.iter().filter(|x| **x == 0.0).count();
        assert!((1500..2200).contains(&(black / 3)), "{black}");
        for (i, plane) in frame.features.chunks_exact(64 * 96).enumerate() {
            let z = |x: &f32| (x - statistics.mean[i]) / statistics.std[i];
            let mean = plane.iter().map(z).sum::<f32>() / (64.0 * 96.0);
            assert!(mean.abs() < 0.6, "channel {i}: {mean}");
        }
    }

    #[test]
    fn an_interpreter_that_is_not_there_is_named() {
        let nowhere = Path::new("/nowhere/python3");
        let bundle = bundle(Variant::ColorOnly);
        let found = verify(Path::new("x"), Runtime::OnnxRuntime, nowhere, &bundle);
        let error = found.expect_err("no interpreter").to_string();
        assert!(error.starts_with("cannot run /nowhere/python3"), "{error}");
    }
}
