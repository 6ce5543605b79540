//! Errors during a run name everything that helps to find their cause.

use std::fs;
use std::process::Stdio;

use crate::common::{
    command, config, error_line, metrics, place, says, train, trained, wait_until,
};
use demc_program::file::temporary_name;

/// The largest learning rate, without batch normalisation: the network's output soon overflows.
const EXPLODE: [&str; 4] = [
    "--set=optimizer.lr_start=10",
    "--set=optimizer.lr_end=10",
    "--set=model.reading=paper",
    "--set=data.validation=0",
];

#[test]
fn a_non_finite_loss_stops_the_run_and_names_its_patches() {
    let dir = tempfile::tempdir().expect("a temporary directory");
    let run = dir.path().join("run");
    let args = [&EXPLODE[..], &["--set=run.checkpoint_every=1"]].concat();
    let error = error_line(&train(&config(dir.path()), &run, &args), 1);
    for words in [
        "step 2: non-finite loss or gradient: loss ",
        "learning rate 1.000e1",
        "; patches: ",
        " (x ",
        "the last intact checkpoint is ",
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
fn skipped_steps_are_counted_and_too_many_end_the_run() {
    let (_dir, config, run) = place();
    let skip = [
        "--set=train.on_nan=skip",
        "--set=train.steps=120",
        "--set=run.log_every=4",
    ];
    let output = train(&config, &run, &[&EXPLODE[..], &skip].concat());
    let error = error_line(&output, 1);
    assert!(
        error.contains("step 101: ") && error.contains("gradient in 100 consecutive steps"),
        "{error}"
    );
    let text = String::from_utf8_lossy(&output.stdout);
    says(
        &text,
        "warning: step 2: non-finite loss or gradient, skipped: ",
    );
    let lines = metrics(&run);
    assert!(lines[0]["loss"].is_number() && lines[1]["loss"].is_null());
    assert_eq!(lines[0]["skipped"], 3, "of four steps");
    assert_eq!(lines[1]["skipped"], 7);
}

#[test]
fn a_stopped_run_may_resume_and_skip() {
    let (_dir, config, run) = place();
    trained(&config, &run, &["--set=train.steps=3"]);
    let args = ["--set=train.steps=3", "--resume", "--set=train.on_nan=skip"];
    trained(&config, &run, &args);
}

#[test]
fn a_second_process_in_the_directory_is_refused() {
    let (_dir, config, run) = place();
    let long = ["--set=train.steps=100000"];
    let mut first = command(&config, &run, &long)
        .stdout(Stdio::null())
        .spawn()
        .expect("the binary runs");
    wait_until(|| !metrics(&run).is_empty());
    let error = error_line(
        &train(&config, &run, &[&long[..], &["--resume"]].concat()),
        1,
    );
    says(&error, "in use by another training process");
    let lines = metrics(&run).len();
    wait_until(|| metrics(&run).len() > lines + 1);
    assert!(first.try_wait().expect("a child").is_none());
    first.kill().expect("a child");
    first.wait().expect("a child");
}

#[test]
fn incomplete_files_of_a_killed_process_are_removed() {
    let (_dir, config, run) = place();
    let set = ["--set=train.steps=3"];
    trained(&config, &run, &set);
    // Above the largest process id.
    let temporary = |name: &str| temporary_name(name.as_ref(), 4_199_999_999);
    let left = [
        run.join(temporary("best.safetensors")),
        run.join("strips").join(temporary("test.png")),
    ];
    for path in &left {
        fs::write(path, "half").expect("a file");
    }
    fs::write(run.join(".notes"), "mine").expect("a file");
    trained(&config, &run, &[&set[..], &["--resume"]].concat());
    assert!(left.iter().all(|path| !path.exists()));
    assert!(run.join(".notes").exists());
}
