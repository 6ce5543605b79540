//! Parity with an installed PyTorch: random weights are exported, loaded by `bindings/python/` with
//! `strict=True`, and run.
//!
//! Needs a Python with the package of `bindings/python/` (`pip install './bindings/python[torch]'`), named by `DEMC_PYTHON`
//! (default `python3`). Without it, the test reports that it is skipped; with
//! `DEMC_REQUIRE_TORCH=1` it fails.

use std::collections::HashMap;
use std::path::{Path, PathBuf};

use crate::fixture::{gradients_by_name, is_bias_before_norm};
use crate::live::{FEATURES, Python, random_bundle, random_kpcn, random_unets, uniform};
use crate::tensors::{Tolerance, assert_close, read};
use burn::optim::GradientsParams;
use burn::tensor::{Device, Tensor, TensorData};
use demc_infer::verify::{Deviation, Runtime, verify};
use demc_infer::{Bundle, Names, Precision};
use demc_model::{Reading, Variant};
use rand::SeedableRng;
use rand_chacha::ChaCha8Rng;
use safetensors::tensor::{Dtype, TensorView};
use tempfile::TempDir;

/// Two images that are not square; files do not state the size.
const SHAPE: [usize; 4] = [2, 3, 64, 96];

/// The guaranteed deviation relative to the largest value of the output; measured: 1e-6.
const OUTPUT: Tolerance = Tolerance {
    absolute: 0.0,
    of_largest: 1e-4,
    of_value: 0.0,
};

/// A Python with PyTorch and the package of `bindings/python/`.
fn pytorch() -> Option<Python> {
    let install = "'./bindings/python[torch]'";
    Python::with("torch, safetensors, demc", install, "DEMC_REQUIRE_TORCH")
}

#[test]
fn pytorch_loads_every_export_strictly_and_agrees() {
    let Some(python) = pytorch() else {
        return;
    };
    for variant in Variant::with_encoders() {
        for reading in Reading::ALL {
            agrees(&python, variant, reading, Names::Torch, Precision::F32);
        }
    }
    let mut rng = ChaCha8Rng::seed_from_u64(rand::random());
    let kpcn = random_kpcn(&mut rng);
    for bundle in random_unets(&mut rng).into_iter().chain([kpcn]) {
        let file = tempfile::NamedTempFile::new().expect("a file");
        let saved = bundle.save(file.path(), Names::Torch, Precision::F32);
        saved.expect("the bundle is written");
        let found = verify(file.path(), Runtime::PyTorch, python.path(), &bundle).expect("it runs");
        assert!(found.deviations.iter().all(Deviation::passes), "{found:?}");
    }
    agrees(
        &python,
        Variant::Demc,
        Reading::Released,
        Names::Burn,
        Precision::F32,
    );
    agrees(
        &python,
        Variant::Demc,
        Reading::Released,
        Names::Torch,
        Precision::F16,
    );
}

/// Share of a tensor's largest gradient, in float32 on both sides. Measured: 2e-5.
const GRADIENT: Tolerance = Tolerance {
    absolute: 1e-9,
    of_largest: 1e-3,
    of_value: 0.0,
};

/// The networks that grow from a U-Net have no fixture, whose weights would be large.
#[test]
fn pytorch_has_the_gradients_of_every_unet() {
    let Some(python) = pytorch() else {
        return;
    };
    let script = Path::new(env!("CARGO_MANIFEST_DIR")).join("torch/gradients.py");
    let device = Device::flex().autodiff();
    let mut rng = ChaCha8Rng::seed_from_u64(11);
    for bundle in random_unets(&mut rng) {
        let folder = TempDir::new().expect("a temporary directory");
        let [file, input, output] = ["bundle", "input", "output"]
            .map(|name| folder.path().join(name).with_extension("safetensors"));
        bundle
            .save(&file, Names::Torch, Precision::F32)
            .expect("saved");
        let [batch, colors, height, width] = SHAPE;
        let color = uniform(0.0, 0.5, batch * colors * height * width, &mut rng);
        let features = uniform(-1.0, 1.0, batch * FEATURES * height * width, &mut rng);
        write_input(&input, &color, &features);
        python.succeed(&[&script, &file, &input, &output]);
        let theirs = read(&output);

        let tensor = |values, channels| {
            let data = TensorData::new(values, [batch, channels, height, width]);
            Tensor::<4>::from_data(data, &device)
        };
        let model = Bundle::load(&file, &device).expect("its own").model;
        let out = model.forward(tensor(color, colors), tensor(features, FEATURES));
        let loss = (out.clone() * out).mean();
        let gradients = GradientsParams::from_grads(loss.backward(), &model);
        let found = gradients_by_name(&model, &gradients);
        assert_eq!(found.len(), theirs.len(), "{}", model.config());
        for (name, found) in &found {
            let theirs = &theirs[&name.replace("gamma", "weight").replace("beta", "bias")];
            if !is_bias_before_norm(name.trim_start_matches("side."), Reading::Paper) {
                let what = format!("{}: {name}", model.config());
                assert_close(&what, found, &theirs.data, GRADIENT);
            }
        }
    }
}

