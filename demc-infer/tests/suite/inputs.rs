//! Inputs of `demc-infer`: which are accepted, which are refused, and in which words.

use std::ffi::OsString;
use std::fs;
use std::path::{Path, PathBuf};

use burn::tensor::Device;
use demc_data::image::exr::ExrFile;
use demc_data::image::plane::Plane;
use demc_data::image::rewrite::{Replaced, WriteOptions, rewrite_with_layers};
use demc_data::{ChannelLayout, SamplePrecision, read_frame};
use demc_infer::{Bundle, BundleMeta, Names, Precision};
use demc_model::metrics::rel_mse_image;
use demc_model::{ModelConfig, Variant};
use rand_chacha::ChaCha8Rng;
use rand_chacha::rand_core::SeedableRng;
use tempfile::TempDir;

use crate::arguments;
use crate::common::{Outcome, demc_infer, random_bundle, run_directory, sample, sample_image};

fn layout() -> ChannelLayout {
    ChannelLayout::resolve("demc-exr").expect("a preset")
}

/// A copy of a sample scene in float, with other values of a channel of colour or features.
fn changed(
    dir: &TempDir,
    name: &str,
    channel: &str,
    change: impl Fn(usize, f32) -> f32,
) -> PathBuf {
    let output = dir.path().join(name);
    let mut file = ExrFile::open(&sample_image("gen-table-test-1.exr")).expect("the sample");
    let layout = layout();
    let mut planes = Vec::new();
    let mut layers = Vec::new();
    let others = Some(channel.to_owned()).filter(|name| !layout.color.contains(name));
    for name in layout.color.iter().chain(&others) {
        let plane = &file.read(&[name]).expect("a channel")[0];
        let values = plane.to_f32().into_iter().enumerate();
        let changed = values.map(|(i, x)| if name == channel { change(i, x) } else { x });
        planes.extend(changed.collect::<Vec<f32>>());
    }
    layers.extend(others);
    let replaced = Replaced {
        layout: &layout,
        layers: &layers,
        added: &[],
        planes: &planes,
    };
    let options = WriteOptions {
        precision: Some(SamplePrecision::Float),
        ..WriteOptions::default()
    };
    rewrite_with_layers(&mut file, &replaced, &output, &options).expect("written");
    output
}

/// Denoises with the bundled model `fast`.
fn fast(inputs: &[&Path], output: &Path, flags: &[&str]) -> Outcome {
    let mut list = arguments!["denoise", "--model", "fast", "-o", output].to_vec();
    list.extend(inputs.iter().map(OsString::from));
    list.extend(flags.iter().map(OsString::from));
    demc_infer(list)
}

fn color_of(path: &Path) -> Vec<f32> {
    let mut file = ExrFile::open(path).expect("an image");
    let planes = file.read(&["R", "G", "B"]).expect("colour");
    planes.iter().flat_map(Plane::to_f32).collect()
}

/// A renderer writes any albedo where a lamp is seen in metal. It counts as 1, in the checks, too.
#[test]
fn a_lamp_in_metal_is_no_reason_to_refuse_an_image() {
    let dir = tempfile::tempdir().expect("a directory");
    for largest in [10.0, 5000.0, 65504.0] {
        let lamp = changed(&dir, "lamp.exr", "albedo1.R", |i, x| {
            if i == 9000 { largest } else { x }
        });
        let denoised = fast(&[&lamp], &dir.path().join("out.exr"), &["--overwrite"]).success();
        assert!(!denoised.stderr.contains("warning"), "{}", denoised.stderr);
        let checked = demc_infer(arguments!["check", lamp]).success();
        let note = format!("note: albedo: 1 samples are above 1, up to {largest:.1}");
        assert!(checked.stdout.contains(&note), "{}", checked.stdout);
    }
}

#[test]
fn a_stock_file_of_blender_has_no_warning_about_albedo() {
    let file =
        Path::new(env!("CARGO_MANIFEST_DIR")).join("../tests/renderers/files/cycles-4.5.exr");
    let checked = demc_infer(arguments!["check", file]);
    assert!(
        !checked.stdout.contains("warning: albedo"),
        "{}",
        checked.stdout
    );
}

