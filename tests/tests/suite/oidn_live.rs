//! Weights of an installed Open Image Denoise: imported, denoised with, exported, and run by it. Skipped
//! without `pyoidn`; `DEMC_REQUIRE_OIDN=1` makes that a failure.

use std::fs::{self, File};
use std::path::{Path, PathBuf};
use std::process::Command;

use burn::tensor::Device;
use demc_data::image::exr::ExrFile;
use demc_data::{ChannelLayout, Frame};
use demc_infer::Bundle;
use demc_infer::tza::weight_sets;
use demc_infer::verify::{Runtime, verify};

use crate::live::Python;

const LIBRARY: &str = "import pathlib, pyoidn
folder = pathlib.Path(pyoidn.__file__).parent / 'oidn' / 'lib'
print(next(path for path in folder.iterdir() if 'OpenImageDenoise_core' in path.name))";

/// The library with the weights in the installed package.
fn library(python: &Python) -> PathBuf {
    let run = python.run(["-c", LIBRARY]).expect("it ran before");
    PathBuf::from(String::from_utf8(run.stdout).expect("a path").trim())
}

#[test]
fn imported_weights_denoise_as_open_image_denoise_does() {
    let Some(python) = Python::with("numpy, pyoidn", "numpy pyoidn", "DEMC_REQUIRE_OIDN") else {
        return;
    };
    let library = library(&python);
    let device = Device::flex();
    let sets = weight_sets(&library).expect("a library of Open Image Denoise");
    let names: Vec<String> = sets
        .iter()
        .filter(|set| set.is_hdr())
        .map(|set| set.name.clone().expect("the library has names"))
        .collect();
    assert!(
        names.iter().any(|name| name == "rt_hdr_alb_nrm"),
        "{names:?}"
    );
    let folder = tempfile::TempDir::new().expect("a temporary directory");
    for name in names {
        let bundle = Bundle::import_oidn(&library, Some(&name), &device).expect("imported");
        let path = folder.path().join(format!("{name}.tza"));
        bundle.export_tza(&path).expect("exported");
        let found = verify(&path, Runtime::Oidn, python.path(), &bundle).expect("it runs");
        for deviation in &found.deviations {
            println!("{name}: {deviation:?}");
            assert!(deviation.passes(), "{name}: {deviation:?}");
        }
    }
}

/// The programs of docs/oidn.md give the image of `demc-infer`.
#[test]
fn the_examples_denoise_as_the_model_does() {
    let required = "DEMC_REQUIRE_OIDN";
    let install = "numpy pyoidn OpenEXR";
    let Some(python) = Python::with("numpy, pyoidn, OpenEXR", install, required) else {
        return;
    };
    let root = Path::new(env!("CARGO_MANIFEST_DIR")).join("..");
    let folder = tempfile::TempDir::new().expect("a temporary directory");
    let [weights, target, program] =
        ["weights.tza", "target.exr", "with_weights"].map(|name| folder.path().join(name));
    let library = library(&python);
    let device = Device::flex();
    let bundle = Bundle::import_oidn(&library, None, &device).expect("imported");
    bundle.export_tza(&weights).expect("exported");
    let rounded = Bundle::import_oidn(&weights, None, &device).expect("its own");

    let source = root.join("data/sample/test/col-classroom-1.exr");
    let layout = ChannelLayout::resolve("demc-exr").expect("a preset");
    let frame = demc_data::image::frame::read_input(&source, &layout).expect("it is committed");
    let expected = rounded.denoise(&frame).expect("denoised");

    let script = root.join("tests/oidn/with_weights.py");
    python.succeed(&[&script, &weights, &source, &target]);
    let mut file = ExrFile::open(&target).expect("an image");
    let planes = file.read(&["R", "G", "B"]).expect("colour");
    let mut found = vec![0.0; expected.len()];
    for (plane, out) in planes
        .iter()
        .zip(found.chunks_exact_mut(expected.len() / 3))
    {
        plane.copy_to(0, out);
    }
    assert_close(&found, &expected);

    let compiled = Command::new("cc")
        .arg(root.join("tests/oidn/with_weights.c"))
        .arg("-I")
        .arg(root.join("tests/oidn/include"))
        .arg("-o")
        .arg(&program)
        .arg(library.with_file_name("libOpenImageDenoise.so.2"))
        .arg("-Wall")
        .arg("-Werror")
        .status();
    assert!(compiled.expect("a C compiler").success());
    let images = folder.path().join("images.raw");
    fs::write(&images, interleaved(&frame)).expect("writable");
    let run = Command::new(&program)
        .arg(&weights)
        .args([frame.width, frame.height].map(|side| side.to_string()))
        .env("LD_LIBRARY_PATH", library.parent().expect("a folder"))
        .stdin(File::open(&images).expect("written"))
        .output()
        .expect("it runs");
    assert!(run.status.success(), "{run:?}");
    let values: Vec<f32> = run
        .stdout
        .chunks_exact(4)
        .map(|bytes| f32::from_le_bytes(bytes.try_into().expect("4 bytes")))
        .collect();
    let pixels = frame.width * frame.height;
    let found: Vec<f32> = (0..3 * pixels)
        .map(|i| values[i % pixels * 3 + i / pixels])
        .collect();
    assert_close(&found, &expected);
}

/// Colour, albedo, and normal, pixel by pixel.
fn interleaved(frame: &Frame) -> Vec<u8> {
    let pixels = frame.width * frame.height;
    let images = [
        &frame.color[..],
        &frame.features[6 * pixels..9 * pixels],
        &frame.features[..3 * pixels],
    ];
    let values = images
        .into_iter()
        .flat_map(|image| (0..3 * pixels).map(move |i| image[i % 3 * pixels + i / 3]));
    values.flat_map(f32::to_le_bytes).collect()
}

fn assert_close(found: &[f32], expected: &[f32]) {
    assert_eq!(found.len(), expected.len());
    let differences = found
        .iter()
        .zip(expected)
        .map(|(a, b)| f64::from((a - b).abs() / (b.abs() + 1e-3)));
    let mean = differences.sum::<f64>() / found.len() as f64;
    println!("mean relative difference {mean:.2e}");
    assert!(mean < 1e-4, "{mean}");
}