fn agrees(python: &Python, variant: Variant, reading: Reading, names: Names, precision: Precision) {
    // New weights and inputs in each run; every failure names the seed.
    let seed: u64 = rand::random();
    let what = format!(
        "{}, {} reading, {names:?} names, {precision:?}, seed {seed}",
        variant.spec().name,
        reading.spec().name
    );
    let folder = TempDir::new().expect("a temporary directory");
    let [bundle, input, output] = ["bundle", "input", "output"]
        .map(|name| folder.path().join(name).with_extension("safetensors"));
    let mut rng = ChaCha8Rng::seed_from_u64(seed);
    random_bundle(variant, reading, -0.05..0.1, &mut rng)
        .save(&bundle, names, precision)
        .expect("the bundle is written");
    let [_, colors, height, width] = SHAPE;
    let color_gamma = uniform(0.0, 1.5, SHAPE[0] * colors * height * width, &mut rng);
    let features_z = uniform(-1.7, 1.7, SHAPE[0] * FEATURES * height * width, &mut rng);
    write_input(&input, &color_gamma, &features_z);

    let text = |path: &PathBuf| path.to_str().expect("a path in UTF-8").to_string();
    let run = python
        .run([
            "-m",
            "demc.torch",
            &text(&bundle),
            &text(&input),
            &text(&output),
        ])
        .expect("it ran before");
    assert!(
        run.status.success(),
        "{what}: {}",
        String::from_utf8_lossy(&run.stderr)
    );

    // The file is already rounded to f16, for both sides.
    let device = Device::flex();
    let model = Bundle::load(&bundle, &device)
        .expect("the bundle loads")
        .model;
    let tensor = |values, channels| {
        Tensor::<4>::from_data(
            TensorData::new(values, [SHAPE[0], channels, height, width]),
            &device,
        )
    };
    let ours: Vec<f32> = model
        .forward(tensor(color_gamma, colors), tensor(features_z, FEATURES))
        .into_data()
        .try_to_vec()
        .expect("float32");
    let theirs = &read(&output)["output"];
    assert_eq!(theirs.shape, SHAPE, "{what}");
    let lit = theirs.data.iter().filter(|&&v| v > 0.1).count();
    assert!(
        lit > theirs.data.len() / 2,
        "{what}: an output of nearly only zeros tests nothing"
    );
    let share = assert_close(&what, &ours, &theirs.data, OUTPUT);
    println!(
        "{what}: {:.1e} of the largest value",
        share * OUTPUT.of_largest
    );
}

fn write_input(path: &Path, color_gamma: &[f32], features_z: &[f32]) {
    let bytes = |values: &[f32]| {
        values
            .iter()
            .flat_map(|v| v.to_le_bytes())
            .collect::<Vec<u8>>()
    };
    let (color, features) = (bytes(color_gamma), bytes(features_z));
    let shape = |channels| vec![SHAPE[0], channels, SHAPE[2], SHAPE[3]];
    let view = |channels, bytes| {
        TensorView::new(Dtype::F32, shape(channels), bytes).expect("a shape that fits")
    };
    let views = HashMap::from([
        ("color_gamma", view(SHAPE[1], &color)),
        ("features_z", view(FEATURES, &features)),
    ]);
    safetensors::serialize_to_file(views, None, path).expect("a writable temporary directory");
}
