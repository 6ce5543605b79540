//! Manifests, splits and statistics, on the sample and on defective data sets.

use std::collections::HashSet;
use std::fs;
use std::path::Path;

use crate::support::{half, layout, sample, scene_channels, write};
use demc_data::input::transform::STD_FLOOR;
use demc_data::{ChannelLayout, DataConfig, Dataset, Error, Scene, Split, Statistics, read_frame};
use serde_json::{Value, json};

fn entry(name: &str, split: &str, base: &str) -> Value {
    let file = format!("{name}.exr");
    json!({ "name": name, "split": split, "base": base, "file": file, "width": 8, "height": 6 })
}

/// A data set of 8x6 scenes. `gone.exr` is missing.
fn dataset(root: &Path, scenes: Vec<Value>) -> Result<Dataset, Error> {
    let files = scenes.iter().filter_map(|scene| scene["file"].as_str());
    for file in files.filter(|file| *file != "gone.exr") {
        write(&root.join(file), (8, 6), scene_channels(8, 6));
    }
    let manifest = json!({ "format": "demc-exr 1", "scenes": scenes, "renderer": "kept" });
    fs::write(root.join("manifest.json"), manifest.to_string()).expect("writable");
    Dataset::open(root, &layout())
}

fn refusal(scenes: Vec<Value>) -> String {
    let dir = tempfile::tempdir().expect("a temporary directory");
    let message = dataset(dir.path(), scenes)
        .expect_err("it must be refused")
        .to_string();
    assert!(
        message.contains(&dir.path().display().to_string()) && !message.contains('\n'),
        "{message}"
    );
    message
}

fn names(scenes: &[Scene]) -> Vec<&str> {
    scenes.iter().map(|scene| scene.name.as_str()).collect()
}

fn bases(scenes: &[Scene]) -> HashSet<&str> {
    scenes.iter().map(|scene| scene.base.as_str()).collect()
}

#[test]
fn the_sample_opens_with_its_credits() {
    let dataset = Dataset::open(&sample(), &layout()).expect("the sample is sound");
    assert_eq!(dataset.split(Split::Train).expect("scenes").len(), 10);
    assert_eq!(dataset.split(Split::Test).expect("scenes").len(), 4);
    for scene in &dataset.scenes {
        assert!(
            scene.other.contains_key("credits") && scene.other.contains_key("licences"),
            "{}",
            scene.name
        );
        assert!(
            scene
                .ref_residual_relmse
                .is_some_and(|residual| residual > 0.0),
            "{}",
            scene.name
        );
    }
}

#[test]
fn validation_holds_out_whole_base_scenes_by_seed() {
    let dir = tempfile::tempdir().expect("a temporary directory");
    let scene = |i: usize| entry(&format!("s{i}"), "train", &format!("base{}", i % 6));
    let dataset = dataset(dir.path(), (0..30).map(scene).collect()).expect("sound");
    let split = |share, seed| dataset.train_validation(share, seed).expect("scenes");
    let (train, validation) = split(0.34, 1);
    assert_eq!((bases(&train).len(), bases(&validation).len()), (4, 2));
    assert!(bases(&train).is_disjoint(&bases(&validation)));
    assert_eq!(train.len() + validation.len(), 30);
    assert_eq!(split(0.34, 1), (train, validation));
    assert!((2..12).any(|seed| bases(&split(0.34, seed).1) != bases(&split(0.34, 1).1)));
    // A small share still holds out one base scene, a large share leaves one for training, and 0
    // holds out none.
    assert_eq!(bases(&split(0.01, 1).1).len(), 1);
    assert_eq!(bases(&split(0.99, 1).0).len(), 1);
    assert!(split(0.0, 1).1.is_empty());
}

#[test]
fn the_manifests_order_does_not_change_what_is_held_out() {
    let dir = tempfile::tempdir().expect("a temporary directory");
    let scenes: Vec<Value> = (0..9)
        .map(|i| entry(&format!("s{i}"), "train", &format!("b{i}")))
        .collect();
    let forward = dataset(dir.path(), scenes.clone())
        .expect("sound")
        .train_validation(0.3, 5)
        .expect("scenes")
        .1;
    let backward = dataset(dir.path(), scenes.into_iter().rev().collect())
        .expect("sound")
        .train_validation(0.3, 5)
        .expect("scenes")
        .1;
    assert_eq!(bases(&forward), bases(&backward));
    assert_eq!(
        names(&forward),
        names(&backward).into_iter().rev().collect::<Vec<_>>()
    );
}

