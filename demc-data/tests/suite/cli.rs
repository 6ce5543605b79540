//! Tests the commands as a user runs them: output, exit status, one line on standard error.

use std::fs;

use crate::support::program::{demc_data, refusal, stdout};
use crate::support::{ZIP, half, named, part, sample, write, write_parts};
use exr::prelude::FlatSamples;
use serde_json::Value;

#[test]
fn inspect_lists_every_channel_with_its_range() {
    let dir = tempfile::tempdir().expect("a temporary directory");
    let path = dir.path().join("odd.exr");
    let id = FlatSamples::U32(vec![1, 2, 3, 70_000]);
    let samples = [f32::NAN, 1.0, -2.0, 4.0];
    write(
        &path,
        (2, 2),
        named([
            ("R", half(samples)),
            ("id", id),
            ("Z", FlatSamples::F32(vec![f32::INFINITY; 4])),
        ]),
    );
    let path = path.to_str().expect("a readable path");
    let text = stdout(&["inspect", path]);
    let fields = |name: &str| -> Vec<&str> {
        let line = text
            .lines()
            .find(|line| line.trim_start().starts_with(name))
            .expect(name);
        line.split_whitespace().collect()
    };
    assert_eq!(
        fields("R"),
        ["R", "half", "2x2", "-2.00000", "4.00000", "1.00000", "1"]
    );
    assert_eq!(
        fields("id"),
        [
            "id",
            "uint",
            "2x2",
            "1.00000",
            "70000.00000",
            "17501.50000",
            "0"
        ]
    );
    assert_eq!(fields("Z"), ["Z", "float", "2x2", "-", "-", "-", "4"]);

    let json: Value = serde_json::from_str(&stdout(&["inspect", "--json", path])).expect("JSON");
    assert_eq!(json[0]["channels"][0]["name"], "R");
    assert_eq!(json[0]["channels"][0]["range"]["min"], -2.0);
    assert_eq!(json[0]["channels"][1]["non_finite"], 4);
    assert_eq!(json[0]["channels"][2]["type"], "uint");
}

#[test]
fn inspect_names_layers_and_their_sizes() {
    let dir = tempfile::tempdir().expect("a temporary directory");
    let path = dir.path().join("layers.exr");
    let small = part(Some("proxy"), (1, 1), ZIP, named([("R", half([1.0]))]));
    let large = part(Some("beauty"), (2, 1), ZIP, named([("R", half([1.0; 2]))]));
    write_parts(&path, (2, 1), vec![large, small]);
    let text = stdout(&["inspect", path.to_str().expect("a readable path")]);
    assert!(text.contains("2 channels, layers beauty, proxy"), "{text}");
    assert!(
        text.contains("beauty.R  half   2x1") && text.contains("proxy.R   half   1x1"),
        "{text}"
    );
}

#[test]
fn inspect_reads_the_sample() {
    let path = sample().join("test/col-classroom-1.exr");
    let text = stdout(&["inspect", path.to_str().expect("a readable path")]);
    assert!(
        text.lines()
            .next()
            .is_some_and(|line| line.ends_with("19 channels")),
        "no layers: {text}"
    );
    assert_eq!(text.lines().count(), 2 + 19, "{text}");
}

#[test]
fn stats_of_the_sample_in_words_and_in_json() {
    let root = sample();
    let root = root.to_str().expect("a readable path");
    let text = stdout(&["stats", root]);
    assert!(
        text.contains(
            "train  10 scenes (10 of 224x224) of 10 base scenes; 90 patches of 128x128 at stride 80"
        ),
        "{text}"
    );
    assert!(text.contains("test   4 scenes (4 of 256x256)"), "{text}");
    assert!(text.contains("texture2.b"), "{text}");
    let json: Value =
        serde_json::from_str(&stdout(&["stats", root, "--json", "--split", "test"])).expect("JSON");
    assert_eq!(
        (&json["split"], &json["pixels"]),
        (&Value::from("test"), &Value::from(4 * 256 * 256))
    );
    assert_eq!(json["features"].as_array().map(Vec::len), Some(12));
    assert_eq!(json["splits"]["train"]["patches"], 90);
}

#[test]
fn bad_files_end_with_status_1_and_one_line() {
    let dir = tempfile::tempdir().expect("a temporary directory");
    let path = dir.path().join("a.exr");
    let path = path.to_str().expect("a readable path");
    let message = refusal(&["inspect", path], 1);
    assert_eq!(message.lines().count(), 1, "{message}");
    assert!(
        message.starts_with(&format!("error: cannot read {path}: No such file")),
        "{message}"
    );
    fs::write(path, "text").expect("writable");
    assert!(refusal(&["inspect", path], 1).contains("not a readable OpenEXR file"));
    let root = dir.path().to_str().expect("a readable path");
    assert!(refusal(&["stats", root], 1).contains("manifest.json: No such file"));
    let message = refusal(&["stats", root, "--layout", "maya"], 1);
    assert!(
        message.contains("channel layout maya: neither a preset"),
        "{message}"
    );
}

#[test]
fn inspect_reports_a_bad_file_and_continues() {
    let dir = tempfile::tempdir().expect("a temporary directory");
    let (bad, good) = (dir.path().join("bad.exr"), dir.path().join("good.exr"));
    fs::write(&bad, "text").expect("writable");
    write(&good, (1, 1), named([("R", half([1.0]))]));
    let [bad, good] = [&bad, &good].map(|path| path.to_str().expect("a readable path"));
    for options in [vec!["inspect"], vec!["inspect", "--json"]] {
        let args = [options, vec![bad, good]].concat();
        let message = refusal(&args, 1);
        assert_eq!(message.lines().count(), 1, "{message}");
        assert!(message.contains("bad.exr: not a readable"), "{message}");
        let shown = String::from_utf8(demc_data(&args).stdout).expect("text");
        assert!(shown.contains("good.exr"), "{shown}");
        assert!(!shown.contains("bad.exr"), "{shown}");
    }
}

#[test]
fn wrong_arguments_end_with_status_2() {
    refusal(&["inspect"], 2);
    refusal(&["stats", "x", "--split", "valid"], 2);
    refusal(&["paint"], 2);
}
