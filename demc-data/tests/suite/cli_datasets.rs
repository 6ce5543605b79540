//! Tests `merge`, `index`, and `doctor` as a user runs them.

use std::fs;
use std::path::{Path, PathBuf};

use crate::support::program::{demc_data, refusal, stdout};
use crate::support::{half, named, sample, scene_channels, write};
use demc_data::{ChannelLayout, Dataset, Split};
use serde_json::{Value, json};

struct Dir(tempfile::TempDir);

impl Dir {
    fn new() -> Self {
        Self(tempfile::tempdir().expect("a temporary directory"))
    }

    fn path(&self, name: &str) -> PathBuf {
        self.0.path().join(name)
    }

    fn text(&self, name: &str) -> String {
        let path = self.path(name);
        path.to_str().expect("a readable path").to_owned()
    }

    /// A scene of 4x2 pixels with all channels.
    fn scene(&self, name: &str) {
        let path = self.path(name);
        let parent = path.parent().expect("a directory");
        fs::create_dir_all(parent).expect("writable");
        write(&path, (4, 2), scene_channels(4, 2));
    }

    fn rgb(&self, name: &str, size: (usize, usize)) -> String {
        let plane = || half(vec![0.5; size.0 * size.1]);
        let channels = named([("R", plane()), ("G", plane()), ("B", plane())]);
        write(&self.path(name), size, channels);
        self.text(name)
    }

    fn manifest(&self) -> Value {
        let text = fs::read_to_string(self.path("manifest.json")).expect("a manifest");
        serde_json::from_str(&text).expect("JSON")
    }
}