#[test]
fn a_crop_of_a_sound_scene_has_no_warning() {
    let layout = layout();
    let bundle = demc_infer::Bundle::load(Path::new("quality"), &burn::tensor::Device::flex());
    let bundle = bundle.expect("the bundled model");
    let mut crops = 0;
    for scene in fs::read_dir(sample().join("test")).expect("the sample") {
        let frame = read_frame(&scene.expect("a file").path(), &layout).expect("a scene");
        for (top, left) in (0..4).flat_map(|i| (0..4).map(move |j| (i * 64, j * 64))) {
            let cut = |planes: &[f32]| -> Vec<f32> {
                let pixels = frame.width * frame.height;
                let rows = planes.chunks(pixels).flat_map(|plane| {
                    (top..top + 64).map(move |y| &plane[y * frame.width + left..][..64])
                });
                rows.flatten().copied().collect()
            };
            let mut crop =
                demc_data::Frame::new("crop", 64, 64, cut(&frame.color), cut(&frame.features));
            crop.mask = frame.mask.as_deref().map(cut);
            let warnings = bundle.warnings(&crop).expect("sizes");
            let facing = warnings
                .iter()
                .find(|warning| warning.found.contains("face the origin"));
            assert!(facing.is_none(), "{} {top} {left}: {facing:?}", frame.name);
            crops += 1;
        }
    }
    assert_eq!(crops, 64);
}

#[test]
fn messages_name_the_file() {
    let dir = tempfile::tempdir().expect("a directory");
    let far = changed(&dir, "far.exr", "position.X", |i, _| {
        if i % 2 == 0 { 1e6 } else { -1e6 }
    });
    let run = run_directory();
    let list = arguments![
        "denoise",
        "--model",
        run.path(),
        far,
        "-o",
        dir.path().join("out.exr")
    ];
    let outcome = demc_infer(list);
    assert_eq!(outcome.code, 1);
    outcome.says(&format!(
        "error: {}: position.x does not fit",
        far.display()
    ));
    let table = sample_image("gen-table-test-1.exr");
    let outcome = fast(&[&table], &dir.path().join("out.exr"), &["--memory", "1"]);
    assert_eq!(outcome.code, 1);
    outcome.says(&format!("error: {}", table.display()));
}

#[test]
fn a_channel_of_nan_is_not_repaired() {
    let dir = tempfile::tempdir().expect("a directory");
    let output = dir.path().join("out.exr");
    let some = changed(&dir, "some.exr", "G", |i, x| {
        if i % 20 == 0 { f32::NAN } else { x }
    });
    fast(&[&some], &output, &["--repair"]).success();
    let all = changed(&dir, "all.exr", "G", |_, _| f32::NAN);
    let outcome = fast(&[&all], &output, &["--repair", "--overwrite"]);
    let start = format!(
        "{}: channel G: 65536 of 65536 samples are NaN",
        all.display()
    );
    outcome.failure(1, &start);
}

#[test]
fn an_exposure_beyond_the_largest_factor_is_named() {
    let dir = tempfile::tempdir().expect("a directory");
    let input = sample_image("gen-table-test-1.exr");
    let dark: Vec<f32> = color_of(&input).iter().map(|x| x * 1e-9).collect();
    let options = WriteOptions {
        precision: Some(SamplePrecision::Float),
        ..WriteOptions::default()
    };
    let path = dir.path().join("dark.exr");
    demc_data::write_denoised(&input, &layout(), &dark, &path, &options).expect("written");
    let denoised = fast(&[&path], &dir.path().join("out.exr"), &[]).success();
    denoised.says("the factor on the colour is limited to 1e6; is radiance in another unit?");
}

/// 24 frames that fade over 11 stops.
#[test]
fn a_sequence_that_fades_is_denoised_as_its_single_frames() {
    let dir = tempfile::tempdir().expect("a directory");
    let input = sample_image("gen-table-test-1.exr");
    let layout = layout();
    let frame = read_frame(&input, &layout).expect("a scene");
    let stops = |number: i32| -11.0 * (number - 1) as f32 / 23.0;
    let options = WriteOptions {
        precision: Some(SamplePrecision::Float),
        ..WriteOptions::default()
    };
    for number in 1..=24 {
        let color: Vec<f32> = frame
            .color
            .iter()
            .map(|x| x * stops(number).exp2())
            .collect();
        let path = dir.path().join(format!("fade.{number:02}.exr"));
        demc_data::write_denoised(&input, &layout, &color, &path, &options).expect("written");
    }
    let out = dir.path().join("out");
    let sequence = dir.path().join("fade.##.exr");
    fast(&[&sequence], &out, &["--frames", "1,12,24"]).success();
    let reference = frame.reference.as_deref().expect("a reference");
    let error = |path: &Path, number: i32| {
        let scale = stops(number).exp2();
        let image: Vec<f32> = color_of(path).iter().map(|x| x / scale).collect();
        rel_mse_image(&image, reference)
    };
    for number in [1, 12, 24] {
        let name = format!("fade.{number:02}.exr");
        let alone = dir.path().join("alone.exr");
        fast(&[&dir.path().join(&name)], &alone, &["--overwrite"]).success();
        let (single, in_sequence) = (error(&alone, number), error(&out.join(&name), number));
        assert!(
            in_sequence < 1.1 * single,
            "{name}: {in_sequence} for {single}"
        );
    }
}

