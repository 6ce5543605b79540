//! Verifies an exported file: Python runs it on synthetic frames, in ONNX Runtime, PyTorch, or Open Image
//! Denoise, and the output is compared with this program's.

mod synthetic;

use std::fs;
use std::io::Write;
use std::path::{Path, PathBuf};
use std::process::{Command, Output, Stdio};

use demc_data::{Frame, InputKind};
use demc_model::Head;
use demc_model::unet::Guides;
use rand::SeedableRng;
use rand_chacha::ChaCha8Rng;

use crate::bundle::tensors::f32_bytes;
use crate::{Bundle, DenoiseError};
use synthetic::SyntheticBatch;

/// Largest accepted deviation.
pub const TOLERANCE: f32 = 1e-4;
/// Largest accepted deviation relative to a value of a network with kernel head, which averages dark
/// pixels with fireflies. Measured beside a firefly of 65,000 times the radiance: ONNX Runtime deviates
/// from float64 by 2.5e-4, and from this program by 8e-4.
pub const KERNEL_TOLERANCE: f32 = 1e-3;
/// Images, height and width of the compared batches: square and not, one image and two.
pub const SIZES: [[usize; 3]; 4] = [[1, 32, 32], [1, 96, 160], [2, 224, 32], [1, 256, 256]];
/// The same for Open Image Denoise, which takes images of any size.
const OIDN_SIZES: [[usize; 3]; 4] = [[1, 32, 32], [1, 201, 183], [2, 16, 250], [1, 256, 256]];
/// Epsilon of RelMSE (Eq. 5).
const RELMSE_EPSILON: f32 = 0.001;
const SEED: u64 = 20190101;
/// Exit code of the script for a missing package.
const NO_PACKAGE: i32 = 3;
const SCRIPT: &str = include_str!("run.py");

/// The software that runs the file.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Runtime {
    /// ONNX Runtime, for an ONNX file.
    OnnxRuntime,
    /// PyTorch with the package of `bindings/python/`, for a bundle.
    PyTorch,
    /// Open Image Denoise, for a TZA file.
    Oidn,
}

impl Runtime {
    /// Images, height and width of the batches for it.
    fn sizes(self) -> [[usize; 3]; 4] {
        match self {
            Runtime::OnnxRuntime | Runtime::PyTorch => SIZES,
            Runtime::Oidn => OIDN_SIZES,
        }
    }

    /// The script's name of the runtime, and the packages for `pip install`; `./bindings/python` is in this
    /// project's repository.
    fn name_and_packages(self) -> [&'static str; 2] {
        match self {
            Runtime::OnnxRuntime => ["onnx", "numpy onnxruntime"],
            Runtime::PyTorch => ["torch", "'./bindings/python[torch]'"],
            Runtime::Oidn => ["oidn", "numpy pyoidn"],
        }
    }
}

/// Deviation of a batch from this program's output.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Deviation {
    /// Images, height and width.
    pub size: [usize; 3],
    /// Largest difference relative to the batch's largest value.
    pub of_largest: f32,
    /// Largest difference relative to `sqrt(x^2 + 0.001)`, the weight in RelMSE (Eq. 5): about the
    /// value itself, and 0.03 for dark values.
    pub of_value: f32,
    /// Largest accepted `of_value`.
    limit_of_value: f32,
}

