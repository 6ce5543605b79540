//! Tests `index` as a user runs it.

use std::fs;
use std::path::Path;

use crate::cli_datasets::{Dir, refused};
use crate::support::program::stdout;
use crate::support::{sample, scene_channels, write};
use demc_data::{ChannelLayout, Dataset, Split};
use serde_json::json;

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
    let set = Dataset::open(&dir.path(""), &layout).expect("a data set");
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

/// Cycles' own channels beside files of this project's layout.
#[test]
fn index_lists_training_scenes_of_another_set_with_their_layout() {
    let dir = Dir::new();
    let renderers = Path::new(env!("CARGO_MANIFEST_DIR")).join("../tests/renderers/files");
    let file = |name: &str| renderers.join(name).display().to_string();
    fs::create_dir(dir.path("own")).expect("writable");
    let [noisy, reference] = ["cycles-5.0.exr", "cycles-reference.exr"].map(file);
    let reference = format!("ref={reference}");
    let merged = dir.text("own/shot.exr");
    let strip = ["--strip", "ViewLayer.Combined"];
    stdout(&[&["merge", "-o", &merged, &noisy, &reference], &strip[..]].concat());
    let sample = sample();
    let with = ["--with", sample.to_str().expect("UTF-8")];
    let own = dir.text("own");
    let text = stdout(&[&["index", &own], &with[..]].concat());
    assert!(
        text.contains("layout cycles; training scenes of --with: 10"),
        "{text}"
    );
    let layout = ChannelLayout::resolve("cycles").expect("a preset");
    let set = Dataset::open(&dir.path("own"), &layout).expect("a data set of two layouts");
    let own_layouts = set.scenes.iter().filter(|scene| scene.layout.is_some());
    assert_eq!((set.scenes.len(), own_layouts.count()), (11, 10));
    assert!(set.scenes.iter().all(|scene| scene.split == Split::Train));
    let text = stdout(&["stats", &own]);
    assert!(text.contains("11"), "{text}");
    stdout(&["doctor", &own, "--patch-size", "64"]);
    // Again: the entries are replaced, not repeated.
    let again = stdout(&[&["index", &own, "--overwrite"], &with[..]].concat());
    assert!(again.contains("training scenes of --with: 10"), "{again}");
    assert!(!again.contains("kept"), "{again}");
    let twice = [&["index", &own, "--overwrite"], &with[..], &with[..]].concat();
    refused(&twice, 1, "several scenes have the name");
}

#[test]
fn a_scene_with_an_unknown_layout_is_refused() {
    let dir = Dir::new();
    dir.scene("a.exr");
    let scene = json!({"name": "a", "split": "train", "base": "a", "file": "a.exr", "width": 4, "height": 2, "layout": "mine"});
    let manifest = json!({"format": "demc-exr 1", "scenes": [scene]});
    fs::write(dir.path("manifest.json"), manifest.to_string()).expect("writable");
    let expected = "scene a: layout \"mine\" is no preset";
    refused(&["stats", &dir.text("")], 1, expected);
}
