//! A run that was killed and resumed equals an uninterrupted one, byte for byte.

use std::fs;
use std::path::Path;

use crate::common::{
    assert_same_run, config, copy_sample, error_line, kill_after, metrics, place, says, stderr,
    train, trained,
};

#[test]
fn a_killed_and_resumed_run_equals_an_uninterrupted_one() {
    let dir = tempfile::tempdir().expect("a temporary directory");
    let config = config(dir.path());
    let (whole, broken) = (dir.path().join("whole"), dir.path().join("broken"));

    trained(&config, &whole, &[]);
    assert_eq!(metrics(&whole).len(), 6);

    // Before the first checkpoint, between two checkpoints, and after a validation.
    assert!(kill_after(&config, &broken, &[], 1));
    assert!(kill_after(&config, &broken, &["--resume"], 2));
    assert!(kill_after(&config, &broken, &["--resume"], 4));
    trained(&config, &broken, &["--resume"]);

    assert_same_run(&whole, &broken, "killed three times");
    let kept = fs::read_dir(broken.join("checkpoints"))
        .expect("checkpoints")
        .count();
    assert_eq!(kept, 2, "run.keep = 2");
}

#[test]
fn the_saved_configuration_repeats_the_run() {
    let dir = tempfile::tempdir().expect("a temporary directory");
    let config = config(dir.path());
    let (first, second) = (dir.path().join("first"), dir.path().join("second"));
    trained(&config, &first, &["--set=train.steps=4"]);
    trained(&first.join("config.toml"), &second, &[]);
    assert_eq!(metrics(&first), metrics(&second));
}

#[test]
fn a_directory_with_another_run_is_refused() {
    let (_dir, config, run) = place();
    trained(&config, &run, &["--set=train.steps=3"]);
    let before = fs::read(run.join("metrics.jsonl")).expect("a log");

    let error = error_line(&train(&config, &run, &["--set=train.steps=3"]), 1);
    assert!(error.contains("--resume resumes it"), "{error}");
    let error = error_line(
        &train(&config, &run, &["--resume", "--set=train.seed=2"]),
        1,
    );
    assert!(
        error.contains("train.seed: 2 instead of 1") && error.contains("train.steps"),
        "{error}"
    );
    assert_eq!(
        fs::read(run.join("metrics.jsonl")).expect("a log"),
        before,
        "nothing is lost"
    );
}

#[test]
fn a_file_that_belongs_to_no_run_is_kept() {
    let (_dir, config, run) = place();
    for name in ["best.safetensors", "test.json", "strips/step-00000009.png"] {
        let path = run.join(name);
        fs::create_dir_all(path.parent().expect("a directory")).expect("a directory");
        fs::write(&path, "mine").expect("written");
        let error = error_line(&train(&config, &run, &["--set=train.steps=1"]), 2);
        assert!(
            error.contains(&format!("{name}: belongs to no run")),
            "{error}"
        );
        assert_eq!(fs::read(&path).expect("kept"), b"mine");
        fs::remove_file(&path).expect("removed");
    }
    trained(&config, &run, &["--set=train.steps=1"]);
}

#[test]
fn a_resume_keeps_files_of_another_program() {
    let (_dir, config, run) = place();
    fs::create_dir_all(&run).expect("a directory");
    let theirs = [
        ("metrics.jsonl", "{\"loss\": 1}\n"),
        ("config.toml", "title = \"x\"\n"),
    ];
    for count in [1, 2] {
        for (name, text) in &theirs[..count] {
            fs::write(run.join(name), text).expect("written");
        }
        let error = error_line(&train(&config, &run, &["--resume"]), 1);
        assert!(
            error.contains("but no configuration, record, or checkpoint"),
            "{error}"
        );
        for (name, text) in &theirs[..count] {
            assert_eq!(fs::read_to_string(run.join(name)).expect("kept"), *text);
        }
    }
}

#[test]
fn other_patches_per_epoch_are_refused() {
    let (dir, config, run) = place();
    let data = dir.path().join("data");
    copy_sample(&data);
    let set = format!("--set=data.root={}", data.display());
    let args = [set.as_str(), "--set=run.checkpoint_every=1"];
    assert!(kill_after(&config, &run, &args, 1));
    let manifest = data.join("manifest.json");
    let text = fs::read_to_string(&manifest).expect("a manifest");
    // Of all scenes, because some are held out.
    let split = "\"split\": \"train\"";
    let repeated = text.replace(split, &format!("{split}, \"repeat\": 3"));
    assert_ne!(repeated, text);
    fs::write(&manifest, repeated).expect("written");
    let error = error_line(
        &train(&config, &run, &[&args[..], &["--resume"]].concat()),
        1,
    );
    assert!(error.contains("patches per epoch instead of"), "{error}");
}

