//! `demc-infer denoise` as a user runs it.

mod common;

use std::fs;
use std::path::Path;

use common::{Outcome, demc_infer, random_bundle, run_directory, sample_image};
use demc_data::exr::ExrFile;
use demc_data::plane::Plane;
use demc_data::read_frame;

/// Runs `denoise` on `inputs`.
fn denoise(model: &Path, inputs: &[&Path], output: &Path) -> Outcome {
    let mut list = arguments!["denoise", "--model", model, "-o", output].to_vec();
    list.extend(inputs.iter().map(|path| path.into()));
    demc_infer(list)
}

fn read_rgb(path: &Path) -> Vec<Plane> {
    ExrFile::open(path)
        .expect("an EXR")
        .read(&["R", "G", "B"])
        .expect("R, G and B")
}

#[test]
fn one_image_gives_one_file_equal_to_the_library() {
    let (run, out) = (run_directory(), tempfile::tempdir().expect("directory"));
    let input = sample_image("gen-table-test-1.exr");
    let output = out.path().join("clean.exr");
    denoise(run.path(), &[&input], &output).success();

    let bundle = random_bundle();
    let frame = read_frame(&input, &bundle.meta.layout).expect("frame");
    let expected = bundle.denoise(&frame).expect("denoised");
    let found: Vec<f32> = read_rgb(&output).iter().flat_map(Plane::to_f32).collect();
    assert_eq!(found.len(), expected.len());
    let worst = found
        .iter()
        .zip(&expected)
        .map(|(a, b)| (a - b).abs() / (b + 1e-3))
        .fold(0.0, f32::max);
    assert!(
        worst <= 2f32.powi(-11),
        "half rounds by 2^-11 relative; found {worst}"
    );
    assert!(matches!(read_rgb(&output)[0], Plane::Half(_)));
}

#[test]
fn float_output_repeats_byte_for_byte() {
    let (run, out) = (run_directory(), tempfile::tempdir().expect("directory"));
    let input = sample_image("gen-room-test-1.exr");
    let once = |name: &str| {
        let output = out.path().join(name);
        let list = arguments![
            "denoise",
            "--model",
            run.path(),
            input,
            "-o",
            output,
            "--precision",
            "float"
        ];
        demc_infer(list).success();
        assert!(matches!(read_rgb(&output)[0], Plane::Float(_)));
        fs::read(output).expect("output")
    };
    assert_eq!(once("a.exr"), once("b.exr"));
}

#[test]
fn several_images_fill_a_directory_and_a_bad_one_stops_nothing() {
    let (run, dir) = (run_directory(), tempfile::tempdir().expect("directory"));
    let bad = dir.path().join("bad.exr");
    fs::write(&bad, "no image").expect("written");
    let (first, last) = (
        sample_image("gen-table-test-1.exr"),
        sample_image("gen-room-test-1.exr"),
    );
    let out = dir.path().join("new/deep");
    let outcome = denoise(run.path(), &[&first, &bad, &last], &out);

    assert_eq!(outcome.code, 1);
    let lines: Vec<_> = outcome
        .stderr
        .lines()
        .filter(|line| line.starts_with("error: "))
        .collect();
    assert_eq!(lines.len(), 2, "{}", outcome.stderr);
    assert!(lines[0].contains("bad.exr"), "{}", outcome.stderr);
    assert_eq!(lines[1], "error: 1 of 3 images not denoised");
    let mut names: Vec<_> = fs::read_dir(&out)
        .expect("made")
        .map(|e| e.expect("entry").file_name())
        .collect();
    names.sort();
    assert_eq!(names, ["gen-room-test-1.exr", "gen-table-test-1.exr"]);
}

