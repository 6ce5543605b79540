//! Tests of `demc-infer denoise --layers` through the binary, on files of Blender Cycles.

use std::ffi::OsString;
use std::fs;
use std::path::{Path, PathBuf};

use crate::arguments;
use crate::common::{Outcome, demc_infer, kernel_run_directory, run_directory};
use demc_data::image::exr::ExrFile;
use demc_data::image::exr::merge::{MergeInput, merge};
use demc_data::image::plane::Plane;
use demc_data::{SamplePrecision, write_rgb};

/// Light groups as Cycles names them.
const GROUPS: [&str; 3] = ["Combined_fill", "Combined_key", "Combined_rim"];

fn path(name: &str) -> PathBuf {
    let tests = Path::new(env!("CARGO_MANIFEST_DIR")).join("../tests/renderers/files");
    tests.join(name)
}

fn names(file: &ExrFile) -> Vec<String> {
    let channels = file.channels().iter();
    channels.map(|channel| channel.name.clone()).collect()
}

fn read(path: &Path, layer: &str) -> Vec<f32> {
    let names = ["R", "G", "B"].map(|channel| format!("ViewLayer.{layer}.{channel}"));
    let planes = ExrFile::open(path)
        .expect("an EXR file")
        .read(&names.each_ref().map(String::as_str))
        .expect("its channels");
    planes.iter().flat_map(Plane::to_f32).collect()
}

/// Blender's file with three light groups that add up to its colour.
fn file_with_groups(directory: &Path) -> PathBuf {
    let stock = path("cycles-4.5.exr");
    let color = read(&stock, "Combined");
    let share = |i: usize| (i * 7919 % 101) as f32 / 101.0;
    let fill: Vec<f32> = (0..color.len()).map(|i| color[i] * share(i)).collect();
    let rest = |i: usize| color[i] - fill[i];
    let key: Vec<f32> = (0..color.len()).map(|i| rest(i) * share(i + 13)).collect();
    let rim = (0..color.len()).map(|i| rest(i) - key[i]).collect();
    let mut inputs = vec![MergeInput {
        file: ExrFile::open(&stock).expect("an EXR file"),
        prefix: None,
        strip: None,
    }];
    for (group, values) in GROUPS.into_iter().zip([fill, key, rim]) {
        let file = directory.join(format!("{group}.exr"));
        write_rgb(&file, 64, 64, &values, SamplePrecision::Float).expect("written");
        inputs.push(MergeInput {
            file: ExrFile::open(&file).expect("an EXR file"),
            prefix: Some(format!("ViewLayer.{group}")),
            strip: None,
        });
    }
    let merged = directory.join("groups.exr");
    merge(&mut inputs, &merged).expect("joined");
    merged
}

fn denoise(model: &Path, input: &Path, output: &Path, flags: &[&str]) -> Outcome {
    let list = arguments!["denoise", "--model", model, input, "-o", output];
    demc_infer(list.into_iter().chain(flags.iter().map(OsString::from)))
}

/// The channels whose samples differ between two files of the same channels.
fn changed(before: &Path, after: &Path) -> Vec<String> {
    let [mut before, mut after] =
        [before, after].map(|path| ExrFile::open(path).expect("an EXR file"));
    assert_eq!(names(&before), names(&after));
    let mut names = names(&before);
    names.retain(|name| {
        let planes = [&mut before, &mut after].map(|file| file.read(&[name]).expect("read"));
        planes[0] != planes[1]
    });
    names
}

#[test]
fn denoised_light_groups_add_up_to_the_denoised_colour() {
    for run in [kernel_run_directory(), run_directory()] {
        check_sum(run.path());
    }
}

fn check_sum(run: &Path) {
    let dir = tempfile::tempdir().expect("directory");
    let input = file_with_groups(dir.path());
    let output = dir.path().join("clean.exr");
    // The first pattern matches two groups.
    let flags = [
        "--layers",
        "ViewLayer.Combined_[fk]*",
        "--layers",
        "*_rim.[RGB]",
    ];
    for ops in ["kernels", "burn"] {
        let flags: Vec<&str> = flags
            .into_iter()
            .chain(["--ops", ops, "--overwrite"])
            .collect();
        denoise(run, &input, &output, &flags).success();
        let color = read(&output, "Combined");
        let groups = GROUPS.map(|group| read(&output, group));
        let largest = color.iter().copied().fold(0.0, f32::max);
        for (i, color) in color.iter().enumerate() {
            let sum: f32 = groups.iter().map(|group| group[i]).sum();
            assert!(
                (sum - color).abs() <= 1e-4 * largest,
                "{ops}: sample {i}: {sum} instead of {color}, largest {largest}"
            );
        }
        let mut expected: Vec<String> = GROUPS
            .iter()
            .chain(&["Combined"])
            .flat_map(|group| ["B", "G", "R"].map(|c| format!("ViewLayer.{group}.{c}")))
            .collect();
        expected.sort();
        assert_eq!(changed(&input, &output), expected, "{ops}");
    }
}

