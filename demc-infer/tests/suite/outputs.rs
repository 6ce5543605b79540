//! Outputs of `demc-infer`: what is replaced, what is kept, and in which words.

use std::ffi::OsString;
use std::fs;
use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};

use demc_infer::Picture;
use tempfile::TempDir;

use crate::arguments;
use crate::common::{
    Outcome, demc_infer, kernel_run_directory, run_directory, sample, sample_image,
};

/// Two models, a directory for outputs, and one input.
struct Case {
    models: [TempDir; 2],
    dir: TempDir,
    input: PathBuf,
}

impl Case {
    fn new() -> Self {
        let dir = tempfile::tempdir().expect("a directory");
        let input = dir.path().join("in.exr");
        fs::copy(sample_image("gen-table-test-1.exr"), &input).expect("copied");
        Case {
            models: [run_directory(), kernel_run_directory()],
            dir,
            input,
        }
    }

    fn at(&self, name: &str) -> PathBuf {
        self.dir.path().join(name)
    }

    fn denoise(&self, model: usize, output: &str, flags: &[&str]) -> Outcome {
        let model = self.models[model].path();
        let list = arguments![
            "denoise",
            "--model",
            model,
            self.input,
            "-o",
            self.at(output)
        ];
        demc_infer(list.into_iter().chain(flags.iter().map(OsString::from)))
    }
}

fn bytes(path: &Path) -> Vec<u8> {
    fs::read(path).expect("a file")
}

fn preview_of(output: &Path, exposure: f32) -> Vec<u8> {
    let layout = demc_data::ChannelLayout::resolve("demc-exr").expect("a preset");
    let frame = demc_data::read_frame(output, &layout).expect("an image");
    let exposed: Vec<f32> = frame.color.iter().map(|x| x * exposure.exp2()).collect();
    pixels(
        &Picture::from_hdr(&exposed, frame.height, frame.width)
            .to_png()
            .expect("a picture"),
    )
}

fn pixels(png: &[u8]) -> Vec<u8> {
    let mut reader = png::Decoder::new(std::io::Cursor::new(png))
        .read_info()
        .expect("a PNG");
    let mut pixels = vec![0; reader.output_buffer_size().expect("small")];
    reader.next_frame(&mut pixels).expect("pixels");
    pixels
}

#[test]
fn a_preview_shows_the_image_beside_it() {
    let case = Case::new();
    let [output, preview] = ["out/in.exr", "out/in.png"].map(|name| case.at(name));
    case.denoise(0, "out/", &[]).success();
    case.denoise(0, "out/", &["--png"]).success();
    assert_eq!(pixels(&bytes(&preview)), preview_of(&output, 0.0));
    // Another model keeps the image, so its preview stays, too.
    let before = bytes(&output);
    let refused = case.denoise(1, "out/", &["--png"]);
    assert_eq!(refused.code, 1, "{}", refused.stderr);
    assert_eq!(
        (bytes(&output), pixels(&bytes(&preview))),
        (before, preview_of(&output, 0.0))
    );
    // Another exposure makes another preview, and another image, too.
    case.denoise(0, "out/", &["--png", "--exposure", "2"])
        .success();
    assert_eq!(pixels(&bytes(&preview)), preview_of(&output, 2.0));
    case.denoise(1, "out/", &["--overwrite"]).success();
    case.denoise(1, "out/", &["--png", "--exposure", "2"])
        .success();
    assert_eq!(pixels(&bytes(&preview)), preview_of(&output, 2.0));
}

#[test]
fn a_picture_of_another_program_is_kept() {
    let case = Case::new();
    fs::create_dir(case.at("out")).expect("a directory");
    fs::write(case.at("out/in.png"), "a photograph").expect("written");
    let outcome = case.denoise(0, "out/", &["--png"]);
    assert_eq!(outcome.code, 1);
    outcome.says("in.png exists, not written by this program; --overwrite replaces it");
    assert_eq!(bytes(&case.at("out/in.png")), b"a photograph");
    assert!(case.at("out/in.exr").is_file());
}