#[test]
fn a_single_base_scene_is_trained_on() {
    let dir = tempfile::tempdir().expect("a temporary directory");
    let dataset = dataset(
        dir.path(),
        vec![entry("a", "train", "x"), entry("b", "train", "x")],
    )
    .expect("sound");
    let (train, validation) = dataset.train_validation(0.5, 1).expect("scenes");
    assert_eq!(
        (names(&train), names(&validation)),
        (vec!["a", "b"], vec![])
    );
    let error = dataset
        .split(Split::Test)
        .expect_err("there are none")
        .to_string();
    assert!(error.ends_with("no scene is in the test split"), "{error}");
}

#[test]
fn every_problem_of_a_manifest_is_named_at_once() {
    let mut wide = entry("wide", "train", "w");
    wide["width"] = json!(9);
    let mut gone = entry("gone", "train", "g");
    gone["file"] = json!("gone.exr");
    let scenes = vec![
        entry("a", "train", "room"),
        entry("a", "train", "b"),
        entry("c", "test", "room"),
        wide,
        gone,
    ];
    let message = refusal(scenes);
    for part in [
        "scene a is listed twice",
        "base scene room is in train and in test",
        "is 8x6, but the manifest says 9x6",
        "gone.exr: No such file",
    ] {
        assert!(message.contains(part), "{part:?} is not in: {message}");
    }
    assert!(refusal(vec![]).contains("lists no scenes"));
}

#[test]
fn one_file_under_two_names_is_refused() {
    let mut other = entry("b", "test", "b");
    other["file"] = "./a.exr".into();
    let message = refusal(vec![entry("a", "train", "a"), other]);
    assert!(
        message.ends_with("scenes a and b are the same file; remove one"),
        "{message}"
    );
}

#[test]
fn channels_that_many_scenes_lack_are_listed_once() {
    let dir = tempfile::tempdir().expect("a temporary directory");
    let scene = |i: usize| entry(&format!("s{i}"), "train", "b");
    dataset(dir.path(), (0..10).map(scene).collect()).expect("sound");
    let layout = ChannelLayout::resolve("mitsuba3").expect("a preset");
    let message = Dataset::open(dir.path(), &layout)
        .expect_err("its texture is albedo1")
        .to_string();
    assert_eq!(message.matches("the file has").count(), 1, "{message}");
    assert!(
        message.ends_with("(the same in 9 more scenes)"),
        "{message}"
    );
}

#[test]
fn a_data_set_without_masks_is_measured_over_every_pixel() {
    let dir = tempfile::tempdir().expect("a temporary directory");
    let layout = ChannelLayout::resolve("mitsuba3").expect("a preset");
    dataset(dir.path(), vec![entry("a", "train", "a")]).expect("sound");
    let mut channels = scene_channels(8, 6);
    channels.retain(|(name, _)| !name.starts_with("albedo2.") && name != "mask.A");
    for (name, _) in &mut channels {
        *name = name.replace("albedo1.", "albedo.");
    }
    write(&dir.path().join("a.exr"), (8, 6), channels.clone());
    let set = Dataset::open(dir.path(), &layout).expect("all that training needs");
    let stats =
        Statistics::measure(&set.scenes, &layout, &DataConfig::default(), 0.001).expect("sound");
    assert_eq!((stats.pixels, stats.misses), (48, 0));
    // Position is channel 6 of the file, stored as float: 6 + i / 48 at pixel i.
    let mean = stats.normalizer.features.mean;
    assert!((mean[3] - (6.0 + 23.5 / 48.0)).abs() < 1e-5, "{mean:?}");
    assert_eq!(mean[6..9], mean[9..]);
    // Training needs a reference; denoising does not.
    channels.retain(|(name, _)| !name.starts_with("ref."));
    write(&dir.path().join("a.exr"), (8, 6), channels);
    let frame = read_frame(&dir.path().join("a.exr"), &layout).expect("features are there");
    assert_eq!((frame.reference, frame.mask), (None, None));
    let message = Dataset::open(dir.path(), &layout)
        .expect_err("no reference")
        .to_string();
    assert!(
        message.contains("no channel ref.R, ref.G, ref.B"),
        "{message}"
    );
}