#[test]
fn a_frame_far_from_its_sequence_is_named() {
    let dir = tempfile::tempdir().expect("a directory");
    let input = sample_image("gen-table-test-1.exr");
    let options = WriteOptions::default();
    for number in 1..=9 {
        let flash = if number == 4 { 32.0 } else { 1.0 };
        let color: Vec<f32> = color_of(&input).iter().map(|x| x * flash).collect();
        let path = dir.path().join(format!("flash.{number}.exr"));
        demc_data::write_denoised(&input, &layout(), &color, &path, &options).expect("written");
    }
    let sequence = dir.path().join("flash.#.exr");
    let outcome = fast(&[&sequence], &dir.path().join("out"), &["--frames", "3-5"]).success();
    outcome.says("flash.4.exr: exposure: it is +5.0 stops from that of the frames around it");
}

#[test]
fn inputs_without_images_are_named_and_the_others_are_denoised() {
    let (run, dir) = (run_directory(), tempfile::tempdir().expect("a directory"));
    let [empty, hidden] = ["empty", "hidden"].map(|name| dir.path().join(name));
    fs::create_dir(&empty).expect("a directory");
    fs::create_dir(&hidden).expect("a directory");
    fs::copy(sample_image("gen-table-test-1.exr"), hidden.join(".a.exr")).expect("copied");
    let file = sample_image("gen-room-test-1.exr");
    let inputs = [
        file.clone(),
        empty,
        hidden,
        dir.path().join("no*.exr"),
        dir.path().join("missing.exr"),
        // The same file again.
        sample().join("test/../test/gen-room-test-1.exr"),
    ];
    let out = dir.path().join("out");
    let mut list = arguments!["denoise", "--model", run.path(), "-o", out].to_vec();
    list.extend(inputs.iter().map(OsString::from));
    let outcome = demc_infer(list);
    assert_eq!(outcome.code, 1, "{}", outcome.stderr);
    for name in ["empty", "hidden", "no*.exr"] {
        outcome.says(&format!("{name}: no images found"));
    }
    outcome.says("missing.exr");
    assert_eq!(fs::read_dir(&out).expect("made").count(), 1);
    assert!(out.join("gen-room-test-1.exr").is_file());
}

#[test]
fn a_view_layer_of_a_file_without_layers_is_named() {
    let dir = tempfile::tempdir().expect("a directory");
    let file =
        Path::new(env!("CARGO_MANIFEST_DIR")).join("../tests/renderers/files/mitsuba-3.9.exr");
    let outcome = fast(&[&file], &dir.path().join("out.exr"), &["--layer", "foo"]);
    assert_eq!(outcome.code, 1);
    outcome.says("view layer \"foo\": the file has no view layers; omit the name");
}

#[test]
fn a_wrong_shard_is_explained() {
    let dir = tempfile::tempdir().expect("a directory");
    let file = sample_image("gen-table-test-1.exr");
    let outcome = fast(&[&file], &dir.path().join("out.exr"), &["--shard", "-1/2"]);
    assert_eq!(outcome.code, 2);
    outcome.says("expected I/N with I from 1 to N");
    assert!(!outcome.stderr.contains("tip"), "{}", outcome.stderr);
}

#[test]
fn the_help_names_every_renderer() {
    let help = demc_infer(["denoise", "--help"]).success().stdout;
    for renderer in ["Mitsuba", "pbrt", "Cycles", "LuxCore", "FBKSD"] {
        assert!(help.contains(renderer), "{renderer}");
    }
}

/// Blender's file has only the colour of a view layer.
#[test]
fn a_network_of_colour_alone_takes_files_of_colour_alone() {
    let dir = TempDir::new().expect("a directory");
    let model = ModelConfig {
        variant: Variant::ColorOnly,
        width: 2,
        ..ModelConfig::default()
    };
    let normalizer = random_bundle().meta.normalizer;
    let mut rng = ChaCha8Rng::seed_from_u64(4);
    let network = model.init(&mut rng, normalizer.flat_color, &Device::flex());
    let bundle = Bundle::new(BundleMeta::new(model, normalizer, layout(), 1), network);
    let path = dir.path().join("colour.safetensors");
    bundle
        .save(&path, Names::Burn, Precision::F32)
        .expect("saved");
    let file = "../tests/renderers/files/cycles-reference.exr";
    let image = Path::new(env!("CARGO_MANIFEST_DIR")).join(file);
    let denoise = |model: &Path| {
        let output = model.with_extension("exr");
        let flags = ["denoise", "--model"].map(OsString::from);
        let files = [model, &image, Path::new("-o"), &output].map(OsString::from);
        demc_infer(flags.into_iter().chain(files))
    };
    denoise(&path).success();
    assert!(path.with_extension("exr").exists());
    let with_features = run_directory();
    denoise(with_features.path()).failure(1, "channel layout of");
}
