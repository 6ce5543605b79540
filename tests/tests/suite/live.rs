//! Shared by the tests that need Python: the interpreter, and networks with random weights.

use std::ffi::OsStr;
use std::fs;
use std::io::Write;
use std::ops::Range;
use std::path::Path;
use std::process::{Command, Output};

use burn::tensor::Device;
use demc_data::{ChannelLayout, FeatureStats, Normalizer, PositionSpace, Transfer};
use demc_infer::{Bundle, BundleMeta};
use demc_model::config::LEVEL_WIDTHS;
use demc_model::unet::UnetSize;
use demc_model::{Head, ModelConfig, Reading, Variant, Weight, Weights};
use rand::RngExt;
use rand_chacha::ChaCha8Rng;

/// Feature channels.
pub const FEATURES: usize = 12;
/// Base width of random networks.
const WIDTH: usize = 4;

/// A Python interpreter.
pub struct Python(String);

impl Python {
    /// The interpreter named by `DEMC_PYTHON`, else `python3`, if it can import `packages`.
    /// Otherwise reports that the test is skipped, or fails it if the variable `required` is 1.
    pub fn with(packages: &str, install: &str, required: &str) -> Option<Self> {
        let python = Python(std::env::var("DEMC_PYTHON").unwrap_or_else(|_| "python3".into()));
        let Err(reason) = python.check(packages, install) else {
            return Some(python);
        };
        assert!(
            std::env::var(required).as_deref() != Ok("1"),
            "{required}=1, but {reason}"
        );
        // Not `println!`, because the test harness captures it.
        writeln!(std::io::stderr(), "skipped: {reason}").expect("stderr can be written");
        None
    }

    /// Checks for the packages; the error states the reason.
    fn check(&self, packages: &str, install: &str) -> Result<(), String> {
        let Python(program) = self;
        let output = self
            .run(["-c", &format!("import {packages}")])
            .map_err(|e| format!("{program} does not run: {e}"))?;
        let stderr = String::from_utf8_lossy(&output.stderr);
        let last = stderr.lines().last().unwrap_or_default();
        if output.status.success() {
            Ok(())
        } else {
            Err(format!(
                "{program} cannot import {packages} (pip install {install}): {last}"
            ))
        }
    }

    /// Path of the interpreter.
    pub fn path(&self) -> &Path {
        Path::new(&self.0)
    }

    /// Runs it and asserts success.
    pub fn succeed(&self, arguments: &[&Path]) {
        let Output { status, stderr, .. } = self.run(arguments).expect("it ran before");
        let stderr = String::from_utf8_lossy(&stderr);
        assert!(status.success(), "{arguments:?}: {stderr}");
    }

    /// Runs it.
    pub fn run<A: AsRef<OsStr>>(
        &self,
        arguments: impl IntoIterator<Item = A>,
    ) -> std::io::Result<Output> {
        // In a directory without a package `demc`, so that Python finds the installed one.
        Command::new(&self.0)
            .args(arguments)
            .current_dir(env!("CARGO_MANIFEST_DIR"))
            .output()
    }
}

/// A network whose initial weights are changed at random by `move_by`, so that no bias is zero and
/// no running statistic is trivial. Mostly positive changes keep ReLUs open; larger changes give
/// larger outputs.
pub fn random_bundle(
    variant: Variant,
    reading: Reading,
    move_by: Range<f32>,
    rng: &mut ChaCha8Rng,
) -> Bundle {
    let config = ModelConfig {
        variant,
        reading,
        width: WIDTH,
        // The paper's levels or others.
        levels: if rng.random() {
            LEVEL_WIDTHS
        } else {
            [2, 1, 3, 2, 4]
        },
        // Each head with and without a fusion, in both readings.
        head: match (variant, reading) {
            (Variant::Semc | Variant::ColorOnly, Reading::Released) => Head::Kernel,
            (Variant::DemcNosn, Reading::Paper) => Head::Kernel,
            _ => Head::Grey,
        },
        ..ModelConfig::default()
    };
    let device = Device::flex();
    let mut weights = config.init(rng, [0.5, 0.4, 0.3], &device).weights();
    let move_by = match config.head {
        Head::Grey | Head::Xavier => move_by,
        // Positive changes make maps of 1e6. A softmax of such logits selects one pixel, and rounding
        // decides which. The output is never black, so no ReLU must be kept open.
        Head::Kernel => {
            let half = (move_by.end - move_by.start) / 2.0;
            -half..half
        }
    };
    for Weight { name, data, .. } in &mut weights {
        data.iter_mut()
            .for_each(|value| *value += rng.random_range(move_by.clone()));
        // Negative weights of the head can give a black image, which tests nothing.
        if name.starts_with("decoder.head.") {
            data.iter_mut().for_each(|value| *value = value.abs());
        }
    }
    let normalizer = Normalizer {
        gamma: 2.2,
        // One reading with demodulation, one without.
        albedo_demodulation_epsilon: match reading {
            Reading::Paper => None,
            Reading::Released => Some(1.0),
        },
        position: PositionSpace::Scene,
        transfer: Transfer::Gamma,
        exposure_level: None,
        restore_light: false,
        features: FeatureStats {
            mean: std::array::from_fn(|channel| 0.3 * channel as f32 - 1.0),
            std: std::array::from_fn(|channel| 0.4 + 0.5 * channel as f32),
        },
        flat_color: [0.5, 0.4, 0.3],
    };
    let layout = ChannelLayout::resolve("demc-exr").expect("a preset");
    let model = config
        .load(&mut Weights::new(weights), &device)
        .expect("its own weights");
    Bundle::new(BundleMeta::new(config, normalizer, layout, 0), model)
}