/// Runs the program and checks the exit status and that one error line has `part`.
fn refused(args: &[&str], status: i32, part: &str) {
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
fn index_finds_scenes_splits_and_bases() {
    let dir = Dir::new();
    for name in [
        "a/kitchen-0.exr",
        "a/kitchen.0012.exr",
        "b/bath_1.EXR",
        "b/0001.exr",
    ] {
        dir.scene(name);
    }
    fs::write(dir.path("notes.txt"), "text").expect("writable");
    fs::write(dir.path(".hidden.exr"), "text").expect("writable");
    let root = dir.text("");
    let text = stdout(&["index", &root, "--test", "b/*"]);
    let expected = "4 scenes (2 train, 2 test) of 3 base scenes, layout demc-exr; \
                    other files and links, ignored: 2";
    assert!(text.contains(expected), "{text}");
    let layout = ChannelLayout::resolve("demc-exr").expect("a preset");
    let set = Dataset::open(dir.0.path(), &layout).expect("a data set");
    let rows: Vec<_> = set
        .scenes
        .iter()
        .map(|scene| {
            (
                scene.name.as_str(),
                scene.base.as_str(),
                scene.split,
                scene.width,
            )
        })
        .collect();
    assert_eq!(
        rows,
        [
            ("kitchen-0", "kitchen", Split::Train, 4),
            ("kitchen.0012", "kitchen", Split::Train, 4),
            ("0001", "b", Split::Test, 4),
            ("bath_1", "bath", Split::Test, 4),
        ]
    );
    let root = root.as_str();
    refused(&["index", root], 2, "manifest.json exists; --overwrite");
    stdout(&[
        "index",
        root,
        "--overwrite",
        "--base",
        "^([^/]+)/",
        "--test",
        "bath*",
        "--test",
        "0*",
    ]);
    assert_eq!(dir.manifest()["scenes"][0]["base"], "a");
}

#[test]
fn index_keeps_the_keys_that_it_does_not_set() {
    let dir = Dir::new();
    dir.scene("a.exr");
    dir.scene("x/a.exr");
    let old = json!({
        "format": "demc-exr 1",
        "renderer": "mine",
        "scenes": [
            {"name": "old", "split": "test", "base": "old", "file": "a.exr", "width": 1,
             "height": 1, "licences": ["CC0"]},
            {"name": "gone", "file": "gone.exr"}
        ]
    });
    fs::write(dir.path("manifest.json"), old.to_string()).expect("writable");
    let text = stdout(&["index", &dir.text(""), "--overwrite"]);
    assert!(text.contains("without a file, dropped: 1"), "{text}");
    let manifest = dir.manifest();
    assert_eq!(manifest["renderer"], "mine");
    let scene = &manifest["scenes"][0];
    assert_eq!(
        (&scene["width"], &scene["split"], &scene["base"]),
        (&json!(4), &json!("test"), &json!("old"))
    );
    assert_eq!(scene["licences"], json!(["CC0"]));
    let other = &manifest["scenes"][1];
    assert_eq!(
        (&other["name"], &other["split"]),
        (&json!("x-a"), &json!("train"))
    );
    // The rules replace what was kept.
    let rules = ["--test", "x/*", "--base", "^(.*)$"];
    stdout(&[&["index", &dir.text(""), "--overwrite"], &rules[..]].concat());
    let scenes = &dir.manifest()["scenes"];
    assert_eq!(
        [&scenes[0]["split"], &scenes[1]["split"]],
        [&json!("train"), &json!("test")]
    );
    assert_eq!(scenes[0]["base"], "a");
}

#[test]
fn index_keeps_entries_of_other_directories_and_of_other_spellings() {
    let dir = Dir::new();
    dir.scene("set/a.exr");
    dir.scene("set/b.exr");
    dir.scene("other/c.exr");
    let absolute = dir.path("set/b.exr");
    let scene = |name: &str, file: &Path| json!({"name": name, "split": "test", "base": name, "file": file, "width": 4, "height": 3});
    let scenes = [
        scene("a", Path::new("./a.exr")),
        scene("b", &absolute),
        scene("c", Path::new("../other/c.exr")),
        scene("gone", Path::new("../other/gone.exr")),
    ];
    let old = json!({"format": "demc-exr 1", "scenes": scenes});
    fs::write(dir.path("set/manifest.json"), old.to_string()).expect("writable");
    let text = stdout(&["index", &dir.text("set"), "--overwrite"]);
    assert!(text.contains("in other directories, kept: 1"), "{text}");
    assert!(text.contains("without a file, dropped: 1"), "{text}");
    let text = fs::read_to_string(dir.path("set/manifest.json")).expect("a manifest");
    let manifest: serde_json::Value = serde_json::from_str(&text).expect("JSON");
    let found = manifest["scenes"].as_array().expect("scenes");
    let shown = found.iter().map(|scene| [&scene["file"], &scene["split"]]);
    let expected = ["a.exr", "b.exr", "../other/c.exr"].map(|file| [json!(file), json!("test")]);
    assert!(
        shown.eq(expected.iter().map(|[file, split]| [file, split])),
        "{text}"
    );
}

#[test]
#[cfg(unix)]
fn index_refuses_broken_links_and_one_file_under_two_names() {
    let dir = Dir::new();
    dir.scene("a.exr");
    std::os::unix::fs::symlink(dir.path("nothing.exr"), dir.path("b.exr")).expect("a link");
    refused(&["index", &dir.text("")], 1, "b.exr");
    fs::remove_file(dir.path("b.exr")).expect("removed");
    std::os::unix::fs::symlink(dir.path("a.exr"), dir.path("c.exr")).expect("a link");
    let same = "a.exr and c.exr are the same file; remove one";
    refused(&["index", &dir.text("")], 1, same);
}

#[test]
fn index_refuses_unusable_sets_and_writes_nothing() {
    let dir = Dir::new();
    let root = dir.text("");
    refused(&["index", &root], 1, "no EXR files");
    dir.scene("kitchen-0.exr");
    dir.scene("kitchen-1.exr");
    let leak = ["index", &root, "--test", "*-1.exr"];
    refused(&leak, 1, "base scene kitchen would be in both splits");
    refused(
        &["index", &root, "--test", "bath*"],
        1,
        "--test bath* matches no file",
    );
    refused(&["index", &root, "--test", "[*"], 2, "--test [*");
    refused(
        &["index", &root, "--base", "kitchen"],
        2,
        "0 groups, expected 1",
    );
    refused(
        &["index", &root, "--base", "(x)"],
        1,
        "finds no base scene in kitchen-0",
    );
    dir.rgb("plain.exr", (4, 2));
    refused(&["index", &root], 1, "no preset fits");
    refused(&["index", &root, "--layout", "fbksd"], 1, "COLOR_R");

    let channels = scene_channels(4, 2)
        .into_iter()
        .filter(|(name, _)| !name.starts_with("ref"))
        .collect();
    write(&dir.path("plain.exr"), (4, 2), channels);
    refused(
        &["index", &root],
        1,
        "plain.exr: no channel ref.R, ref.G, ref.B",
    );
    fs::write(dir.path("plain.exr"), "text").expect("writable");
    refused(
        &["index", &root],
        1,
        "plain.exr: not a readable OpenEXR file",
    );
    assert!(!dir.path("manifest.json").exists());
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
