//! Tests of `demc-infer denoise` through the binary.

use std::fs;
use std::path::Path;

use crate::arguments;
use crate::common::{Outcome, demc_infer, random_bundle, run_directory, sample, sample_image};
use demc_data::image::exr::ExrFile;
use demc_data::image::plane::Plane;
use demc_data::read_frame;
use demc_infer::Bundled;

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
fn several_images_fill_a_directory_and_a_bad_one_is_skipped() {
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
    assert_eq!(lines[1], "error: 1 of 3 images were not denoised");
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
    let file = run.path().join("best.safetensors/out.exr");
    let outcome = denoise(run.path(), &[&input], &file);
    assert_eq!(outcome.code, 1);
    outcome.says(&format!("cannot write {}", file.display()));
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
    demc_data::write_rgb(&input, 2, 1, &[0.5; 6], demc_data::SamplePrecision::Half)
        .expect("written");
    let outcome = denoise(run.path(), &[&input], &dir.path().join("out.exr"));
    assert_eq!(outcome.code, 1);
    outcome.says("the nearest, demc-exr, lacks normal.X");
}

#[test]
fn the_bundled_models_denoise() {
    let out = tempfile::tempdir().expect("directory");
    let layout = random_bundle().meta.layout;
    for model in Bundled::ALL.map(Bundled::name) {
        for name in ["col-classroom-1.exr", "gen-room-test-1.exr"] {
            let input = sample_image(name);
            let output = out.path().join(format!("{model}-{name}"));
            demc_infer(arguments!["denoise", "--model", model, input, "-o", output]).success();
            let frame = read_frame(&input, &layout).expect("frame");
            let reference = frame.reference.as_deref().expect("a reference");
            let denoised: Vec<f32> = read_rgb(&output).iter().flat_map(Plane::to_f32).collect();
            let error = |image: &[f32]| demc_model::metrics::rel_mse_image(image, reference);
            let (noisy, black) = (error(&frame.color), error(&vec![0.0; reference.len()]));
            let found = error(&denoised);
            assert!(found < 0.15 * noisy.min(black), "{model}, {name}: {found}");
        }
    }
    let shown = demc_infer(arguments!["inspect"]).success();
    shown.says("quality");
}

#[test]
fn the_bundled_models_are_small() {
    for model in Bundled::ALL {
        let file = format!("../models/{}.safetensors", model.name());
        let path = Path::new(env!("CARGO_MANIFEST_DIR")).join(file);
        assert!(fs::metadata(path).expect("a model").len() <= 12_000_000);
    }
}

#[test]
fn a_partly_finished_directory_is_resumed() {
    let (run, dir) = (run_directory(), tempfile::tempdir().expect("directory"));
    let out = dir.path().join("out");
    let whole = |extra: &[&str]| {
        let mut list = arguments!["denoise", "--model", run.path(), "-o", out].to_vec();
        list.push(sample().join("test").into());
        list.extend(extra.iter().map(Into::into));
        let stderr = demc_infer(list).success().stderr;
        // A random network also causes warnings.
        let done = stderr.lines().find(|line| line.contains("already exist"));
        done.map(str::to_owned)
    };
    assert_eq!(whole(&[]), None);
    let path = out.join("gen-room-test-1.exr");
    let first = fs::read(&path).expect("made");
    fs::remove_file(&path).expect("removed");
    let kept = out.join("gen-table-test-1.exr");
    let time = || {
        fs::metadata(&kept)
            .and_then(|found| found.modified())
            .expect("a time")
    };
    let before = time();
    let note = "note: 3 of 4 images already exist; --overwrite replaces them";
    assert_eq!(whole(&[]).as_deref(), Some(note));
    assert_eq!(fs::read(&path).expect("made again"), first);
    assert_eq!(time(), before, "not touched");
    assert_eq!(whole(&["--overwrite", "--png"]), None);
    assert!(read_rgb(&kept).len() == 3 && out.join("gen-table-test-1.png").is_file());
    let previews = fs::read_dir(&out).expect("directory");
    assert_eq!(previews.count(), 8);
}

#[test]
fn a_shot_does_not_replace_the_image_of_another_one() {
    let (run, dir) = (run_directory(), tempfile::tempdir().expect("directory"));
    let output = dir.path().join("out/");
    let shots = [
        ("one", "gen-table-test-1.exr"),
        ("two", "gen-room-test-1.exr"),
    ];
    let inputs = shots.map(|(shot, image)| {
        let folder = dir.path().join(shot).join("v2/beauty");
        fs::create_dir_all(&folder).expect("a directory");
        let input = folder.join("f.exr");
        fs::copy(sample_image(image), &input).expect("copied");
        input
    });
    denoise(run.path(), &[&inputs[0]], &output).success();
    let before = fs::read(output.join("f.exr")).expect("an image");
    let now = fs::File::options()
        .append(true)
        .open(&inputs[1])
        .expect("a file");
    now.set_modified(std::time::SystemTime::now())
        .expect("a newer file");
    let outcome = denoise(run.path(), &[&inputs[1]], &output);
    assert_eq!(outcome.code, 1, "{}", outcome.stderr);
    outcome.says("input one/v2/beauty/f.exr instead of two/v2/beauty/f.exr");
    assert_eq!(fs::read(output.join("f.exr")).expect("an image"), before);
}

