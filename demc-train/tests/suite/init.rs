//! Runs that start from the weights of another: `train.init`.

use std::collections::BTreeMap;
use std::fs;
use std::path::{Path, PathBuf};
use std::process::Command;

use crate::common::{
    RESULTS, assert_same_run, config, error_line, kill_after, metrics, train, trained,
};
use burn::tensor::Device;
use demc_infer::Bundle;
use demc_infer::bundle::{Names, Precision};
use demc_program::checksum::sha256_of;

/// The best weights of a run without running statistics, which change at any learning rate.
fn weights(run: &Path) -> Vec<(String, Vec<f32>)> {
    let bundle = Bundle::load(run, &Device::flex()).expect("a network");
    let weights = bundle.model.weights().into_iter();
    let learned = weights.filter(|weight| !weight.name.contains("running"));
    learned.map(|weight| (weight.name, weight.data)).collect()
}

/// Checks that both have the same weights, up to steps with a learning rate of 1e-30.
fn assert_same(ours: &Path, theirs: &Path) {
    for ((name, ours), (same, theirs)) in weights(ours).iter().zip(&weights(theirs)) {
        assert_eq!(name, same);
        let mut pairs = ours.iter().zip(theirs);
        assert!(pairs.all(|(a, b)| (a - b).abs() < 1e-29), "{name}");
    }
}

/// A run of two steps, and arguments for one that starts from its weights.
struct SecondRun {
    config: PathBuf,
    /// `train.init=RUN`
    init: String,
    /// The directory of the second run, which does not exist yet.
    second: PathBuf,
}

fn second_run(dir: &Path) -> SecondRun {
    let config = config(dir);
    let first = dir.join("first");
    trained(&config, &first, &["--set=train.steps=2"]);
    SecondRun {
        config,
        init: format!("train.init={}", first.display()),
        second: dir.join("second"),
    }
}

#[test]
fn a_run_starts_from_the_weights_of_another() {
    let dir = tempfile::tempdir().expect("a temporary directory");
    let config = config(dir.path());
    let path = |name: &str| dir.path().join(name);
    let (first, second, third) = (path("first"), path("second"), path("third"));
    let plain = ["--set=train.ema_decay="];
    let few = [&plain[..], &["--set=train.steps=3"]].concat();
    trained(&config, &first, &few);

    // One step with a rate that rounds to zero.
    let init = format!("train.init={}", first.display());
    let one = ["--set=train.steps=1", "--set=optimizer.lr_start=1e-30"];
    let still = [
        &plain[..],
        &one,
        &["--set=optimizer.lr_end=1e-30", "--set", &init],
    ]
    .concat();
    trained(&config, &second, &still);
    assert_same(&first, &second);
    let record = fs::read(second.join("run.json")).expect("a record");
    let record: serde_json::Value = serde_json::from_slice(&record).expect("JSON");
    let began = Path::new(record["init"]["file"].as_str().expect("a file"));
    let sum = sha256_of(began).expect("a file");
    assert!(began.starts_with(&first) && record["init"]["step"] == 3);
    assert_eq!(record["init"]["sha256"], sum.as_str());

    // Another seed would initialise another network. A resume does not need the initial weights.
    let seeded = [&still[..], &["--set=train.seed=2"]].concat();
    trained(&config, &third, &seeded);
    assert_same(&first, &third);
    fs::remove_dir_all(&first).expect("the test's own");
    trained(&config, &third, &[&seeded[..], &["--resume"]].concat());
}