#[test]
fn the_colour_has_the_same_bytes_with_layers_and_a_pattern_of_the_colour_adds_nothing() {
    let (run, dir) = (
        kernel_run_directory(),
        tempfile::tempdir().expect("directory"),
    );
    let input = file_with_groups(dir.path());
    let [plain, with, of_color] = ["a.exr", "b.exr", "c.exr"].map(|name| dir.path().join(name));
    denoise(run.path(), &input, &plain, &[]).success();
    denoise(run.path(), &input, &with, &["--layers", "*_rim.*"]).success();
    let flags = ["--layers", "ViewLayer.Combined.[RGB]"];
    denoise(run.path(), &input, &of_color, &flags).success();
    assert_eq!(read(&plain, "Combined"), read(&with, "Combined"));
    let rim = ["B", "G", "R"].map(|c| format!("ViewLayer.Combined_rim.{c}"));
    assert_eq!(changed(&plain, &with), rim);
    assert_eq!(changed(&plain, &of_color), [""; 0]);
}

/// A file of several parts, with alpha beside the colour and depth in a part of its own.
#[test]
fn layers_may_be_in_any_part() {
    let (run, dir) = (
        kernel_run_directory(),
        tempfile::tempdir().expect("directory"),
    );
    let input = path("cycles-alpha.exr");
    let [plain, with] = ["plain.exr", "with.exr"].map(|name| dir.path().join(name));
    denoise(run.path(), &input, &plain, &[]).success();
    let flags = ["--layers", "*.Combined.A", "--layers", "*Depth*"];
    denoise(run.path(), &input, &with, &flags).success();
    let color = ["A", "B", "G", "R"].map(|c| format!("ViewLayer.Combined.{c}"));
    let depth = "ViewLayer.Denoising Depth.Z".to_owned();
    let all: Vec<String> = color.iter().chain([&depth]).cloned().collect();
    assert_eq!(changed(&input, &plain), color);
    assert_eq!(changed(&input, &with), all);
    // Alpha is filtered with the colour's kernels, not denoised by a pass of its own.
    assert_eq!(changed(&plain, &with), [color[0].clone(), depth]);
}

#[test]
fn what_cannot_be_filtered_is_one_line_and_nothing_is_written() {
    let run = kernel_run_directory();
    let dir = tempfile::tempdir().expect("directory");
    let (input, output) = (path("cycles-4.5.exr"), dir.path().join("clean.exr"));
    let file = input.display();
    let cases: [(&[&str], i32, String); 3] = [
        (
            &["--layers", "*.A", "--ensemble", "4"],
            2,
            "--layers: layers of a kernel head need a single pass, not the mean of 4".into(),
        ),
        (
            &["--layers", "*.A", "--layers", "Diff*"],
            1,
            format!(
                "{file}: no channel matches --layers Diff*; the file has ViewLayer.Combined.A,"
            ),
        ),
        (
            &["--layers", "*.Normal.X"],
            1,
            format!(
                "{file}: channel ViewLayer.Normal.X is no layer: it is the normal that the network sees"
            ),
        ),
    ];
    for (flags, code, start) in cases {
        let flags = [&["--layout", "cycles"], flags].concat();
        denoise(run.path(), &input, &output, &flags).failure(code, &start);
        assert!(!output.exists(), "{flags:?}");
    }
    let outcome = denoise(run.path(), &input, &output, &["--layers", "a["]);
    assert_eq!(outcome.code, 2);
    outcome.says("invalid value 'a[' for '--layers <PATTERN>'");
}

#[test]
fn a_frame_without_the_layer_is_reported_and_the_others_are_written() {
    let (run, dir) = (
        kernel_run_directory(),
        tempfile::tempdir().expect("directory"),
    );
    let output = dir.path().join("out");
    let groups = file_with_groups(dir.path());
    fs::rename(groups, dir.path().join("shot.0001.exr")).expect("renamed");
    fs::copy(path("cycles-4.5.exr"), dir.path().join("shot.0002.exr")).expect("copied");
    let shot = dir.path().join("shot.####.exr");
    let outcome = denoise(run.path(), &shot, &output, &["--layers", "*_rim.*"]);
    assert_eq!(outcome.code, 1);
    outcome.says("shot.0002.exr: no channel matches --layers *_rim.*; the file has");
    outcome.says("1 of 2 images were not denoised");
    assert!(output.join("shot.0001.exr").exists());
    assert!(!output.join("shot.0002.exr").exists());
}
