//! Runs exported ONNX graphs in an installed ONNX Runtime and compares the images with this
//! program's: every network, f32 and f16, at sizes that no file states.
//!
//! Needs a Python (`DEMC_PYTHON`, default `python3`) with `pip install numpy onnx onnxruntime`.
//! Without it, the test reports that it is skipped; with `DEMC_REQUIRE_ONNX=1` it fails.

use std::fs;
use std::path::Path;

use crate::live::{
    FEATURES, Python, random_bundle, random_kpcn, random_unets, read_floats, uniform, write_floats,
};
use crate::tensors::{Tolerance, assert_close};
use burn::tensor::Device;
use demc_data::Frame;
use demc_infer::verify::{Deviation, Runtime, verify};
use demc_infer::{Bundle, Precision};
use demc_model::{Reading, Variant, Weights};
use rand::SeedableRng;
use rand_chacha::ChaCha8Rng;
use tempfile::TempDir;

const SIZES: [[usize; 3]; 6] = [
    [1, 32, 32],
    [1, 32, 96],
    [1, 96, 160],
    [1, 224, 32],
    [2, 96, 64],
    [3, 32, 160],
];

/// Approximate radiance of an image's largest value.
const LARGEST: f32 = 2.0;

const PRECISIONS: [(Precision, &str); 2] = [(Precision::F32, "f32"), (Precision::F16, "f16")];

/// The guaranteed deviation relative to the largest value of the batch.
const OF_LARGEST: Tolerance = Tolerance {
    absolute: 0.0,
    of_largest: 1e-4,
    of_value: 0.0,
};

/// The deviation relative to each value, down to 0.03; below, RelMSE (Eq. 5, epsilon 0.001) is no
/// longer relative.
const OF_VALUE: Tolerance = Tolerance {
    absolute: 1e-4 * 0.031_622_8,
    of_largest: 0.0,
    of_value: 1e-4,
};

#[test]
fn onnx_runtime_computes_what_this_program_does() {
    let packages = "numpy, onnx, onnxruntime";
    let install = "numpy onnx onnxruntime";
    let Some(python) = Python::with(packages, install, "DEMC_REQUIRE_ONNX") else {
        return;
    };
    // New weights and inputs in each run; every failure names the seed.
    let seed: u64 = rand::random();
    let mut rng = ChaCha8Rng::seed_from_u64(seed);
    let temporary = TempDir::new().expect("a temporary directory");
    let folder = temporary.path();
    let bundles = exported(folder, &mut rng);
    let frames: Vec<Vec<Frame>> = SIZES
        .iter()
        .map(|size| frames(*size, &bundles[0].1, &mut rng))
        .collect();
    for (case, frames) in frames.iter().enumerate() {
        let [color, features] = ["color", "features"].map(|name| format!("{case}.{name}"));
        let colors = frames.iter().flat_map(|frame| &frame.color);
        write_floats(&folder.join(color), colors);
        let planes = frames.iter().flat_map(|frame| &frame.features);
        write_floats(&folder.join(features), planes);
    }
    fs::write(folder.join("sizes.json"), format!("{SIZES:?}")).expect("written");

    let script = Path::new(env!("CARGO_MANIFEST_DIR")).join("onnx/check.py");
    let run = python
        .run([script.as_path(), folder])
        .expect("it ran before");
    assert!(
        run.status.success(),
        "seed {seed}: {}",
        String::from_utf8_lossy(&run.stderr)
    );

    for (name, bundle) in &bundles {
        compare(folder, name, bundle, &frames, seed);
    }
    let file = folder.join("network.onnx");
    let kpcn = random_kpcn(&mut rng);
    for bundle in random_unets(&mut rng).into_iter().chain([kpcn]) {
        for (precision, _) in PRECISIONS {
            bundle.export_onnx(&file, precision).expect("exported");
            let expected = bundle.rounded(precision).expect("rounded");
            let found = verify(&file, Runtime::OnnxRuntime, python.path(), &expected);
            let found = found.expect("it runs");
            assert!(found.deviations.iter().all(Deviation::passes), "{found:?}");
        }
    }
}

