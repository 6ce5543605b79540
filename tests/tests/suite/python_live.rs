//! Use of exported files in Python: `export --verify`, weights trained in PyTorch and imported
//! again, and the programs in `bindings/python/examples`.
//!
//! Needs a Python (`DEMC_PYTHON`, default `python3`) with `pip install onnxruntime './bindings/python[torch]'`. Without it, the tests report that they are skipped; with `DEMC_REQUIRE_ONNX=1` or
//! `DEMC_REQUIRE_TORCH=1` they fail.

use std::ops::Range;
use std::path::{Path, PathBuf};

use crate::live::{FEATURES, Python, random_bundle, read_floats, uniform, write_floats};
use crate::tensors::{Tolerance, assert_close};
use burn::tensor::Device;
use demc_data::image::exr::ExrFile;
use demc_data::image::plane::Plane;
use demc_data::{Frame, Normalizer, PositionSpace};
use demc_infer::verify::{Runtime, verify};
use demc_infer::{Bundle, BundleError, BundleFile, Names, Precision};
use demc_model::{Reading, Variant};
use rand::SeedableRng;
use rand_chacha::ChaCha8Rng;
use tempfile::TempDir;

/// Random change of the initial weights.
const MOVE_BY: Range<f32> = -0.05..0.06;
/// The guaranteed deviation relative to the largest value of the output.
const TOLERANCE: Tolerance = Tolerance {
    absolute: 0.0,
    of_largest: 1e-4,
    of_value: 0.0,
};

fn onnx() -> Option<Python> {
    let packages = "numpy, onnxruntime, OpenEXR, demc";
    Python::with(
        packages,
        "onnxruntime './bindings/python[torch]'",
        "DEMC_REQUIRE_ONNX",
    )
}

fn torch() -> Option<Python> {
    let packages = "torch, demc, OpenEXR";
    Python::with(packages, "'./bindings/python[torch]'", "DEMC_REQUIRE_TORCH")
}

fn repository() -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("..")
}

fn bundled_model() -> Bundle {
    Bundle::load("quality".as_ref(), &Device::flex()).expect("the model loads")
}

#[test]
fn verify_accepts_onnx_runtime_and_rejects_another_model() {
    let Some(python) = onnx() else { return };
    let folder = TempDir::new().expect("a temporary directory");
    let path = folder.path().join("x.onnx");
    let bundle = bundled_model();
    for precision in [Precision::F32, Precision::F16] {
        bundle.export_onnx(&path, precision).expect("exported");
        let expected = bundle.rounded(precision).expect("rounded");
        let found = verify(&path, Runtime::OnnxRuntime, python.path(), &expected).expect("run");
        assert!(
            found.runtime.starts_with("ONNX Runtime "),
            "{}",
            found.runtime
        );
        assert!(found.deviations.iter().all(|d| d.passes()), "{found:?}");
    }
    // An error of a hundredth of a standard deviation in one statistic is detected (red of the albedo).
    let mut other = bundle;
    other.meta.normalizer.features.mean[6] += 0.01 * other.meta.normalizer.features.std[6];
    let found = verify(&path, Runtime::OnnxRuntime, python.path(), &other).expect("run");
    assert!(!found.deviations.iter().any(|d| d.passes()), "{found:?}");
}

#[test]
fn verify_accepts_pytorch_with_either_style_of_names() {
    let Some(python) = torch() else { return };
    let folder = TempDir::new().expect("a temporary directory");
    let path = folder.path().join("x.safetensors");
    let mut rng = ChaCha8Rng::seed_from_u64(5);
    let mut bundle = random_bundle(Variant::Demc, Reading::Released, MOVE_BY, &mut rng);
    let filter = random_bundle(Variant::Semc, Reading::Released, MOVE_BY, &mut rng);
    let mut filtered = bundle.clone();
    filtered
        .set_albedo_filter(filter)
        .expect("the same positions");
    for names in [Names::Torch, Names::Burn] {
        filtered
            .export(&path, names, Precision::F32)
            .expect("exported");
        let found = verify(&path, Runtime::PyTorch, python.path(), &filtered).expect("run");
        assert!(found.deviations.iter().all(|d| d.passes()), "{found:?}");
        // Without its filter, the same network gives another image.
        let other = verify(&path, Runtime::PyTorch, python.path(), &bundle).expect("run");
        assert!(!other.deviations.iter().any(|d| d.passes()), "{other:?}");
        if names == Names::Burn {
            // Auto-exposure, demodulation and positions relative to the image.
            let statistics = bundled_model().meta;
            bundle.meta.ranges = statistics.ranges;
            bundle.meta.normalizer = Normalizer {
                position: PositionSpace::Image,
                restore_light: true,
                ..statistics.normalizer
            };
        }
        bundle
            .export(&path, names, Precision::F32)
            .expect("exported");
        let found = verify(&path, Runtime::PyTorch, python.path(), &bundle).expect("run");
        assert!(found.deviations.iter().all(|d| d.passes()), "{found:?}");
    }
}

