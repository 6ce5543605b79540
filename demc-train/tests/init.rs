//! Runs that begin with the weights of another: `train.init`.

mod common;

use std::fs;
use std::path::{Path, PathBuf};

use burn::tensor::Device;
use common::{config, error_line, stderr, train};
use demc_infer::Bundle;
use demc_infer::bundle::{Names, Precision};
use demc_train::checkpoint::sha256_of;

/// The weights that a run is known by, in the order of their names, but for running statistics: those move whatever the
/// learning rate.
fn weights(run: &Path) -> Vec<(String, Vec<f32>)> {
    let bundle = Bundle::load(run, &Device::flex()).expect("a network");
    let weights = bundle.model.weights().into_iter();
    let learned = weights.filter(|weight| !weight.name.contains("running"));
    learned.map(|weight| (weight.name, weight.data)).collect()
}

/// Checks that both have the same weights, but for steps of a rate of 1e-30.
fn assert_same(ours: &Path, theirs: &Path) {
    for ((name, ours), (same, theirs)) in weights(ours).iter().zip(&weights(theirs)) {
        assert_eq!(name, same);
        let mut pairs = ours.iter().zip(theirs);
        assert!(pairs.all(|(a, b)| (a - b).abs() < 1e-29), "{name}");
    }
}

/// A run of two steps, and what one that begins with its weights is told.
struct Begun {
    config: PathBuf,
    /// `train.init=RUN`
    init: String,
    /// The directory of the other run, not there yet.
    second: PathBuf,
}

fn begun(dir: &Path) -> Begun {
    let config = config(dir);
    let first = dir.join("first");
    let output = train(&config, &first, &["--set", "train.steps=2"]);
    assert!(output.status.success(), "{}", stderr(&output));
    Begun {
        config,
        init: format!("train.init={}", first.display()),
        second: dir.join("second"),
    }
}

#[test]
fn a_run_begins_where_another_ended() {
    let dir = tempfile::tempdir().expect("a temporary directory");
    let config = config(dir.path());
    let at = |name: &str| dir.path().join(name);
    let (first, second, third) = (at("first"), at("second"), at("third"));
    let plain = ["--set", "train.ema=0"];
    let few = [&plain[..], &["--set", "train.steps=3"]].concat();
    let output = train(&config, &first, &few);
    assert!(output.status.success(), "{}", stderr(&output));

    // One step of a rate that rounds to none.
    let init = format!("train.init={}", first.display());
    let one = ["--set", "train.steps=1", "--set", "train.lr_start=1e-30"];
    let still = [
        &plain[..],
        &one,
        &["--set", "train.lr_end=1e-30", "--set", &init],
    ]
    .concat();
    let output = train(&config, &second, &still);
    assert!(output.status.success(), "{}", stderr(&output));
    assert_same(&first, &second);
    let record = fs::read(second.join("run.json")).expect("a record");
    let record: serde_json::Value = serde_json::from_slice(&record).expect("JSON");
    let began = Path::new(record["init"]["file"].as_str().expect("a file"));
    let sum = sha256_of(began).expect("a file");
    assert!(began.starts_with(&first) && record["init"]["step"] == 3);
    assert_eq!(record["init"]["sha256"], sum.as_str());

    // The other seed would draw another network; and what began needs the weights no more.
    let seeded = [&still[..], &["--set", "train.seed=2"]].concat();
    let output = train(&config, &third, &seeded);
    assert!(output.status.success(), "{}", stderr(&output));
    assert_same(&first, &third);
    fs::remove_dir_all(&first).expect("the test's own");
    let output = train(&config, &third, &[&seeded[..], &["--resume"]].concat());
    assert!(output.status.success(), "{}", stderr(&output));
}

/// What the weights had seen before belongs to what the network knows, after a resume too.
#[test]
fn ranges_of_the_scenes_before_are_kept() {
    let dir = tempfile::tempdir().expect("a temporary directory");
    let config = config(dir.path());
    let at = |name: &str| dir.path().join(name);
    let (first, wide, second) = (at("first"), at("wide.safetensors"), at("second"));
    let output = train(&config, &first, &["--set", "train.steps=2"]);
    assert!(output.status.success(), "{}", stderr(&output));
    let mut bundle = Bundle::load(&first, &Device::flex()).expect("a network");
    let own = bundle.meta.ranges.clone().expect("ranges");
    bundle.meta.ranges.as_mut().expect("ranges").exposure.high = 99.0;
    let saved = bundle.save(&wide, Names::Burn, Precision::F32);
    saved.expect("a file");

    let init = format!("train.init={}", wide.display());
    let again = ["--set", "train.steps=2", "--set", &init];
    let ranges_after = |more: &[&str]| {
        let output = train(&config, &second, &[&again[..], more].concat());
        assert!(output.status.success(), "{}", stderr(&output));
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

#[test]
fn weights_that_saw_another_colour_are_told() {
    let dir = tempfile::tempdir().expect("a temporary directory");
    let Begun {
        config,
        init,
        second,
    } = begun(dir.path());
    let note = |demodulate: &str| {
        let set = format!("data.demodulate={demodulate}");
        let output = train(
            &config,
            &second,
            &["--set", &init, "--set", &set, "--check"],
        );
        assert!(output.status.success(), "{}", stderr(&output));
        let said = String::from_utf8_lossy(&output.stdout).into_owned();
        let note = said
            .lines()
            .find(|line| line.starts_with("note: train.init"));
        note.expect("a note").to_string()
    };
    assert!(note("0").ends_with("step 2"));
    assert!(note("0.07").contains("step 2, of data.demodulate = 0: with 0.07 "));
}

#[test]
fn weights_that_do_not_fit_are_refused_before_anything_is_written() {
    let dir = tempfile::tempdir().expect("a temporary directory");
    let Begun {
        config,
        init,
        second,
    } = begun(dir.path());
    let wider = ["--set", &init, "--set", "model.width=3"];
    let line = error_line(&train(&config, &second, &wider), 1);
    assert!(line.contains("train.init"), "{line}");
    assert!(line.contains("model.width = 3, there 2"), "{line}");

    let nothing = ["--set", "train.init=nowhere.safetensors"];
    let line = error_line(&train(&config, &second, &nothing), 1);
    assert!(
        line.contains("train.init") && line.contains("nowhere.safetensors"),
        "{line}"
    );
    assert!(!second.exists());
}