/// Networks of all variants, readings, and precisions, and some with albedo filters. Each is written to
/// the folder as ONNX.
fn exported(folder: &Path, rng: &mut ChaCha8Rng) -> Vec<(String, Bundle)> {
    let mut bundles: Vec<(String, Bundle)> = Vec::new();
    for variant in Variant::with_encoders() {
        for reading in Reading::ALL {
            let random = random_bundle(variant, reading, -0.05..0.06, rng);
            let bundle = scaled(&random, rng);
            for (precision, suffix) in PRECISIONS {
                let [variant, reading] = [variant.spec().name, reading.spec().name];
                let name = format!("{variant}-{reading}-{suffix}");
                let path = folder.join(&name).with_extension("onnx");
                bundle.export_onnx(&path, precision).expect("exported");
                bundles.push((name, bundle.rounded(precision).expect("rounded")));
            }
        }
    }
    // Networks of earlier cases as albedo filters of each other.
    let count = bundles.len();
    for (i, filter) in [(0, count - 2), (1, count - 1), (count - 4, 0)] {
        let (name, mut bundle) = bundles[i].clone();
        let filter = bundles[filter].1.clone();
        bundle
            .set_albedo_filter(filter)
            .expect("the same positions");
        let name = format!("{name}-filter");
        let path = folder.join(&name).with_extension("onnx");
        bundle.export_onnx(&path, Precision::F32).expect("exported");
        bundles.push((name, bundle));
    }
    bundles
}

/// Compares the outputs of ONNX Runtime in the folder with those of the bundle.
fn compare(folder: &Path, name: &str, bundle: &Bundle, frames: &[Vec<Frame>], seed: u64) {
    let mut worst = [0.0f32; 2];
    let (mut lit, mut total) = (0, 0);
    for (case, frames) in frames.iter().enumerate() {
        let what = format!("{name}, {:?}, seed {seed}", SIZES[case]);
        let expected: Vec<f32> = frames
            .iter()
            .flat_map(|frame| bundle.denoise(frame).expect("denoised"))
            .collect();
        // Over all sizes: a small image may be dark although the image in `scaled` is not.
        lit += expected.iter().filter(|&&v| v > 1e-3).count();
        total += expected.len();
        let found = read_floats(&folder.join(format!("{name}.{case}.output")));
        for (worst, tolerance) in worst.iter_mut().zip([OF_LARGEST, OF_VALUE]) {
            let share = assert_close(&what, &found, &expected, tolerance);
            *worst = worst.max(1e-4 * share);
        }
    }
    assert!(
        lit > total / 2,
        "{name}, seed {seed}: only {lit} of {total} values are lit"
    );
    let [of_largest, of_value] = worst;
    println!("{name}: {of_largest:.1e} of the largest value, {of_value:.1e} of each");
}

/// The network with a positive output convolution, scaled to a largest value of [`LARGEST`]. The
/// output of a random network has any magnitude, and is black where the convolution is negative.
fn scaled(bundle: &Bundle, rng: &mut ChaCha8Rng) -> Bundle {
    let frame = &frames([1, 96, 96], bundle, rng)[0];
    let with_head = |change: &dyn Fn(f32) -> f32| {
        let mut weights = bundle.model.weights();
        let head = weights
            .iter_mut()
            .filter(|w| w.name.starts_with("decoder.head."));
        head.for_each(|weight| weight.data.iter_mut().for_each(|x| *x = change(*x)));
        let config = bundle.meta.model;
        let model = config.load(&mut Weights::new(weights), &Device::flex());
        Bundle {
            model: model.expect("its own weights"),
            ..bundle.clone()
        }
    };
    let image = with_head(&f32::abs).denoise(frame).expect("denoised");
    let largest = image.iter().fold(0.0f32, |m, x| m.max(*x));
    let factor = (LARGEST / largest).powf(1.0 / bundle.meta.normalizer.gamma);
    with_head(&|x| x.abs() * factor)
}

/// Noisy frames with black pixels, whose features spread around the bundle's statistics.
fn frames([batch, height, width]: [usize; 3], bundle: &Bundle, rng: &mut ChaCha8Rng) -> Vec<Frame> {
    let pixels = height * width;
    let statistics = &bundle.meta.normalizer.features;
    let mut frame = || {
        let color = uniform(-0.3, 1.6, 3 * pixels, rng).into_iter();
        let mut features = uniform(-1.7, 1.7, FEATURES * pixels, rng);
        for (channel, plane) in features.chunks_exact_mut(pixels).enumerate() {
            let (mean, std) = (statistics.mean[channel], statistics.std[channel]);
            plane.iter_mut().for_each(|x| *x = mean + std * *x);
        }
        // Values below 0 stay, because graph and program clamp them.
        Frame::new(
            "random",
            width,
            height,
            color.map(|x| x * x * x).collect(),
            features,
        )
    };
    (0..batch).map(|_| frame()).collect()
}
