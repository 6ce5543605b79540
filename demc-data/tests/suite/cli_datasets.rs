//! Tests `merge` and `doctor` as a user runs them, with what the tests of `index` need too.

use std::fs;
use std::path::{Path, PathBuf};

use crate::support::program::{demc_data, refusal, stdout};
use crate::support::{half, named, sample, scene_channels, write};
use demc_data::ChannelLayout;
use serde_json::{Value, json};

/// A temporary directory.
pub struct Dir(tempfile::TempDir);

impl Dir {
    pub fn new() -> Self {
        Self(tempfile::tempdir().expect("a temporary directory"))
    }

    pub fn path(&self, name: &str) -> PathBuf {
        self.0.path().join(name)
    }

    pub fn text(&self, name: &str) -> String {
        let path = self.path(name);
        path.to_str().expect("a readable path").to_owned()
    }

    /// A scene of 4x2 pixels with all channels.
    pub fn scene(&self, name: &str) {
        let path = self.path(name);
        let parent = path.parent().expect("a directory");
        fs::create_dir_all(parent).expect("writable");
        write(&path, (4, 2), scene_channels(4, 2));
    }

    pub fn rgb(&self, name: &str, size: (usize, usize)) -> String {
        let plane = || half(vec![0.5; size.0 * size.1]);
        let channels = named([("R", plane()), ("G", plane()), ("B", plane())]);
        write(&self.path(name), size, channels);
        self.text(name)
    }

    pub fn manifest(&self) -> Value {
        let text = fs::read_to_string(self.path("manifest.json")).expect("a manifest");
        serde_json::from_str(&text).expect("JSON")
    }
}

/// Runs the program and checks the exit status and that one error line has `part`.
pub fn refused(args: &[&str], status: i32, part: &str) {
    let message = refusal(args, status);
    assert_eq!(message.lines().count(), 1, "{message}");
    assert!(message.contains(part), "{message}, not {part}");
}

#[test]
fn merge_joins_the_files_of_luxcore() {
    let dir = Dir::new();
    let [color, albedo, normal, position, reference] =
        ["out", "albedo", "normal", "p", "ref"].map(|name| dir.rgb(&format!("{name}.exr"), (4, 2)));
    let output = dir.text("scene.exr");
    let named = [
        format!("albedo={albedo}"),
        format!("normal={normal}"),
        format!("position={position}"),
        format!("ref={reference}"),
    ];
    let mut args = vec!["merge", "-o", &output, &color];
    args.extend(named.iter().map(String::as_str));
    let text = stdout(&args);
    assert!(
        text.contains("15 channels of 5 files: B, G, R, albedo.B"),
        "{text}"
    );
    let layout = ChannelLayout::resolve("luxcore").expect("a preset");
    let frame = demc_data::read_frame(Path::new(&output), &layout).expect("a frame");
    assert!(frame.reference.is_some());
}

#[test]
fn merge_strips_the_layer_of_a_blender_reference() {
    let dir = Dir::new();
    let files = sample().join("../../tests/renderers/files");
    let file = |name: &str| {
        files
            .join(name)
            .to_str()
            .expect("a readable path")
            .to_owned()
    };
    let (noisy, reference) = (file("cycles-5.0.exr"), file("cycles-reference.exr"));
    let output = dir.text("scene.exr");
    let reference = format!("ref={reference}");
    let strip = ["--strip", "ViewLayer.Combined"];
    let text = stdout(&[
        "merge", "-o", &output, &noisy, &reference, strip[0], strip[1],
    ]);
    assert!(
        text.contains("ViewLayer.Combined.R") && text.contains("ref.R"),
        "{text}"
    );
    let text = stdout(&["index", &dir.text("")]);
    assert!(text.contains("layout cycles"), "{text}");
    // The manifest's only scene is for training.
    let measured = stdout(&["stats", &dir.text("")]);
    assert!(measured.contains("texture1.r"), "{measured}");
    let other = [
        "merge",
        "-o",
        &output,
        "--overwrite",
        &noisy,
        &reference,
        "--strip",
        "Beauty",
    ];
    refused(&other, 2, "--strip Beauty: no channel");
}

