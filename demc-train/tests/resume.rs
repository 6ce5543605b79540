//! A run that was killed and resumed is the run that was not, byte for byte.

mod common;

use std::fs;
use std::path::Path;
use std::process::Stdio;
use std::time::{Duration, Instant};

use common::{command, config, error_line, stderr, train};

/// `metrics.jsonl` without `elapsed_s`, the one thing that depends on the clock.
fn metrics(run: &Path) -> Vec<serde_json::Value> {
    let text = fs::read_to_string(run.join("metrics.jsonl")).unwrap_or_default();
    let lines = text
        .lines()
        .filter_map(|line| serde_json::from_str::<serde_json::Value>(line).ok());
    lines
        .map(|mut line| {
            line.as_object_mut()
                .expect("an object")
                .remove("elapsed_s")
                .expect("a time");
            line
        })
        .collect()
}

/// Starts the run, kills it (SIGKILL) once its log has `lines` lines, and says whether it was still running.
fn kill_after(config: &Path, run: &Path, args: &[&str], lines: usize) -> bool {
    let mut child = command(config, run, args)
        .stdout(Stdio::null())
        .spawn()
        .expect("the binary runs");
    let started = Instant::now();
    while metrics(run).len() < lines {
        assert!(started.elapsed() < Duration::from_secs(300), "no progress");
        if child.try_wait().expect("a child").is_some() {
            break;
        }
        std::thread::sleep(Duration::from_millis(1));
    }
    let killed = child.try_wait().expect("a child").is_none();
    let _ = child.kill();
    child.wait().expect("a child");
    killed
}

#[test]
fn killed_and_resumed_equals_undisturbed() {
    let dir = tempfile::tempdir().expect("a temporary directory");
    let config = config(dir.path());
    let (whole, broken) = (dir.path().join("whole"), dir.path().join("broken"));

    let output = train(&config, &whole, &[]);
    assert!(output.status.success(), "{}", stderr(&output));
    assert_eq!(metrics(&whole).len(), 6);

    // Before the first checkpoint, between two, and after a validation.
    assert!(kill_after(&config, &broken, &[], 1));
    assert!(kill_after(&config, &broken, &["--resume"], 2));
    assert!(kill_after(&config, &broken, &["--resume"], 4));
    let output = train(&config, &broken, &["--resume"]);
    assert!(output.status.success(), "{}", stderr(&output));

    assert_eq!(metrics(&broken), metrics(&whole));
    for file in [
        "best.safetensors",
        "checkpoints/step-00000012/model.safetensors",
        "checkpoints/step-00000012/optimizer.safetensors",
        "test.json",
    ] {
        let bytes = |run: &Path| fs::read(run.join(file)).expect(file);
        assert!(bytes(&whole) == bytes(&broken), "{file} differs");
    }
    let kept = fs::read_dir(broken.join("checkpoints"))
        .expect("checkpoints")
        .count();
    assert_eq!(kept, 2, "run.keep = 2");
}

/// The run directory alone repeats the run: its configuration names everything.
#[test]
fn resolved_configuration_repeats_the_run() {
    let dir = tempfile::tempdir().expect("a temporary directory");
    let config = config(dir.path());
    let (first, second) = (dir.path().join("first"), dir.path().join("second"));
    assert!(
        train(&config, &first, &["--set", "train.steps=4"])
            .status
            .success()
    );
    let output = train(&first.join("config.toml"), &second, &[]);
    assert!(output.status.success(), "{}", stderr(&output));
    assert_eq!(metrics(&first), metrics(&second));
}

#[test]
fn run_directories_are_not_mixed_up() {
    let dir = tempfile::tempdir().expect("a temporary directory");
    let config = config(dir.path());
    let run = dir.path().join("run");
    assert!(
        train(&config, &run, &["--set", "train.steps=3"])
            .status
            .success()
    );
    let before = fs::read(run.join("metrics.jsonl")).expect("a log");

    let error = error_line(&train(&config, &run, &["--set", "train.steps=3"]), 1);
    assert!(error.contains("--resume continues it"), "{error}");
    let error = error_line(
        &train(&config, &run, &["--resume", "--set", "train.seed=2"]),
        1,
    );
    assert!(
        error.contains("train.seed = 2, there 1") && error.contains("train.steps"),
        "{error}"
    );
    assert_eq!(
        fs::read(run.join("metrics.jsonl")).expect("a log"),
        before,
        "nothing is lost"
    );
}

