//! Opens bytes as the manifest of a data set with three images.
#![no_main]

use std::collections::{BTreeMap, BTreeSet};
use std::fs;
use std::path::PathBuf;
use std::sync::LazyLock;

use demc_data::{ChannelLayout, Dataset};
use demc_fuzz::{check_message, scratch};
use libfuzzer_sys::fuzz_target;
use serde_json::{Value, json};

const IMAGE: &[u8] = include_bytes!("../seeds/exr/none.exr");
/// Size of the image.
const SIZE: (usize, usize) = (6, 5);

/// `a.exr`, `b.exr`, `sub/c.exr`, and a link to the first.
static ROOT: LazyLock<PathBuf> = LazyLock::new(|| {
    let root = scratch();
    fs::create_dir_all(root.join("sub")).expect("writable");
    for name in ["a.exr", "b.exr", "sub/c.exr"] {
        fs::write(root.join(name), IMAGE).expect("writable");
    }
    let _ = fs::hard_link(root.join("a.exr"), root.join("link.exr"));
    root
});

static LAYOUT: LazyLock<ChannelLayout> =
    LazyLock::new(|| ChannelLayout::resolve("demc-exr").expect("a preset"));

fn write(bytes: &[u8]) {
    fs::write(ROOT.join("manifest.json"), bytes).expect("writable");
}

fuzz_target!(|bytes: &[u8]| {
    write(bytes);
    let name = ROOT.display().to_string();
    match Dataset::open(&ROOT, &LAYOUT) {
        Ok(set) => check(&set),
        Err(error) => check_message(&error, &name),
    }
    match Dataset::list(&ROOT) {
        Ok(scenes) => {
            let entries: Vec<Value> = scenes.iter().map(entry).collect();
            let text = json!({"format": "demc-exr 1", "scenes": entries}).to_string();
            write(text.as_bytes());
            assert_eq!(Dataset::list(&ROOT).expect("its own"), scenes);
        }
        Err(error) => check_message(&error, &name),
    }
});

/// What training relies on.
fn check(set: &Dataset) {
    assert!(!set.scenes.is_empty());
    let mut names = BTreeSet::new();
    let mut files = BTreeSet::new();
    let mut splits = BTreeMap::new();
    for scene in &set.scenes {
        assert_eq!((scene.width, scene.height), SIZE);
        assert!(names.insert(&scene.name));
        let file = fs::canonicalize(&scene.path).expect("it was checked");
        let file = if file.ends_with("link.exr") {
            ROOT.join("a.exr")
        } else {
            file
        };
        assert!(files.insert(file));
        assert_eq!(
            splits.entry(&scene.base).or_insert(scene.split),
            &scene.split
        );
    }
    for share in [0.0, 0.5, 0.99] {
        let Ok((train, validation)) = set.train_validation(share, 1) else {
            continue;
        };
        assert!(!train.is_empty());
        assert!(
            validation
                .iter()
                .all(|held| train.iter().all(|scene| scene.base != held.base))
        );
    }
}

/// The scene as an entry of a manifest.
fn entry(scene: &demc_data::Scene) -> Value {
    let mut keys = scene.other.clone();
    keys.insert("name".into(), json!(scene.name));
    keys.insert("split".into(), json!(scene.split));
    keys.insert("base".into(), json!(scene.base));
    keys.insert("file".into(), json!(scene.path));
    keys.insert("width".into(), json!(scene.width));
    keys.insert("height".into(), json!(scene.height));
    if let Some(residual) = scene.ref_residual_relmse {
        assert!(residual.is_finite());
        keys.insert("ref_residual_relmse".into(), json!(residual));
    }
    Value::Object(keys)
}
