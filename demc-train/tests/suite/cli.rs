//! The output and the files of the program.

use std::fs;
use std::process::Stdio;
use std::thread::sleep;
use std::time::{Duration, Instant};

use crate::common::{command, config, error_line, place, says, stderr, train, trained};

#[test]
fn a_short_run_writes_all_files() {
    let dir = tempfile::tempdir().expect("a temporary directory");
    let run = dir.path().join("run");
    let output = trained(&config(dir.path()), &run, &["--set=train.steps=4"]);
    assert_eq!(stderr(&output), "", "no progress bar without a terminal");

    let text = String::from_utf8_lossy(&output.stdout);
    let first = text.lines().next().expect("a line");
    assert!(
        first.starts_with("demc-train: about ")
            && first.contains("per step")
            && first.contains("(kernels on "),
        "{first}"
    );
    for words in [
        "kept weights: those of step 4 of 4, with the best validation RelMSE ",
        "| mean ",
    ] {
        assert!(text.contains(words), "{words}: {text}");
    }

    for file in [
        "config.toml",
        "run.json",
        "metrics.jsonl",
        "latest",
        "best.safetensors",
        "checkpoints/step-00000004/model.safetensors",
        "strips/step-00000004.png",
        "strips/test.png",
        "test.json",
    ] {
        assert!(run.join(file).is_file(), "{file}");
    }
    let log = fs::read_to_string(run.join("metrics.jsonl")).expect("a log");
    let last: serde_json::Value =
        serde_json::from_str(log.lines().last().expect("a line")).expect("JSON");
    for key in [
        "step",
        "loss",
        "lr",
        "valid_relmse",
        "valid_ssim",
        "elapsed_s",
    ] {
        assert!(last[key].is_number(), "{key}: {last}");
    }
    let test: serde_json::Value =
        serde_json::from_slice(&fs::read(run.join("test.json")).expect("scores")).expect("JSON");
    assert_eq!(test["images"].as_array().expect("images").len(), 4);
}

#[test]
fn every_variant_and_reading_trains() {
    let dir = tempfile::tempdir().expect("a temporary directory");
    let config = config(dir.path());
    for variant in ["demc", "demc-nosn", "semc"] {
        for reading in ["paper", "released"] {
            let run = dir.path().join(format!("{variant}-{reading}"));
            let (variant, reading) = (
                format!("model.variant={variant}"),
                format!("model.reading={reading}"),
            );
            let sets = [
                "--set",
                &variant,
                "--set",
                &reading,
                "--set=train.steps=1",
                "--set=data.validation=0",
            ];
            let output = train(&config, &run, &sets);
            let text = String::from_utf8_lossy(&output.stdout);
            let kept = "kept weights: those of the last step 1, no scene is held out";
            assert!(
                output.status.success(),
                "{variant} {reading}: {}",
                stderr(&output)
            );
            assert!(text.contains(kept), "{text}");
        }
    }
}

#[test]
fn check_writes_nothing() {
    let dir = tempfile::tempdir().expect("a temporary directory");
    let run = dir.path().join("run");
    trained(&config(dir.path()), &run, &["--check"]);
    assert!(!run.exists());
}

#[test]
fn invalid_configurations_exit_with_2_and_one_line() {
    let (dir, config, run) = place();
    let error = |set: &str| error_line(&train(&config, &run, &["--set", set]), 2);
    assert!(error("train.step=3").contains("did you mean `train.steps`?"));
    assert!(error("model.variant=resnet").contains("demc-nosn"));
    let all = error_line(
        &train(
            &config,
            &run,
            &["--set=train.steps=0", "--set=data.stride=0"],
        ),
        2,
    );
    assert!(
        all.contains("train.steps") && all.contains("data.stride"),
        "both problems: {all}"
    );

    let misspelt = dir.path().join("misspelt.toml");
    fs::write(&misspelt, "[model]\n\nwidht = 3\n").expect("a file");
    let error = error_line(&train(&misspelt, &run, &[]), 2);
    says(
        &error,
        "misspelt.toml:3: unknown key `model.widht`; did you mean `model.width`?",
    );
    let error = error_line(&train(&dir.path().join("none.toml"), &run, &[]), 2);
    assert!(error.contains("none.toml"), "{error}");
    assert!(!run.exists(), "nothing is written");
}

#[test]
fn invalid_data_and_directories_exit_with_1_and_one_line() {
    let (dir, config, run) = place();
    let error = |args: &[&str]| error_line(&train(&config, &run, args), 1);
    let device = error_line(&train(&config, &run, &["--device", "tpu"]), 2);
    assert!(device.contains("known devices: flex"), "{device}");
    assert!(error(&["--set=data.root=/nowhere/at/all"]).contains("/nowhere/at/all"));
    assert!(error(&["--set=data.layout=blender"]).contains("blender"));
    assert!(
        error(&["--set=data.patch_size=256"]).contains("224"),
        "a scene smaller than a patch"
    );
    assert!(!run.exists(), "nothing is written");

    let file = dir.path().join("file");
    fs::write(&file, "").expect("a file");
    let output = train(&config, &file.join("run"), &["--set=train.steps=1"]);
    assert!(
        error_line(&output, 1).contains("file"),
        "a run directory that cannot be created"
    );
}

/// Decoding needs none of the training threads, which wait for it.
#[test]
fn one_thread_is_enough() {
    let dir = tempfile::tempdir().expect("a temporary directory");
    let run = dir.path().join("run");
    let mut child = command(&config(dir.path()), &run, &["--set=train.steps=2"])
        .env("RAYON_NUM_THREADS", "1")
        .stdout(Stdio::null())
        .stderr(Stdio::null())
        .spawn()
        .expect("the binary runs");
    let started = Instant::now();
    let status = loop {
        if let Some(status) = child.try_wait().expect("a child") {
            break status;
        }
        if started.elapsed().as_secs() > 120 {
            child.kill().expect("a child");
        }
        sleep(Duration::from_millis(20));
    };
    assert!(status.success(), "{status}");
}
