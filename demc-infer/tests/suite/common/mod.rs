//! Shared by the command line tests: a tiny random model, the sample data, and the binary.

use std::ffi::{OsStr, OsString};
use std::path::{Path, PathBuf};
use std::process::{Command, Output};

use burn::tensor::Device;
use demc_data::{ChannelLayout, FeatureStats, Normalizer, PositionSpace};
use demc_infer::{Bundle, BundleMeta, Names, Precision};
use demc_model::{Head, ModelConfig, Reading, Variant};
use rand_chacha::ChaCha8Rng;
use rand_chacha::rand_core::SeedableRng;
use tempfile::TempDir;

/// A run directory: `best.safetensors` with a random network of base width 2.
pub fn run_directory() -> TempDir {
    let directory = tempfile::tempdir().expect("directory");
    let path = directory.path().join("best.safetensors");
    random_bundle()
        .save(&path, Names::Burn, Precision::F32)
        .expect("saved");
    directory
}

/// As [`run_directory`], with a kernel head and albedo demodulation.
pub fn kernel_run_directory() -> TempDir {
    let directory = tempfile::tempdir().expect("directory");
    let path = directory.path().join("best.safetensors");
    bundle_with(Head::Kernel, Some(0.07))
        .save(&path, Names::Burn, Precision::F32)
        .expect("saved");
    directory
}

/// A random network in the released reading, with batch normalisation in the decoder.
pub fn random_bundle() -> Bundle {
    bundle_with(Head::default(), None)
}

fn bundle_with(head: Head, albedo_demodulation_epsilon: Option<f32>) -> Bundle {
    let model = ModelConfig {
        variant: Variant::Demc,
        reading: Reading::Released,
        width: 2,
        head,
        ..ModelConfig::default()
    };
    let normalizer = Normalizer {
        gamma: 2.2,
        albedo_demodulation_epsilon,
        position: PositionSpace::Scene,
        transfer: demc_data::Transfer::Gamma,
        exposure_level: None,
        restore_light: false,
        features: FeatureStats {
            mean: [0.2; 12],
            std: [0.7; 12],
        },
        flat_color: [0.4, 0.3, 0.2],
    };
    let layout = ChannelLayout::resolve("demc-exr").expect("a preset");
    let mut rng = ChaCha8Rng::seed_from_u64(3);
    let network = model.init(&mut rng, normalizer.flat_color, &Device::flex());
    Bundle::new(BundleMeta::new(model, normalizer, layout, 500), network)
}

/// The repository's sample data set.
pub fn sample() -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("../data/sample")
}

/// A test image of the sample.
pub fn sample_image(name: &str) -> PathBuf {
    sample().join("test").join(name)
}

/// The outcome of a run of `demc-infer`.
pub struct Outcome {
    pub code: i32,
    pub stdout: String,
    pub stderr: String,
}

/// Runs `demc-infer` with these arguments.
pub fn demc_infer<A: AsRef<OsStr>>(arguments: impl IntoIterator<Item = A>) -> Outcome {
    let Output {
        status,
        stdout,
        stderr,
    } = Command::new(env!("CARGO_BIN_EXE_demc-infer"))
        .args(arguments)
        .output()
        .expect("started");
    Outcome {
        code: status.code().expect("not killed"),
        stdout: String::from_utf8(stdout).expect("UTF-8"),
        stderr: String::from_utf8(stderr).expect("UTF-8"),
    }
}

/// A list of arguments of different types.
#[macro_export]
macro_rules! arguments {
    ($($argument:expr),* $(,)?) => {
        [$(std::ffi::OsString::from(&$argument)),*]
    };
}

/// Runs `demc-infer export` for a model and a file.
pub fn export(model: &Path, file: &Path, flags: &[&str]) -> Outcome {
    let list = arguments!["export", "--model", model, "-o", file];
    demc_infer(list.into_iter().chain(flags.iter().map(OsString::from)))
}

impl Outcome {
    /// Fails the test unless stdout or stderr contains `words`.
    pub fn says(&self, words: &str) {
        let all = [&*self.stdout, &self.stderr].concat();
        assert!(all.contains(words), "{words}: {all}");
    }

    /// Fails the test unless the exit code is 0.
    pub fn success(self) -> Self {
        assert_eq!(self.code, 0, "{}", self.stderr);
        self
    }

    /// Fails the test unless the exit code is `code` and stderr is one line that starts with
    /// `error: ` and `start`.
    pub fn failure(self, code: i32, start: &str) -> Self {
        assert_eq!(self.code, code, "{}", self.stderr);
        assert_eq!(self.stderr.lines().count(), 1, "{}", self.stderr);
        let expected = format!("error: {start}");
        assert!(
            self.stderr.starts_with(&expected),
            "{:?} is not the start of {:?}",
            expected,
            self.stderr
        );
        self
    }
}