#[test]
fn merge_refuses_what_would_lose_something() {
    let dir = Dir::new();
    let (a, b) = (dir.rgb("a.exr", (4, 2)), dir.rgb("b.exr", (2, 2)));
    let output = dir.text("out.exr");
    refused(
        &["merge", "-o", &output, &a, &a],
        1,
        "both give a channel B",
    );
    refused(
        &["merge", "-o", &output, &a, &format!("x={b}")],
        1,
        "covers 2x2",
    );
    refused(
        &["merge", "-o", &output, &a, "=x.exr"],
        2,
        "expected NAME=FILE",
    );
    refused(
        &["merge", "-o", &output, "none.exr"],
        1,
        "cannot read none.exr",
    );
    assert!(!dir.path("out.exr").exists());

    let before = fs::read(&a).expect("readable");
    let over = ["merge", "--overwrite", "-o", &a, &a];
    refused(&over, 2, "would replace the input");
    refused(
        &["merge", "-o", &b, &a],
        2,
        "b.exr exists; --overwrite replaces it",
    );
    assert_eq!(fs::read(&a).expect("readable"), before);
    stdout(&["merge", "--overwrite", "-o", &b, &a]);
    refusal(&["merge", "-o", &output], 2);
}

#[test]
fn doctor_finds_nothing_in_the_sample() {
    let root = sample();
    let root = root.to_str().expect("a readable path");
    assert_eq!(
        stdout(&["doctor", root]),
        "14 scenes with layout demc-exr: no problems.\n"
    );
    let json: Value = serde_json::from_str(&stdout(&["doctor", root, "--json"])).expect("JSON");
    assert_eq!(
        (&json["scenes"], &json["problems"]),
        (&json!(14), &json!([]))
    );
}

#[test]
fn doctor_lists_problems_in_lines_and_ends_with_status_1() {
    let root = sample();
    let root = root.to_str().expect("a readable path");
    let output = demc_data(&["doctor", root, "--patch-size", "256"]);
    assert_eq!(output.status.code(), Some(1));
    let text = String::from_utf8(output.stdout).expect("text");
    let lines: Vec<&str> = text.lines().collect();
    assert_eq!(lines.len(), 2, "{text}");
    assert!(
        lines[0].starts_with("images smaller than a patch of 256x256: ")
            && lines[0].contains("(224x224) and 6 more; "),
        "{text}"
    );
    assert_eq!(lines[1], "14 scenes with layout demc-exr: 1 problem.");
}

#[test]
fn doctor_without_a_manifest_names_the_command_that_writes_it() {
    let dir = Dir::new();
    let root = dir.text("");
    refused(
        &["doctor", &root],
        1,
        "has no manifest.json; run `demc-data index",
    );
    fs::write(
        dir.path("manifest.json"),
        r#"{"format": "demc-exr 1", "scenes": []}"#,
    )
    .expect("writable");
    refused(&["doctor", &root], 1, "lists no scenes");
    refused(&["doctor", &root, "--layout", "maya"], 1, "");
    for size in ["0", "7", "100", "8192"] {
        let output = demc_data(&["doctor", &root, "--patch-size", size]);
        assert_eq!(output.status.code(), Some(2), "{size}");
        let error = String::from_utf8_lossy(&output.stderr).into_owned();
        assert!(
            error.contains("expected a multiple of 32 from 32 to 4096"),
            "{error}"
        );
    }
}

#[test]
fn names_from_files_are_printed_without_control_characters() {
    let dir = Dir::new();
    let scene = json!({"name": "a\u{1b}[2J\nb", "split": "train", "base": "x", "file": "gone.exr",
                       "width": 4, "height": 2});
    let manifest = json!({"format": "demc-exr 1", "scenes": [scene]});
    fs::write(dir.path("manifest.json"), manifest.to_string()).expect("writable");
    let output = demc_data(&["doctor", &dir.text("")]);
    let text = String::from_utf8(output.stdout).expect("text");
    assert_eq!(text.lines().count(), 2, "{text:?}");
    assert!(!text.contains('\u{1b}'), "{text:?}");
    assert!(
        text.starts_with("files are missing: a\\u{1b}[2J\\nb ("),
        "{text:?}"
    );
}