/// The networks of KPCN with random weights.
pub fn random_kpcn(rng: &mut ChaCha8Rng) -> Bundle {
    let random = random_bundle(Variant::DemcNosn, Reading::Released, 0.0..0.1, rng);
    let model = ModelConfig {
        variant: Variant::Kpcn,
        width: WIDTH,
        ..ModelConfig::default()
    };
    let network = model.init(rng, [0.0; 3], &Device::flex());
    let BundleMeta {
        normalizer, layout, ..
    } = random.meta;
    Bundle::new(BundleMeta::new(model, normalizer, layout, 0), network)
}

/// The U-Net of Open Image Denoise, and those that grow from it, with random weights.
pub fn random_unets(rng: &mut ChaCha8Rng) -> [Bundle; 3] {
    let all = [Variant::Unet, Variant::UnetNosn, Variant::UnetDemc];
    all.map(|variant| random_unet(variant, rng))
}

fn random_unet(variant: Variant, rng: &mut ChaCha8Rng) -> Bundle {
    let random = random_bundle(Variant::DemcNosn, Reading::Released, 0.0..0.1, rng);
    let mut model = ModelConfig {
        variant,
        size: UnetSize::Small,
        ..ModelConfig::default()
    };
    if variant != Variant::Unet {
        model.width = WIDTH;
    }
    let network = model.init(rng, [0.0; 3], &Device::flex());
    let mut weights = network.weights();
    for Weight { name, data, .. } in &mut weights {
        // Fusions are not where they start.
        if name.starts_with("side.") {
            data.iter_mut()
                .for_each(|value| *value += rng.random_range(-0.1..0.1));
        }
        // The image is not black, and its radiance not beyond floats.
        if name.starts_with("head.") {
            data.iter_mut()
                .for_each(|value| *value = 0.1 * value.abs() + 1e-3);
        }
    }
    let network = model.load(&mut Weights::new(weights), &Device::flex());
    let BundleMeta {
        normalizer, layout, ..
    } = random.meta;
    let normalizer = Normalizer {
        transfer: Transfer::Pu,
        albedo_demodulation_epsilon: None,
        exposure_level: Some(0.18),
        features: normalizer.features.clone().with_ranges_of(Transfer::Pu),
        ..normalizer
    };
    let network = network.expect("its own weights");
    Bundle::new(BundleMeta::new(model, normalizer, layout, 0), network)
}

/// Random values.
pub fn uniform(low: f32, high: f32, count: usize, rng: &mut ChaCha8Rng) -> Vec<f32> {
    (0..count).map(|_| rng.random_range(low..high)).collect()
}

/// Writes raw float32 values.
pub fn write_floats<'a>(path: &Path, values: impl IntoIterator<Item = &'a f32>) {
    let bytes: Vec<u8> = values.into_iter().flat_map(|v| v.to_le_bytes()).collect();
    fs::write(path, bytes).expect("a writable temporary directory");
}

/// Reads raw float32 values.
pub fn read_floats(path: &Path) -> Vec<f32> {
    let bytes = fs::read(path).unwrap_or_else(|e| panic!("{}: {e}", path.display()));
    let words = bytes.as_chunks().0.iter();
    words.map(|word| f32::from_le_bytes(*word)).collect()
}
