//! What goes wrong in a run is said, with everything that helps to find out why.

mod common;

use std::fs;
use std::process::Stdio;

use common::{command, config, error_line, metrics, stderr, train, wait_until};

/// A learning rate at which one step is the end.
const EXPLODE: [&str; 4] = ["--set", "train.lr_start=1e30", "--set", "data.validation=0"];

#[test]
fn a_loss_that_is_not_finite_stops_the_run_and_names_its_patches() {
    let dir = tempfile::tempdir().expect("a temporary directory");
    let run = dir.path().join("run");
    let args = [&EXPLODE[..], &["--set", "run.checkpoint_every=1"]].concat();
    let error = error_line(&train(&config(dir.path()), &run, &args), 1);
    for words in [
        "step 2: loss ",
        "at learning rate 1.1",
        "not finite; patches: ",
        " (x ",
        "the last good checkpoint is ",
        "checkpoints/step-00000001",
        "train.on_nan=skip",
    ] {
        assert!(error.contains(words), "{words}: {error}");
    }
    // Two batches of two.
    assert!((1..=4).contains(&error.matches(" (x ").count()), "{error}");
    assert!(run.join("checkpoints/step-00000001").is_dir());
    assert!(!run.join("checkpoints/step-00000002").exists());
}

#[test]
fn skipped_steps_are_counted_and_too_many_are_the_end() {
    let dir = tempfile::tempdir().expect("a temporary directory");
    let config = config(dir.path());
    let run = dir.path().join("run");
    let skip = ["--set", "train.on_nan=skip", "--set", "train.steps=120"];
    let output = train(&config, &run, &[&EXPLODE[..], &skip].concat());
    let error = error_line(&output, 1);
    assert!(
        error.contains("step 101: ") && error.contains("not finite, for 100 steps in a row"),
        "{error}"
    );
    let text = String::from_utf8_lossy(&output.stdout);
    assert!(
        text.contains("warning: step 2: not finite, skipped: "),
        "{text}"
    );
    let lines = metrics(&run);
    assert_eq!(lines[0]["skipped"], 1, "of two steps");
    assert!(lines[0]["loss"].is_number() && lines[1]["loss"].is_null());
    assert_eq!(lines[1]["skipped"], 3);
}

/// What happens at such a step may be changed on the way.
#[test]
fn a_run_that_stopped_may_go_on_and_skip() {
    let dir = tempfile::tempdir().expect("a temporary directory");
    let config = config(dir.path());
    let run = dir.path().join("run");
    assert!(
        train(&config, &run, &["--set", "train.steps=3"])
            .status
            .success()
    );
    let args = [
        "--set",
        "train.steps=3",
        "--resume",
        "--set",
        "train.on_nan=skip",
    ];
    let output = train(&config, &run, &args);
    assert!(output.status.success(), "{}", stderr(&output));
}

#[test]
fn a_second_process_in_the_directory_is_refused_and_the_first_goes_on() {
    let dir = tempfile::tempdir().expect("a temporary directory");
    let config = config(dir.path());
    let run = dir.path().join("run");
    let long = ["--set", "train.steps=100000"];
    let mut first = command(&config, &run, &long)
        .stdout(Stdio::null())
        .spawn()
        .expect("the binary runs");
    wait_until(|| !metrics(&run).is_empty());
    let error = error_line(
        &train(&config, &run, &[&long[..], &["--resume"]].concat()),
        1,
    );
    assert!(
        error.contains("another process trains in this directory"),
        "{error}"
    );
    let lines = metrics(&run).len();
    wait_until(|| metrics(&run).len() > lines + 1);
    assert!(first.try_wait().expect("a child").is_none());
    first.kill().expect("a child");
    first.wait().expect("a child");
}

/// Half-written files of a process that was killed do not pile up.
#[test]
fn what_a_killed_process_left_half_written_is_swept_away() {
    let dir = tempfile::tempdir().expect("a temporary directory");
    let config = config(dir.path());
    let run = dir.path().join("run");
    let set = ["--set", "train.steps=3"];
    assert!(train(&config, &run, &set).status.success());
    let left = [".best.safetensors.123.tmp", "strips/.test.png.123.tmp"];
    for name in left {
        fs::write(run.join(name), "half").expect("a file");
    }
    fs::write(run.join(".notes"), "mine").expect("a file");
    assert!(
        train(&config, &run, &[&set[..], &["--resume"]].concat())
            .status
            .success()
    );
    assert!(left.iter().all(|name| !run.join(name).exists()));
    assert!(run.join(".notes").exists());
}