#[test]
fn damaged_checkpoints_are_refused_by_name() {
    let dir = tempfile::tempdir().expect("a temporary directory");
    let config = config(dir.path());
    let run = dir.path().join("run");
    let set = ["--set", "train.steps=3"];
    assert!(train(&config, &run, &set).status.success());
    let checkpoint = run.join("checkpoints/step-00000003");
    let refused = |file: &str, damage: &dyn Fn(Vec<u8>) -> Vec<u8>, words: &str| {
        let path = checkpoint.join(file);
        let good = fs::read(&path).expect(file);
        fs::write(&path, damage(good.clone())).expect(file);
        let error = error_line(&train(&config, &run, &["--resume", set[0], set[1]]), 1);
        assert!(error.contains(file) && error.contains(words), "{error}");
        fs::write(&path, good).expect(file);
    };
    let half = |bytes: Vec<u8>| bytes[..bytes.len() / 2].to_vec();
    refused("model.safetensors", &half, "");
    refused("optimizer.safetensors", &half, "");
    refused("state.json", &half, "");
    let other_version = |bytes: Vec<u8>| {
        String::from_utf8_lossy(&bytes)
            .replace("\"format\": 1", "\"format\": 99")
            .into_bytes()
    };
    refused(
        "state.json",
        &other_version,
        "format 99; this build reads format 1",
    );
    assert!(
        train(&config, &run, &["--resume", set[0], set[1]])
            .status
            .success()
    );
}

#[test]
fn what_a_run_lost_or_changed_is_named() {
    let dir = tempfile::tempdir().expect("a temporary directory");
    let config = config(dir.path());
    let run = dir.path().join("run");
    let layout = dir.path().join("mine.toml");
    let preset = concat!(
        env!("CARGO_MANIFEST_DIR"),
        "/../configs/renderers/demc-exr.toml"
    );
    fs::copy(preset, &layout).expect("a preset");
    let layout_key = format!("data.layout={}", layout.display());
    let args = ["--set", "train.steps=3", "--set", &layout_key];
    let resume = [&args[..], &["--resume"]].concat();
    let output = train(&config, &run, &args);
    assert!(output.status.success(), "{}", stderr(&output));
    assert!(
        run.join("layout.toml").is_file(),
        "the run holds its own layout"
    );

    let text = fs::read_to_string(&layout).expect("a layout");
    let swapped = text.replace(r#"["R", "G", "B"]"#, r#"["B", "G", "R"]"#);
    assert_ne!(swapped, text);
    fs::write(&layout, swapped).expect("a layout");
    let error = error_line(&train(&config, &run, &resume), 1);
    assert!(
        error.contains("another network, layout or statistics"),
        "{error}"
    );
    let kept = fs::read_to_string(run.join("layout.toml")).expect("the run's layout");
    assert!(
        !kept.contains(r#"["B", "G", "R"]"#),
        "a refusal overwrites nothing: {kept}"
    );
    fs::write(&layout, text).expect("a layout");

    fs::rename(run.join("latest"), dir.path().join("latest")).expect("a rename");
    let error = error_line(&train(&config, &run, &resume), 1);
    assert!(error.contains("latest: missing"), "{error}");
    fs::rename(dir.path().join("latest"), run.join("latest")).expect("a rename");

    let lock = fs::File::create(run.join("lock")).expect("a lock");
    lock.try_lock().expect("nobody trains");
    let error = error_line(&train(&config, &run, &resume), 1);
    assert!(error.contains("another process"), "{error}");
    drop(lock);

    fs::remove_file(run.join("config.toml")).expect("a file");
    let error = error_line(&train(&config, &run, &args), 1);
    assert!(error.contains("no config.toml"), "{error}");
}
