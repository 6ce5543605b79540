//! What the tests of the program share: the real binary on the committed sample, with a network of a few seconds.
#![allow(dead_code, reason = "each test file uses its part")]

use std::path::{Path, PathBuf};
use std::process::{Command, Output};

/// The repository's sample data.
pub fn sample() -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("../data/sample")
}

/// A run of twelve steps with everything in it that a resume could lose: batch normalisation, every augmentation, an
/// average of the weights, two batches a step, a log that is not in step with the checkpoints.
pub fn config(dir: &Path) -> PathBuf {
    let text = format!(
        "[model]\nwidth = 2\nreading = \"released\"\n\
         [data]\nroot = {:?}\npatch_size = 64\nbatch_size = 2\nvalidation = 0.2\naugment = true\n\
         [train]\nsteps = 12\nema = 0.9\nrecycle = 5\nlr_fan_in = 32\nmuon = 4\nlr_start = 1e-3\ngrad_accumulation = 2\ngrad_clip = 1.0\n\
         [run]\nlog_every = 2\nvalidate_every = 4\ncheckpoint_every = 3\nkeep = 2\n",
        sample()
    );
    let path = dir.join("tiny.toml");
    std::fs::write(&path, text).expect("a temporary directory");
    path
}

/// `demc-train --config CONFIG --run-dir RUN ARGS...`
pub fn command(config: &Path, run: &Path, args: &[&str]) -> Command {
    let mut command = Command::new(env!("CARGO_BIN_EXE_demc-train"));
    command
        .arg("--config")
        .arg(config)
        .arg("--run-dir")
        .arg(run)
        .args(args);
    command
}

/// Runs it to the end.
pub fn train(config: &Path, run: &Path, args: &[&str]) -> Output {
    command(config, run, args)
        .output()
        .expect("the binary runs")
}

/// Standard error as text.
pub fn stderr(output: &Output) -> String {
    String::from_utf8_lossy(&output.stderr).into_owned()
}

/// The one line that a failure prints, its exit code checked.
pub fn error_line(output: &Output, code: i32) -> String {
    let text = stderr(output);
    assert_eq!(output.status.code(), Some(code), "{text}");
    assert_eq!(text.lines().count(), 1, "one line: {text}");
    assert!(text.starts_with("error: "), "{text}");
    text
}

/// `metrics.jsonl` without what depends on the clock.
pub fn metrics(run: &Path) -> Vec<serde_json::Value> {
    let text = std::fs::read_to_string(run.join("metrics.jsonl")).unwrap_or_default();
    let lines = text
        .lines()
        .filter_map(|line| serde_json::from_str::<serde_json::Value>(line).ok());
    lines
        .map(|mut line| {
            for key in ["elapsed_s", "patches_per_s"] {
                let line = line.as_object_mut().expect("an object");
                line.remove(key).expect("a time");
            }
            line
        })
        .collect()
}

/// The files of a finished run of [`config`] that must not depend on what happened to it on the way.
pub const RESULTS: [&str; 5] = [
    "best.safetensors",
    "checkpoints/step-00000012/model.safetensors",
    "checkpoints/step-00000012/average.safetensors",
    "checkpoints/step-00000012/optimizer.safetensors",
    "test.json",
];

/// Fails unless two finished runs of [`config`] ended alike, log included.
pub fn assert_same_run(whole: &Path, other: &Path, what: &str) {
    assert_eq!(metrics(other), metrics(whole), "{what}");
    for file in RESULTS {
        let bytes = |run: &Path| std::fs::read(run.join(file)).expect(file);
        assert!(bytes(whole) == bytes(other), "{what}: {file} differs");
    }
}

/// Waits until `done`, for two minutes at most.
pub fn wait_until(mut done: impl FnMut() -> bool) {
    let started = std::time::Instant::now();
    while !done() {
        assert!(started.elapsed().as_secs() < 120, "no progress");
        std::thread::sleep(std::time::Duration::from_millis(5));
    }
}