/// The paper's second encoder beside a trained U-Net, which `trunk_rate = 0` keeps.
#[test]
fn a_network_grows_from_its_trunk() {
    let dir = tempfile::tempdir().expect("a temporary directory");
    let config = config(dir.path());
    let path = |name: &str| dir.path().join(name);
    let (trunk, grown) = (path("trunk"), path("grown"));
    let unet = [
        "--set=model.variant=unet",
        "--set=model.size=small",
        "--set=model.width=",
        "--set=model.reading=",
        "--set=data.transfer=pu",
        "--set=data.exposure_level=0.18",
        "--set=train.ema_decay=",
        "--set=train.steps=2",
    ];
    trained(&config, &trunk, &unet);
    let init = format!("--set=train.init={}", trunk.display());
    let more = [
        "--set=model.variant=unet-demc",
        "--set=model.width=4",
        "--set=optimizer.trunk_rate=0.0",
        &init,
    ];
    trained(&config, &grown, &[&unet[..], &more].concat());
    let own: BTreeMap<_, _> = weights(&trunk).into_iter().collect();
    let whole = weights(&grown);
    let kept = whole.iter().filter(|(name, _)| own.contains_key(name));
    assert_eq!(kept.clone().count(), own.len());
    for (name, values) in kept {
        assert_eq!(values, &own[name], "{name}");
    }
    // They start at 0.
    let biases = whole
        .iter()
        .filter(|(name, _)| name.starts_with("side.fuses.") && name.ends_with(".bias"));
    let mut biases = biases.flat_map(|(_, values)| values).peekable();
    assert!(biases.peek().is_some(), "a second encoder has fusions");
    let moved = biases.fold(0.0f32, |largest, bias| largest.max(bias.abs()));
    assert!(moved > 0.0 && moved < 0.1, "{moved}");
}

#[test]
fn ranges_of_the_first_run_are_kept() {
    let dir = tempfile::tempdir().expect("a temporary directory");
    let config = config(dir.path());
    let path = |name: &str| dir.path().join(name);
    let (first, wide, second) = (path("first"), path("wide.safetensors"), path("second"));
    trained(&config, &first, &["--set=train.steps=2"]);
    let mut bundle = Bundle::load(&first, &Device::flex()).expect("a network");
    let own = bundle.meta.ranges.clone().expect("ranges");
    bundle.meta.ranges.as_mut().expect("ranges").exposure.high = 99.0;
    let saved = bundle.save(&wide, Names::Burn, Precision::F32);
    saved.expect("a file");

    let init = format!("train.init={}", wide.display());
    let sets = ["--set=train.steps=2", "--set", &init];
    let ranges_after = |more: &[&str]| {
        trained(&config, &second, &[&sets[..], more].concat());
        let bundle = Bundle::load(&second, &Device::flex()).expect("a network");
        bundle.meta.ranges.expect("ranges")
    };
    let found = ranges_after(&[]);
    assert_eq!(found.exposure.high, 99.0);
    assert_eq!(
        (found.exposure.low, &found.mean),
        (own.exposure.low, &own.mean)
    );
    fs::remove_file(&wide).expect("the test's own");
    assert_eq!(ranges_after(&["--resume"]), found);
}

/// Every file of a run that starts from a model with an albedo filter contains the filter, and a
/// resumed run has the same bytes.
#[test]
fn the_albedo_filter_of_the_first_run_is_kept() {
    let dir = tempfile::tempdir().expect("a temporary directory");
    let config = config(dir.path());
    let path = |name: &str| dir.path().join(name);
    let (first, filtered) = (path("first"), path("filtered.safetensors"));
    trained(&config, &first, &["--set=train.steps=2"]);
    let mut bundle = Bundle::load(&first, &Device::flex()).expect("a network");
    let mut filter = bundle.clone();
    filter.meta.step = 77;
    bundle
        .set_albedo_filter(filter)
        .expect("the same positions");
    let saved = bundle.save(&filtered, Names::Burn, Precision::F32);
    saved.expect("a file");
    let filter = bundle.albedo_filter.as_ref().expect("a filter");

    let init = format!("train.init={}", filtered.display());
    let (whole, broken, plain) = (path("whole"), path("broken"), path("plain"));
    trained(&config, &whole, &["--set", &init]);
    for file in RESULTS.iter().filter(|file| file.ends_with(".safetensors")) {
        if file.ends_with("optimizer.safetensors") {
            continue;
        }
        let found = Bundle::load(&whole.join(file), &Device::flex())
            .expect(file)
            .albedo_filter
            .expect("a filter");
        assert_eq!(found.meta, filter.meta, "{file}");
        assert_eq!(found.model.weights(), filter.model.weights(), "{file}");
    }
    // Training and validation use it.
    let init_plain = format!("train.init={}", first.display());
    trained(&config, &plain, &["--set", &init_plain]);
    let validated = |run: &Path| metrics(run)[1]["valid_relmse"].clone();
    assert!(validated(&whole).is_number() && validated(&whole) != validated(&plain));
    let first_loss = |run: &Path| metrics(run)[0]["loss"].clone();
    assert!(first_loss(&whole).is_number() && first_loss(&whole) != first_loss(&plain));

    // So does find-lr.
    let swept = |init: &str| {
        let out = path("sweep");
        let sweep = Command::new(env!("CARGO_BIN_EXE_demc-train"))
            .args(["find-lr", "--steps", "10", "--set", init, "--config"])
            .args([&config, Path::new("--out"), &out])
            .arg("--overwrite")
            .output();
        assert!(sweep.expect("it starts").status.success());
        fs::read(out.with_extension("csv")).expect("a table")
    };
    assert_ne!(swept(&init), swept(&init_plain));
    assert_eq!(swept(&init), swept(&init));

    // The resumed run needs the initial file no more.
    assert!(kill_after(&config, &broken, &["--set", &init], 2));
    fs::remove_file(&filtered).expect("the test's own");
    trained(&config, &broken, &["--set", &init, "--resume"]);
    assert_same_run(&whole, &broken, "killed once");
}