#[test]
fn a_wrong_command_line_is_exit_code_2_and_writes_nothing() {
    let (run, dir) = (run_directory(), tempfile::tempdir().expect("directory"));
    let input = sample_image("gen-table-test-1.exr");
    let copy = dir.path().join("gen-table-test-1.exr");
    fs::copy(&input, &copy).expect("copied");
    let before = fs::read(&copy).expect("copy");

    denoise(run.path(), &[&copy], &copy)
        .failure(2, &format!("output {} would replace", copy.display()));
    denoise(run.path(), &[&copy], dir.path()).failure(2, "output ");
    denoise(run.path(), &[&input, &copy], &dir.path().join("out"))
        .failure(2, &input.display().to_string());
    assert_eq!(fs::read(&copy).expect("copy"), before);
    assert_eq!(fs::read_dir(dir.path()).expect("directory").count(), 1);
}

#[test]
fn an_output_that_cannot_be_written_is_named() {
    let run = run_directory();
    let input = sample_image("gen-table-test-1.exr");
    let outcome = denoise(
        run.path(),
        &[&input],
        Path::new("/no-such-directory/out.exr"),
    );
    assert_eq!(outcome.code, 1);
    assert!(
        outcome.stderr.contains("/no-such-directory/out.exr"),
        "{}",
        outcome.stderr
    );
}

#[test]
fn a_device_that_is_unknown_or_not_built_is_exit_code_2() {
    let run = run_directory();
    let input = sample_image("gen-table-test-1.exr");
    let on = |device: &str| {
        let output = run.path().join("out.exr");
        demc_infer(arguments![
            "denoise",
            "--model",
            run.path(),
            input,
            "-o",
            output,
            "--device",
            device
        ])
    };
    on("tpu").failure(2, "unknown device `tpu`; known devices: flex");
    if cfg!(not(feature = "cuda")) {
        on("cuda:0").failure(
            2,
            "device `cuda:0`: not in this build; build with `--features cuda`",
        );
    }
}

#[test]
fn channels_that_do_not_fit_the_layout_are_listed() {
    let (run, dir) = (run_directory(), tempfile::tempdir().expect("directory"));
    let input = dir.path().join("rgb-only.exr");
    demc_data::write_rgb(&input, 2, 1, &[0.5; 6], demc_data::Precision::Half).expect("written");
    let outcome = denoise(run.path(), &[&input], &dir.path().join("out.exr"));
    assert_eq!(outcome.code, 1);
    assert!(
        outcome.stderr.contains("no channel normal.X"),
        "{}",
        outcome.stderr
    );
    assert!(
        outcome.stderr.contains("the file has B, G, R"),
        "{}",
        outcome.stderr
    );
}

/// Without `--model` the program uses the one that it comes with, which never saw the sample's test scenes.
#[test]
fn the_programs_own_model_denoises() {
    let out = tempfile::tempdir().expect("directory");
    let layout = random_bundle().meta.layout;
    for name in ["col-classroom-1.exr", "gen-room-test-1.exr"] {
        let input = sample_image(name);
        let output = out.path().join(name);
        demc_infer(arguments!["denoise", input, "-o", output]).success();
        let frame = read_frame(&input, &layout).expect("frame");
        let reference = frame.reference.as_deref().expect("a reference");
        let denoised: Vec<f32> = read_rgb(&output).iter().flat_map(Plane::to_f32).collect();
        let error = |image: &[f32]| demc_model::metrics::rel_mse_image(image, reference);
        let (noisy, black) = (error(&frame.color), error(&vec![0.0; reference.len()]));
        let found = error(&denoised);
        assert!(found < 0.15 * noisy.min(black), "{name}: {found}");
    }
    let shown = demc_infer(arguments!["inspect"]).success();
    assert!(shown.stdout.contains("demc-infer"), "{}", shown.stdout);
}

/// It is part of the program and of the repository.
#[test]
fn the_programs_own_model_is_small() {
    let path = Path::new(env!("CARGO_MANIFEST_DIR")).join("../models/demc.safetensors");
    assert!(fs::metadata(path).expect("a model").len() <= 30_000_000);
}