#[test]
fn a_manifest_of_another_kind_is_refused() {
    let dir = tempfile::tempdir().expect("a temporary directory");
    let open = |text: &str| {
        fs::write(dir.path().join("manifest.json"), text).expect("writable");
        Dataset::open(dir.path(), &layout())
            .expect_err("it must be refused")
            .to_string()
    };
    let other = open(r#"{"format": "demc-exr 12", "scenes": []}"#);
    assert!(
        other.contains(r#"format is "demc-exr 12", expected "demc-exr 1""#),
        "{other}"
    );
    assert!(
        open(r#"{"format": "demc-exr 1", "scenes": [{}]}"#)
            .contains("missing field `name` at line 1")
    );
    assert!(open("{").contains("manifest.json: EOF"));
    fs::remove_file(dir.path().join("manifest.json")).expect("it is there");
    let error = Dataset::open(dir.path(), &layout())
        .expect_err("nothing there")
        .to_string();
    assert!(
        error.starts_with("cannot read") && error.ends_with("manifest.json"),
        "{error}"
    );
}

#[test]
fn statistics_are_the_same_on_any_number_of_threads() {
    let scenes = Dataset::open(&sample(), &layout())
        .and_then(|set| set.split(Split::Train))
        .expect("the sample");
    let measure = |threads| {
        Statistics::measure_on(threads, &scenes, &layout(), &DataConfig::default(), 0.001)
            .expect("the sample is sound")
    };
    let one = measure(1);
    assert_eq!(one, measure(3));
    assert_eq!(one, measure(16));
    assert_eq!(one.pixels, 10 * 224 * 224);
    assert!(one.misses < one.pixels);
}

#[test]
fn statistics_normalise_the_scenes_they_were_measured_on() {
    let scenes = Dataset::open(&sample(), &layout())
        .and_then(|set| set.split(Split::Train))
        .expect("the sample");
    let stats = Statistics::measure(&scenes, &layout(), &DataConfig::default(), 0.001)
        .expect("the sample is sound");
    let mut sums = [[0.0f64; 2]; 12];
    let mut count = 0.0;
    for scene in &scenes {
        let mut frame = read_frame(&scene.path, &layout()).expect("the sample is sound");
        let hit = frame.mask.expect("the sample has masks");
        stats.normalizer.features_z_from_raw(&mut frame.features);
        for (sums, plane) in sums
            .iter_mut()
            .zip(frame.features.chunks_exact(hit.len()))
            .skip(6)
        {
            sums[0] += plane.iter().map(|&z| f64::from(z)).sum::<f64>();
            sums[1] += plane.iter().map(|&z| f64::from(z).powi(2)).sum::<f64>();
        }
        for (sums, plane) in sums
            .iter_mut()
            .zip(frame.features.chunks_exact(hit.len()))
            .take(6)
        {
            let z = plane
                .iter()
                .zip(&hit)
                .filter(|(_, hit)| **hit > 0.0)
                .map(|(&z, _)| f64::from(z));
            sums[0] += z.clone().sum::<f64>();
            sums[1] += z.map(|z| z * z).sum::<f64>();
        }
        count += hit.len() as f64;
    }
    for (channel, [sum, squares]) in sums.into_iter().enumerate() {
        let count = if channel < 6 {
            count - stats.misses as f64
        } else {
            count
        };
        // f32 rounding of 500,000 Z-scores, not a statistical tolerance.
        assert!(
            (sum / count).abs() < 1e-4,
            "mean of channel {channel}: {}",
            sum / count
        );
        assert!(
            (squares / count - 1.0).abs() < 1e-4,
            "variance of channel {channel}: {}",
            squares / count
        );
    }
    for value in stats.normalizer.flat_color {
        assert!((0.05..1.0).contains(&value), "flat colour {value}");
    }
}

#[test]
fn misses_count_for_textures_and_not_for_geometry_and_constants_keep_a_floor() {
    let dir = tempfile::tempdir().expect("a temporary directory");
    let set = dataset(dir.path(), vec![entry("a", "train", "a")]).expect("sound");
    // 48 pixels; the upper half are misses. normal.X is 0 there and 2 at hits, like albedo1.R, where 2 counts as 1.
    let upper =
        |missed: f32, hit: f32| half((0..48).map(move |i| if i < 24 { missed } else { hit }));
    let mut channels = scene_channels(8, 6);
    for (name, samples) in &mut channels {
        match name.as_str() {
            "mask.A" => *samples = upper(0.0, 0.25),
            "normal.X" | "albedo1.R" => *samples = upper(0.0, 2.0),
            "ref.R" => *samples = upper(-1.0, 1.0),
            _ => {}
        }
    }
    write(&dir.path().join("a.exr"), (8, 6), channels);
    let stats =
        Statistics::measure(&set.scenes, &layout(), &DataConfig::default(), 0.001).expect("sound");
    assert_eq!((stats.pixels, stats.misses, stats.clamped), (48, 24, 24));
    let features = stats.normalizer.features;
    assert_eq!((features.mean[0], features.std[0]), (2.0, STD_FLOOR));
    assert_eq!((features.mean[6], features.std[6]), (0.5, 0.5));
    // Half black, half 1: weights of 1 / 0.001 and 1 / 1.001 (Eq. 5).
    let best = (1.0f64 / 1.001) / (1.0 / 0.001 + 1.0 / 1.001);
    let expected = best.powf(1.0 / 2.2) as f32;
    assert!((stats.normalizer.flat_color[0] - expected).abs() < 1e-6);
}
