//! Shared by the tests of the program: the real binary on the committed sample, with a tiny
//! network.

use std::path::{Path, PathBuf};
use std::process::{Command, Output};

/// The repository's sample data.
pub fn sample() -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("../data/sample")
}

/// Copies the sample's data set.
pub fn copy_sample(to: &Path) {
    for folder in ["", "train", "test"] {
        std::fs::create_dir_all(to.join(folder)).expect("a directory");
        let entries = std::fs::read_dir(sample().join(folder)).expect("the sample");
        for file in entries.flatten().filter(|entry| entry.path().is_file()) {
            let copy = to.join(folder).join(file.file_name());
            std::fs::copy(file.path(), copy).expect("copied");
        }
    }
}

/// A run of twelve steps with everything that a resume could lose: batch normalisation, all
/// augmentations, a weight average, Muon, two batches per step. Logs and checkpoints are at
/// different steps.
pub fn config(dir: &Path) -> PathBuf {
    let text = format!(
        "[model]\nwidth = 2\nreading = \"released\"\n\
         [data]\nroot = {:?}\npatch_size = 64\nbatch_size = 2\nvalidation = 0.2\n\
         augment = [\"flip\", \"transpose\", \"rgb\", \"exposure\", \"axes\", \"crop\", \"noise\"]\n\
         [optimizer]\nkind = \"muon\"\nmuon_max_rows = 4\nlr_start = 1e-3\nmax_grad_norm = 1.0\n\
         [train]\nsteps = 12\nema_decay = 0.9\ngrad_accumulation = 2\n\
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
    command.args([Path::new("--config"), config, Path::new("--run-dir"), run]);
    command.args(args);
    command
}

/// Runs `demc-train` to its end.
pub fn train(config: &Path, run: &Path, args: &[&str]) -> Output {
    command(config, run, args)
        .output()
        .expect("the binary runs")
}

/// Runs `demc-train`, which must succeed.
pub fn trained(config: &Path, run: &Path, args: &[&str]) -> Output {
    let output = train(config, run, args);
    assert!(output.status.success(), "{}", stderr(&output));
    output
}

/// A temporary directory, a [`config`] in it, and the path of a run.
pub fn place() -> (tempfile::TempDir, PathBuf, PathBuf) {
    let dir = tempfile::tempdir().expect("a temporary directory");
    let (config, run) = (config(dir.path()), dir.path().join("run"));
    (dir, config, run)
}

/// Standard error as text.
pub fn stderr(output: &Output) -> String {
    String::from_utf8_lossy(&output.stderr).into_owned()
}

/// Checks the exit code of a failure; returns its only line.
pub fn error_line(output: &Output, code: i32) -> String {
    let text = stderr(output);
    assert_eq!(output.status.code(), Some(code), "{text}");
    assert_eq!(text.lines().count(), 1, "one line: {text}");
    assert!(text.starts_with("error: "), "{text}");
    text
}

/// Fails unless `text` contains `words`.
pub fn says(text: &str, words: &str) {
    assert!(text.contains(words), "{words}: {text}");
}

/// `metrics.jsonl` without the values that depend on the clock.
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

/// The files of a finished run of [`config`] that must not depend on interruptions.
pub const RESULTS: [&str; 5] = [
    "best.safetensors",
    "checkpoints/step-00000012/model.safetensors",
    "checkpoints/step-00000012/average.safetensors",
    "checkpoints/step-00000012/optimizer.safetensors",
    "test.json",
];

/// Fails unless two finished runs of [`config`] have equal results and logs.
pub fn assert_same_run(whole: &Path, other: &Path, what: &str) {
    assert_eq!(metrics(other), metrics(whole), "{what}");
    for file in RESULTS {
        let bytes = |run: &Path| std::fs::read(run.join(file)).expect(file);
        assert!(bytes(whole) == bytes(other), "{what}: {file} differs");
    }
}

/// Starts the run and kills it (SIGKILL) once its log has `lines` lines. Returns whether it was
/// still running.
pub fn kill_after(config: &Path, run: &Path, args: &[&str], lines: usize) -> bool {
    let mut child = command(config, run, args)
        .stdout(std::process::Stdio::null())
        .spawn()
        .expect("the binary runs");
    let started = std::time::Instant::now();
    while metrics(run).len() < lines {
        assert!(
            started.elapsed() < std::time::Duration::from_secs(300),
            "no progress"
        );
        if child.try_wait().expect("a child").is_some() {
            break;
        }
        std::thread::sleep(std::time::Duration::from_millis(1));
    }
    let killed = child.try_wait().expect("a child").is_none();
    let _ = child.kill();
    child.wait().expect("a child");
    killed
}

/// Waits until `done`, at most two minutes.
pub fn wait_until(mut done: impl FnMut() -> bool) {
    let started = std::time::Instant::now();
    while !done() {
        assert!(started.elapsed().as_secs() < 120, "no progress");
        std::thread::sleep(std::time::Duration::from_millis(5));
    }
}