#[test]
fn weights_trained_in_pytorch_are_imported() {
    let Some(python) = torch() else { return };
    const SIDE: usize = 64;
    let mut rng = ChaCha8Rng::seed_from_u64(6);
    for variant in [Variant::Demc, Variant::Semc] {
        let bundle = random_bundle(variant, Reading::Released, MOVE_BY, &mut rng);
        let statistics = &bundle.meta.normalizer.features;
        let features = uniform(-1.0, 1.0, FEATURES * SIDE * SIDE, &mut rng).into_iter();
        let raw = features.enumerate().map(|(i, z)| {
            let channel = i / (SIDE * SIDE);
            statistics.mean[channel] + statistics.std[channel] * z
        });
        let frame = Frame::new(
            "random",
            SIDE,
            SIDE,
            uniform(0.0, 1.0, 3 * SIDE * SIDE, &mut rng),
            raw.collect(),
        );
        let folder = TempDir::new().expect("a temporary directory");
        let file = |name: &str| folder.path().join(name);
        let [exported, color, features, weights, output] =
            ["exported", "color", "features", "weights", "output"].map(file);
        bundle
            .export(&exported, Names::Torch, Precision::F32)
            .expect("exported");
        write_floats(&color, &frame.color);
        write_floats(&features, &frame.features);
        let script = Path::new(env!("CARGO_MANIFEST_DIR")).join("torch/tune.py");
        let side = PathBuf::from(SIDE.to_string());
        python.succeed(&[
            &script, &exported, &color, &features, &side, &weights, &output,
        ]);

        let error = BundleFile::import(&weights, None).expect_err("save_file drops the header");
        assert!(matches!(error, BundleError::Foreign { .. }), "{error}");
        let like = BundleFile::read(&exported).expect("an export");
        let imported = BundleFile::import(&weights, Some(like)).expect("imported");
        let tuned = imported.into_bundle(&Device::flex()).expect("fits");
        assert_ne!(tuned.model.weights(), bundle.model.weights());
        let found = tuned.denoise(&frame).expect("denoised");
        let name = variant.spec().name;
        assert_close(name, &found, &read_floats(&output), TOLERANCE);
        let before = bundle.denoise(&frame).expect("denoised");
        let moved = found
            .iter()
            .zip(&before)
            .any(|(a, b)| (a - b).abs() > 0.01 * b);
        assert!(moved, "{variant:?}: the step changed nothing");
    }
}

/// Compares `script` of `bindings/python/examples` on the file `model` with this program, on a sample image.
fn example(python: &Python, script: &str, model: &Path, bundle: &Bundle) {
    let source = repository().join("data/sample/test/gen-table-test-1.exr");
    let target = model.with_file_name("out.exr");
    let script = repository().join("bindings/python/examples").join(script);
    python.succeed(&[&script, model, &source, &target]);
    let frame = demc_data::read_frame(&source, &bundle.meta.layout).expect("a frame");
    let expected = bundle.denoise(&frame).expect("denoised");
    let planes = ExrFile::open(&target)
        .expect("an EXR")
        .read(&["R", "G", "B"]);
    let found: Vec<f32> = planes
        .expect("RGB")
        .iter()
        .flat_map(Plane::to_f32)
        .collect();
    assert_close(&script.display().to_string(), &found, &expected, TOLERANCE);
}

/// The bundled model with itself as albedo filter.
fn filtered_model() -> Bundle {
    let mut bundle = bundled_model();
    let filter = bundled_model();
    bundle
        .set_albedo_filter(filter)
        .expect("the same positions");
    bundle
}

#[test]
fn the_examples_apply_an_albedo_filter() {
    let folder = TempDir::new().expect("a temporary directory");
    let bundle = filtered_model();
    if let Some(python) = onnx() {
        let model = folder.path().join("demc.onnx");
        bundle
            .export_onnx(&model, Precision::F32)
            .expect("exported");
        example(&python, "onnx_denoise.py", &model, &bundle);
    }
    if let Some(python) = torch() {
        let model = folder.path().join("demc.safetensors");
        let exported = bundle.export(&model, Names::Torch, Precision::F32);
        exported.expect("exported");
        example(&python, "torch_denoise.py", &model, &bundle);
    }
}

#[test]
fn the_onnx_example_denoises_the_sample() {
    let Some(python) = onnx() else { return };
    let folder = TempDir::new().expect("a temporary directory");
    let model = folder.path().join("demc.onnx");
    let bundle = bundled_model();
    bundle
        .export_onnx(&model, Precision::F16)
        .expect("exported");
    let rounded = bundle.rounded(Precision::F16).expect("rounded");
    example(&python, "onnx_denoise.py", &model, &rounded);
}

#[test]
fn the_torch_example_denoises_the_sample() {
    let Some(python) = torch() else { return };
    let folder = TempDir::new().expect("a temporary directory");
    let model = folder.path().join("demc.safetensors");
    let bundle = bundled_model();
    bundle
        .export(&model, Names::Torch, Precision::F32)
        .expect("exported");
    example(&python, "torch_denoise.py", &model, &bundle);
}
