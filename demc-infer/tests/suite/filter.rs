//! Tests of `demc-infer denoise --filter` and of filters as baselines, through the binary.

use std::fs;
use std::path::{Path, PathBuf};

use crate::arguments;
use crate::common::{demc_infer, run_directory, sample_image};
use demc_data::ChannelLayout;
use demc_data::image::exr::ExrFile;
use demc_data::image::exr::merge::{MergeInput, merge};
use demc_data::image::rewrite::RECORD;
use serde_json::Value;

/// A data set of one scene with passes, and its layout. A sample image stands for both half buffers and for
/// variances, and its mask for the depth.
fn data_set(root: &Path) -> (PathBuf, PathBuf) {
    let stock = sample_image("col-classroom-1.exr");
    let input = |prefix: Option<&str>| MergeInput {
        file: ExrFile::open(&stock).expect("an EXR file"),
        prefix: prefix.map(str::to_owned),
        strip: None,
    };
    let mut inputs = [None, Some("half1"), Some("half2"), Some("variance")].map(input);
    let data = root.join("data");
    fs::create_dir(&data).expect("a directory");
    merge(&mut inputs, &data.join("passes.exr")).expect("joined");
    let manifest = r#"{"format": "demc-exr 1", "scenes": [{"name": "passes", "split": "test", "base": "passes",
        "file": "passes.exr", "width": 256, "height": 256}]}"#;
    fs::write(data.join("manifest.json"), manifest).expect("written");
    let preset = include_str!("../../../configs/renderers/demc-exr.toml");
    let lines = preset.lines().filter(|line| !line.starts_with("mask "));
    let layout: Vec<String> = lines
        .map(|line| line.replace("depth.Z", "mask.A"))
        .collect();
    let path = root.join("layout.toml");
    fs::write(&path, layout.join("\n")).expect("written");
    ChannelLayout::resolve(path.to_str().expect("UTF-8")).expect("a layout");
    (data, path)
}

#[test]
fn files_with_passes_are_filtered_and_others_reported() {
    let root = tempfile::tempdir().expect("a directory");
    let (data, layout) = data_set(root.path());
    let out = root.path().join("out");
    let list = arguments![
        "denoise", "--filter", "nfor", "--layout", layout, data, "-o", out, "--png"
    ];
    demc_infer(&list).success();
    let (filtered, input) = (out.join("passes.exr"), data.join("passes.exr"));
    let read = |path: &Path, names: [&str; 3]| {
        let mut file = ExrFile::open(path).expect("an EXR file");
        file.read(&names).expect("its channels")
    };
    let color = ["R", "G", "B"];
    assert_ne!(read(&filtered, color), read(&input, color));
    let half = ["half1.R", "half2.normal.X", "variance.mask.A"];
    assert_eq!(read(&filtered, half), read(&input, half));
    let record = ExrFile::open(&filtered)
        .expect("an EXR file")
        .attribute(RECORD);
    let record = record.expect("a record");
    assert!(record.contains(r#""--filter":"nfor""#), "{record}");
    assert!(out.join("passes.png").is_file());

    fs::copy(
        sample_image("col-dining-room-1.exr"),
        data.join("plain.exr"),
    )
    .expect("copied");
    let again = demc_infer(&list);
    assert_eq!(again.code, 1);
    again.says("1 of 2 images already exist");
    again.says("plain.exr: lacks half1.R, half1.G, half1.B, half2.R");
    again.says("render with tools/render --passes paper, or name other channels in [passes]");
    assert!(!out.join("plain.exr").exists());
}

#[test]
fn options_of_models_do_not_suit_a_filter() {
    for option in [
        &["--model", "fast"][..],
        &["--layers", "A"],
        &["--repair"],
        &["--input-scale", "2"],
        &["--ensemble", "4"],
        &["--restore-light", "on"],
        &["--tile", "64"],
        &["--device", "flex"],
        &["--isa", "auto"],
    ] {
        let list = ["denoise", "--filter", "nfor", "a.exr", "-o", "b.exr"];
        let outcome = demc_infer(list.iter().chain(option));
        assert_eq!(outcome.code, 2, "{option:?}");
        outcome.says("cannot be used with");
    }
}

#[test]
fn nfor_is_scored_as_a_baseline() {
    let root = tempfile::tempdir().expect("a directory");
    let (data, layout) = data_set(root.path());
    let run = run_directory();
    let list = arguments![
        "evaluate",
        "--model",
        run.path(),
        "--data",
        data,
        "--layout",
        layout,
        "--json",
        "-",
        "--baseline",
        "nfor"
    ];
    let outcome = demc_infer(&list).success();
    let json: Value = serde_json::from_str(&outcome.stdout).expect("JSON");
    let relmse = |score: &Value| score["relmse"].as_f64().expect("a number");
    let mean = &json["mean"];
    let (noisy, nfor) = (relmse(&mean["noisy"]), relmse(&mean["baselines"]["nfor"]));
    assert!(nfor < 0.5 * noisy, "{noisy} {nfor}");
    let twice = demc_infer(
        list.iter()
            .cloned()
            .chain(arguments!["--baseline", "nfor=images"]),
    );
    twice.failure(2, "--baseline nfor: the name is reserved or used twice");
}