#[test]
fn a_filter_with_other_positions_is_refused() {
    let dir = tempfile::tempdir().expect("a temporary directory");
    let SecondRun {
        config,
        init: _,
        second,
    } = second_run(dir.path());
    let mut bundle = Bundle::load(&dir.path().join("first"), &Device::flex()).expect("a network");
    bundle
        .set_albedo_filter(bundle.clone())
        .expect("the same positions");
    let filtered = dir.path().join("filtered.safetensors");
    let saved = bundle.save(&filtered, Names::Burn, Precision::F32);
    saved.expect("a file");
    let init = format!("train.init={}", filtered.display());
    let other = ["--set", &init, "--set=data.position=image"];
    let line = error_line(&train(&config, &second, &other), 1);
    assert!(line.contains("train the filter with \"image\""), "{line}");
    assert!(!second.exists());
}

#[test]
fn a_change_of_the_input_colour_is_noted() {
    let dir = tempfile::tempdir().expect("a temporary directory");
    let SecondRun {
        config,
        init,
        second,
    } = second_run(dir.path());
    let note = |epsilon: &str| {
        let set = format!("data.albedo_demodulation_epsilon={epsilon}");
        let output = trained(
            &config,
            &second,
            &["--set", &init, "--set", &set, "--check"],
        );
        let said = String::from_utf8_lossy(&output.stdout).into_owned();
        let note = said
            .lines()
            .find(|line| line.starts_with("note: train.init"));
        note.expect("a note").to_string()
    };
    assert!(note("").ends_with("step 2"));
    let changed = "step 2; data.albedo_demodulation_epsilon: 0.07 instead of absent";
    assert!(note("0.07").contains(changed));
}

#[test]
fn weights_of_another_network_are_refused_before_anything_is_written() {
    let dir = tempfile::tempdir().expect("a temporary directory");
    let SecondRun {
        config,
        init,
        second,
    } = second_run(dir.path());
    let wider = ["--set", &init, "--set=model.width=3"];
    let line = error_line(&train(&config, &second, &wider), 1);
    assert!(line.contains("train.init"), "{line}");
    assert!(line.contains("model.width: 3 instead of 2"), "{line}");

    let nothing = ["--set=train.init=nowhere.safetensors"];
    let line = error_line(&train(&config, &second, &nothing), 1);
    assert!(
        line.contains("train.init") && line.contains("nowhere.safetensors"),
        "{line}"
    );
    assert!(!second.exists());
}

/// `quality` and `fast` are the bundled models, whatever the current directory.
#[test]
fn a_bundled_model_starts_a_run() {
    let dir = tempfile::tempdir().expect("a temporary directory");
    let config = config(dir.path());
    for name in ["quality", "fast"] {
        let init = format!("--set=train.init={name}");
        let output = train(&config, &dir.path().join("run"), &[&init, "--check"]);
        let error = error_line(&output, 1);
        let start = format!("error: train.init: {name}: weights of another network");
        assert!(error.starts_with(&start), "{error}");
    }
}