#[test]
fn the_detail_map_is_written_beside_the_colour() {
    let (run, out) = (run_directory(), tempfile::tempdir().expect("directory"));
    let input = sample_image("gen-table-test-1.exr");
    let output = out.path().join("clean.exr");
    let list = arguments![
        "denoise",
        "--model",
        run.path(),
        input,
        "-o",
        output,
        "--detail-map"
    ];
    demc_infer(list).success();
    let bundle = random_bundle();
    let frame = read_frame(&input, &bundle.meta.layout).expect("frame");
    let expected = bundle.detail_map(&frame).expect("computed");
    let names = ["detail.R", "detail.G", "detail.B"];
    let planes = ExrFile::open(&output)
        .expect("an EXR")
        .read(&names)
        .expect("a map");
    let found: Vec<f32> = planes.iter().flat_map(Plane::to_f32).collect();
    assert_eq!(Some(found), expected);
    let rewritten = read_frame(&output, &bundle.meta.layout).expect("frame");
    assert_eq!(rewritten.features, frame.features);

    let list = arguments![
        "denoise",
        "--filter",
        "nfor",
        "--detail-map",
        input,
        "-o",
        output
    ];
    let outcome = demc_infer(list);
    assert_eq!(outcome.code, 2);
    outcome.says("cannot be used with");
}

#[test]
fn a_sequence_is_denoised_frame_by_frame() {
    let (run, dir) = (run_directory(), tempfile::tempdir().expect("directory"));
    for number in [8, 9, 10, 12] {
        let frame = dir.path().join(format!("shot ü.{number:04}.exr"));
        fs::copy(sample_image("gen-table-test-1.exr"), frame).expect("copied");
    }
    let out = dir.path().join("out");
    let list = arguments![
        "denoise",
        "--model",
        run.path(),
        "-o",
        out,
        "--frames",
        "9-12",
        dir.path().join("shot ü.####.exr")
    ];
    let outcome = demc_infer(list);
    assert_eq!(outcome.code, 1);
    outcome.says("1 of 4 frames are missing: 11\n");
    let mut names: Vec<_> = fs::read_dir(&out)
        .expect("made")
        .map(|entry| entry.expect("entry").file_name())
        .collect();
    names.sort();
    assert_eq!(
        names,
        ["shot ü.0009.exr", "shot ü.0010.exr", "shot ü.0012.exr"]
    );
}

#[test]
fn tiles_are_reported_and_equal_the_whole_image() {
    let (run, dir) = (run_directory(), tempfile::tempdir().expect("directory"));
    let input = sample_image("col-classroom-1.exr");
    let with = |name: &str, flags: &[&str]| {
        let output = dir.path().join(name);
        let mut list = arguments!["denoise", "--model", run.path(), input, "-o", output].to_vec();
        list.extend(["--precision", "float"].iter().chain(flags).map(Into::into));
        let outcome = demc_infer(list).success();
        let planes = read_rgb(&output);
        let values: Vec<f32> = planes.iter().flat_map(Plane::to_f32).collect();
        (outcome.stderr, values)
    };
    let (_, whole) = with("whole.exr", &[]);
    let (note, tiled) = with("tiled.exr", &["--tile", "64"]);
    assert!(
        note.contains("4 x 4 tiles of at most 256x256 pixels with halo 192, 16.00 times"),
        "{note}"
    );
    let largest = whole.iter().fold(0.0f32, |most, x| most.max(*x));
    let same = whole
        .iter()
        .zip(&tiled)
        .all(|(a, b)| (a - b).abs() <= 2e-6 * largest);
    assert!(same);
    let (note, _) = with("near.exr", &["--tile", "64", "--halo", "32"]);
    assert!(
        note.contains("error at seams, from 3 windows denoised exactly: RelMSE"),
        "{note}"
    );
    let list = arguments![
        "cost",
        "--model",
        run.path(),
        input,
        "--tile",
        "64",
        "--json"
    ];
    let cost: serde_json::Value =
        serde_json::from_str(&demc_infer(list).success().stdout).expect("JSON");
    assert_eq!(cost["images"][0]["tiles"], 16);
    assert_eq!(cost["images"][0]["width"], 256);
    let ratio = cost["images"][0]["flops"]
        .as_f64()
        .zip(cost["images"][0]["flops_whole"].as_f64());
    assert!(ratio.is_some_and(|(tiled, whole)| tiled > 10.0 * whole));
}