#[test]
fn an_output_of_other_options_is_named() {
    let case = Case::new();
    case.denoise(1, "out/", &[]).success();
    let before = bytes(&case.at("out/in.exr"));
    for (model, flags, words) in [
        (0, vec![], "made with --model "),
        (
            1,
            vec!["--layers", "albedo1.R"],
            "made with --layers the default instead of albedo1.R",
        ),
        (
            1,
            vec!["--precision", "float"],
            "made with --precision the default instead of float",
        ),
        (
            1,
            vec!["--repair"],
            "made with --repair the default instead of on",
        ),
    ] {
        let outcome = case.denoise(model, "out/", &flags);
        assert_eq!(outcome.code, 1, "{}", outcome.stderr);
        outcome.says(words);
        outcome.says("--overwrite replaces it");
        outcome.says("1 existing file(s) were kept");
        assert_eq!(bytes(&case.at("out/in.exr")), before);
    }
    case.denoise(1, "out/", &[])
        .success()
        .says("1 of 1 images already exist");
}

#[test]
fn a_damaged_output_does_not_count_as_finished() {
    let case = Case::new();
    case.denoise(0, "out/", &[]).success();
    let output = case.at("out/in.exr");
    fs::write(&output, &bytes(&output)[..100]).expect("written");
    let outcome = case.denoise(0, "out/", &[]);
    assert_eq!(outcome.code, 1);
    outcome.says("in.exr exists, damaged, or not an EXR file; --overwrite replaces it");
    case.denoise(0, "out/", &["--overwrite"]).success();
}

#[test]
fn a_single_output_follows_the_rules_of_a_directory() {
    let case = Case::new();
    case.denoise(0, "a/b/c.exr", &[]).success();
    let first = bytes(&case.at("a/b/c.exr"));
    case.denoise(0, "a/b/c.exr", &[])
        .success()
        .says("already exist");
    let later = std::time::SystemTime::now() + std::time::Duration::from_secs(60);
    let input = fs::File::options()
        .write(true)
        .open(&case.input)
        .expect("a file");
    input.set_modified(later).expect("a time");
    fs::remove_file(case.at("a/b/c.exr")).expect("removed");
    case.denoise(0, "a/b/c.exr", &[]).success();
    assert_eq!(bytes(&case.at("a/b/c.exr")), first);
    case.denoise(0, "a/b/c.exr", &[]).success();
    fs::write(case.at("mine.exr"), "mine").expect("written");
    case.denoise(0, "mine.exr", &[])
        .failure(2, &case.at("mine.exr").display().to_string());
    assert_eq!(bytes(&case.at("mine.exr")), b"mine");
}

#[test]
fn an_output_that_is_no_exr_file_is_refused() {
    let case = Case::new();
    for name in ["o.png", "o.tif", "o"] {
        let start = format!("-o {}: an output is an EXR file", case.at(name).display());
        case.denoise(0, name, &[]).failure(2, &start);
        assert!(!case.at(name).exists());
    }
}

/// Every program that writes a file of a chosen name.
#[test]
fn no_command_replaces_a_file_without_overwrite() {
    let case = Case::new();
    let model = case.models[0].path().to_owned();
    let other = case.models[1].path().join("best.safetensors");
    let file = case.at("mine");
    let data = sample();
    let weights = model.join("best.safetensors");
    let commands = [
        arguments!["report", "--model", model, "--data", data, "-o", file].to_vec(),
        arguments!["evaluate", "--model", model, "--data", data, "--json", file].to_vec(),
        arguments!["export", "--model", model, "-o", file].to_vec(),
        arguments!["export", "--model", model, "-o", other].to_vec(),
        arguments!["import", weights, "--like", model, "-o", file].to_vec(),
    ];
    fs::write(&file, "mine").expect("written");
    let best = bytes(&other);
    for command in commands {
        let verb = command[0].clone();
        let outcome = demc_infer(&command);
        assert_eq!(outcome.code, 2, "{verb:?}: {}", outcome.stderr);
        outcome.says("exists; --overwrite replaces it");
        assert_eq!(
            (bytes(&file), bytes(&other)),
            (b"mine".to_vec(), best.clone()),
            "{verb:?}"
        );
    }
    let export = arguments!["export", "--model", model, "-o", file, "--overwrite"];
    demc_infer(export).success();
    assert_ne!(bytes(&file), b"mine");
}

#[cfg(target_os = "linux")]
#[test]
fn a_pipe_behind_dev_stdout_is_named() {
    let case = Case::new();
    let report = Command::new(env!("CARGO_BIN_EXE_demc-infer"))
        .args(["report", "-o", "/dev/stdout", "--data"])
        .arg(sample())
        .arg("--model")
        .arg(case.models[0].path())
        .stdout(Stdio::piped())
        .output()
        .expect("started");
    let words = String::from_utf8_lossy(&report.stderr).into_owned();
    assert!(
        words.contains("cannot write /dev/stdout: not a regular file"),
        "{words}"
    );
}