#[test]
fn missing_and_damaged_files_cost_at_most_one_checkpoint() {
    let dir = tempfile::tempdir().expect("a temporary directory");
    let config = config(dir.path());
    let (whole, run) = (dir.path().join("whole"), dir.path().join("run"));
    trained(&config, &whole, &[]);
    let expected = |file: &str| fs::read(whole.join(file)).expect(file);
    let last = "checkpoints/step-00000012";
    let before = "checkpoints/step-00000009";

    trained(&config, &run, &[]);
    let half = |path: &Path| {
        let bytes = fs::read(path).expect("a file");
        fs::write(path, &bytes[..bytes.len() / 2]).expect("a file");
    };
    let remove = |path: &Path| {
        if path.is_dir() {
            fs::remove_dir_all(path).expect("a directory")
        } else {
            fs::remove_file(path).expect("a file")
        }
    };
    let model = format!("{last}/model.safetensors");
    let optimizer = format!("{last}/optimizer.safetensors");
    let state = format!("{last}/state.json");
    let sums = format!("{last}/SHA256SUMS");
    type Harm<'a> = &'a dyn Fn(&Path);
    let harms: [(&str, Harm, &str); 12] = [
        (&model, &half, "model.safetensors: damaged"),
        (&optimizer, &half, "optimizer.safetensors: damaged"),
        (&state, &half, "state.json: damaged"),
        (&state, &remove, "state.json: No such file"),
        (&sums, &remove, "SHA256SUMS: No such file"),
        (
            last,
            &remove,
            "names the missing checkpoint `step-00000012`",
        ),
        ("latest", &remove, "latest: No such file"),
        ("config.toml", &remove, "config.toml was missing"),
        ("run.json", &remove, "run.json was missing"),
        ("best.safetensors", &remove, "best.safetensors was missing"),
        ("best.safetensors", &half, ""),
        ("metrics.jsonl", &remove, "metrics.jsonl was missing"),
    ];
    for (file, harm, words) in harms {
        harm(&run.join(file));
        let output = train(&config, &run, &["--resume"]);
        assert!(output.status.success(), "{file}: {}", stderr(&output));
        let text = String::from_utf8_lossy(&output.stdout);
        assert!(text.contains(words), "{file}: {words}: {text}");
        for file in [&*model, &*optimizer, "best.safetensors", "test.json"] {
            let same = fs::read(run.join(file)).expect(file) == expected(file);
            assert!(same, "{file} differs after {words}");
        }
    }
    assert!(metrics(&run).is_empty(), "the log is not invented");

    half(&run.join(&model));
    half(&run.join(before).join("state.json"));
    let error = error_line(&train(&config, &run, &["--resume"]), 1);
    assert!(
        error.contains("no intact checkpoint")
            && error.contains("step-00000012/model.safetensors")
            && error.contains("step-00000009/state.json"),
        "{error}"
    );
}

#[test]
fn checkpoints_of_another_format_are_refused() {
    let (_dir, config, run) = place();
    let set = ["--set=train.steps=3"];
    trained(&config, &run, &set);
    let checkpoint = run.join("checkpoints/step-00000003");
    let state = checkpoint.join("state.json");
    let text = fs::read_to_string(&state).expect("a state");
    fs::write(&state, text.replace("\"format\": 2", "\"format\": 99")).expect("a state");
    // As a later version would have written it.
    let files = fs::read_dir(&checkpoint).expect("a checkpoint");
    let files = files.map(|file| file.expect("a file").file_name());
    let sums = std::process::Command::new("sha256sum")
        .current_dir(&checkpoint)
        .args(files.filter(|name| name != "SHA256SUMS"))
        .output()
        .expect("sha256sum");
    fs::write(checkpoint.join("SHA256SUMS"), sums.stdout).expect("sums");
    let error = error_line(&train(&config, &run, &["--resume", set[0]]), 1);
    says(&error, "state.json: format 99; this build reads format 2");
}

#[test]
fn checksums_are_those_of_sha256sum() {
    let dir = tempfile::tempdir().expect("a temporary directory");
    let run = dir.path().join("run");
    let set = ["--set=train.steps=4"];
    trained(&config(dir.path()), &run, &set);
    let output = std::process::Command::new("sha256sum")
        .current_dir(run.join("checkpoints/step-00000004"))
        .args(["--strict", "-c", "SHA256SUMS"])
        .output()
        .expect("sha256sum");
    let text = String::from_utf8_lossy(&output.stdout);
    assert!(output.status.success(), "{text}");
    for file in ["model", "average", "optimizer", "best"] {
        assert!(text.contains(&format!("{file}.safetensors: OK")), "{text}");
    }
}

#[test]
fn a_changed_layout_and_a_locked_directory_are_refused() {
    let (dir, config, run) = place();
    let layout = dir.path().join("mine.toml");
    let preset = concat!(
        env!("CARGO_MANIFEST_DIR"),
        "/../configs/renderers/demc-exr.toml"
    );
    fs::copy(preset, &layout).expect("a preset");
    let layout_key = format!("data.layout={}", layout.display());
    let args = ["--set=train.steps=3", "--set", &layout_key];
    let resume = [&args[..], &["--resume"]].concat();
    trained(&config, &run, &args);
    assert!(
        run.join("layout.toml").is_file(),
        "the run has a copy of the layout"
    );

    let text = fs::read_to_string(&layout).expect("a layout");
    let swapped = text.replace(r#"["R", "G", "B"]"#, r#"["B", "G", "R"]"#);
    assert_ne!(swapped, text);
    fs::write(&layout, swapped).expect("a layout");
    let error = error_line(&train(&config, &run, &resume), 1);
    says(
        &error,
        "network, layout or statistics of the checkpoint differ",
    );
    let kept = fs::read_to_string(run.join("layout.toml")).expect("the run's layout");
    assert!(
        !kept.contains(r#"["B", "G", "R"]"#),
        "a refusal overwrites nothing: {kept}"
    );
    fs::write(&layout, text).expect("a layout");

    let lock = fs::File::create(run.join("lock")).expect("a lock");
    lock.try_lock().expect("nobody trains");
    let error = error_line(&train(&config, &run, &resume), 1);
    assert!(error.contains("another training process"), "{error}");
    drop(lock);
}