impl Deviation {
    fn of(size: [usize; 3], head: Head, found: &[f32], expected: &[f32]) -> Self {
        let largest = expected.iter().fold(0.0f32, |m, x| m.max(x.abs()));
        let worst = |relative: &dyn Fn(f32, f32) -> f32| {
            let differences = found.iter().zip(expected).map(|(f, e)| relative(*f, *e));
            // NaN never agrees; equal zeros agree.
            differences.fold(
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
            limit_of_value: match head {
                Head::Kernel => KERNEL_TOLERANCE,
                Head::Grey | Head::Xavier => TOLERANCE,
            },
        }
    }

    /// Whether both are within [`TOLERANCE`], or within [`KERNEL_TOLERANCE`] for the values of a
    /// kernel head.
    pub fn passes(&self) -> bool {
        self.of_largest <= TOLERANCE && self.of_value <= self.limit_of_value
    }
}

/// The result of a verification.
#[derive(Debug, Clone, PartialEq)]
pub struct Verification {
    /// Name and version of the runtime.
    pub runtime: String,
    /// One deviation per batch.
    pub deviations: Vec<Deviation>,
}

/// Why a file cannot be verified.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
#[allow(missing_docs, reason = "the messages explain the fields")]
pub enum VerifyError {
    /// The interpreter does not start.
    #[error("cannot run {python}; --python or DEMC_PYTHON names another interpreter")]
    Python {
        python: PathBuf,
        source: std::io::Error,
    },
    /// The interpreter lacks a package.
    #[error("{0} lacks a package (install with: {0} -m pip install {packages}): {detail}", python.display())]
    Packages {
        python: PathBuf,
        /// The packages for `pip install`.
        packages: &'static str,
        detail: String,
    },
    /// The runtime cannot run the file.
    #[error("{} in {}: {detail}", file.display(), python.display())]
    Run {
        python: PathBuf,
        file: PathBuf,
        detail: String,
    },
    /// A temporary file for the frames fails.
    #[error("cannot use a temporary file")]
    Temporary(#[from] std::io::Error),
    /// This program cannot denoise a frame.
    #[error(transparent)]
    Denoise(#[from] DenoiseError),
}

/// Runs `file` with the interpreter `python` and compares with `expected`. Equal statistics give
/// equal frames.
///
/// # Errors
/// A missing interpreter or package, or a file that the runtime cannot run. A deviation is no
/// error: see [`Deviation::passes`].
pub fn verify(
    file: &Path,
    runtime: Runtime,
    python: &Path,
    expected: &Bundle,
) -> Result<Verification, VerifyError> {
    let folder = tempfile::tempdir()?;
    let mut rng = ChaCha8Rng::seed_from_u64(SEED);
    let sizes = runtime.sizes();
    let mut outputs = Vec::with_capacity(sizes.len());
    for (i, size) in sizes.into_iter().enumerate() {
        let batch = match expected.meta.layout.inputs {
            InputKind::Demc => {
                let denoise = |frame: &Frame| match runtime {
                    Runtime::OnnxRuntime => expected.run_graph(frame),
                    Runtime::PyTorch | Runtime::Oidn => expected.denoise(frame),
                };
                let statistics = &expected.meta.normalizer.features;
                SyntheticBatch::of_frames(size, statistics, denoise, &mut rng)?
            }
            InputKind::Kpcn => SyntheticBatch::of_light(size, &expected.model, &mut rng),
        };
        for (kind, values) in [("color", &batch.color), ("features", &batch.features)] {
            let path = folder.path().join(format!("{i}.{kind}"));
            fs::write(path, f32_bytes(values))?;
        }
        outputs.push(batch.output);
    }
    let head = expected.meta.model.head;
    let guides = expected.meta.model.guides;
    let runtime = run(file, runtime, guides, python, folder.path())?;
    let mut deviations = Vec::with_capacity(sizes.len());
    for ((i, size), expected) in sizes.into_iter().enumerate().zip(outputs) {
        // A program that is no Python interpreter writes nothing.
        let bytes = fs::read(folder.path().join(format!("{i}.output"))).unwrap_or_default();
        let words = bytes.as_chunks().0.iter();
        let found: Vec<f32> = words.map(|word| f32::from_le_bytes(*word)).collect();
        if found.len() != expected.len() {
            return Err(VerifyError::Run {
                python: python.into(),
                file: file.into(),
                detail: format!("{} values instead of {}", found.len(), expected.len()),
            });
        }
        deviations.push(Deviation::of(size, head, &found, &expected));
    }
    Ok(Verification {
        runtime,
        deviations,
    })
}

/// Runs the file on the folder's inputs. Returns name and version of the runtime.
fn run(
    file: &Path,
    runtime: Runtime,
    guides: Guides,
    python: &Path,
    folder: &Path,
) -> Result<String, VerifyError> {
    let [kind, packages] = runtime.name_and_packages();
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
    let guides: &[&str] = match guides {
        Guides::None => &[],
        Guides::Albedo => &["albedo"],
        Guides::AlbedoNormal => &["albedo", "normal"],
    };
    let sizes = runtime.sizes();
    let request = format!("{{\"sizes\": {sizes:?}, \"guides\": {guides:?}}}");
    if let Some(mut stdin) = child.stdin.take() {
        // If Python has already ended, its exit code and output tell why.
        let _ = stdin.write_all(request.as_bytes());
    }
    let Output {
        status,
        stdout,
        stderr,
    } = child.wait_with_output().map_err(start)?;
    let last_line = |bytes: &[u8]| {
        let text = String::from_utf8_lossy(bytes);
        let line = text.lines().rev().find(|line| !line.trim().is_empty());
        line.unwrap_or("no output").trim().to_string()
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
    fn deviations_are_relative_to_the_largest_and_to_each_value() {
        let size = [1, 1, 1];
        let deviation = Deviation::of(size, Head::Grey, &[10.0, 0.01, 0.0], &[10.0, 0.0, 0.0]);
        assert!((deviation.of_largest - 1e-3).abs() < 1e-9);
        assert!((deviation.of_value - 0.01 / 0.001f32.sqrt()).abs() < 1e-6);
        assert!(!deviation.passes());
        assert!(Deviation::of(size, Head::Grey, &[0.0, 2.0], &[0.0, 2.0]).passes());
        for nan in [[f32::NAN, 2.0], [0.0, f32::NAN]] {
            assert!(!Deviation::of(size, Head::Grey, &nan, &[0.0, 2.0]).passes());
        }
        assert!(!Deviation::of(size, Head::Grey, &[1e-3], &[0.0]).passes());
        // 6e-4 of a dark value, 1e-5 of the largest.
        for (head, passes) in [
            (Head::Grey, false),
            (Head::Xavier, false),
            (Head::Kernel, true),
        ] {
            let deviation = Deviation::of(size, head, &[2.0, 2e-5], &[2.0, 0.0]);
            assert_eq!(deviation.passes(), passes);
        }
    }

    #[test]
    fn a_missing_interpreter_is_named() {
        let nowhere = Path::new("/nowhere/python3");
        let bundle = bundle(Variant::ColorOnly);
        let found = verify(Path::new("x"), Runtime::OnnxRuntime, nowhere, &bundle);
        let error = found.expect_err("no interpreter").to_string();
        assert!(error.starts_with("cannot run /nowhere/python3"), "{error}");
    }
}
