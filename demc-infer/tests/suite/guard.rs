//! Warnings on the sample's scenes: none for the originals, one for each common mistake.

use crate::arguments;
use crate::common::{demc_infer, random_bundle, sample, sample_image};
use demc_data::{
    ChannelLayout, DataConfig, Dataset, Frame, Split, Statistics, WriteOptions, read_frame,
    write_denoised,
};
use demc_infer::{Bundle, Names, Precision};

fn trained() -> (Bundle, Vec<(Split, Frame)>) {
    let mut bundle = random_bundle();
    let layout = bundle.meta.layout.clone();
    let dataset = Dataset::open(&sample(), &layout).expect("the sample");
    let training = dataset.split(Split::Train).expect("training scenes");
    let statistics =
        Statistics::measure(&training, &layout, &DataConfig::default(), 1e-3).expect("sound");
    bundle.meta.normalizer = statistics.normalizer;
    bundle.meta.ranges = Some(statistics.ranges);
    let frames = dataset.scenes.iter().map(|scene| {
        let frame = read_frame(&scene.path, &layout).expect("sound");
        (scene.split, frame)
    });
    (bundle, frames.collect())
}

fn warnings(bundle: &Bundle, frame: &Frame) -> Vec<String> {
    let warnings = bundle.warnings(frame).expect("sizes fit").into_iter();
    warnings.map(|warning| warning.to_string()).collect()
}

#[test]
fn test_scenes_pass_and_mistakes_are_named() {
    let (bundle, frames) = trained();
    let mut tests = frames
        .into_iter()
        .filter(|(split, _)| *split == Split::Test);
    for (_, frame) in tests.by_ref() {
        assert_eq!(warnings(&bundle, &frame), [""; 0], "{}", frame.name);
        let pixels = frame.width * frame.height;
        let with = |change: &dyn Fn(&mut Frame)| {
            let mut frame = frame.clone();
            change(&mut frame);
            warnings(&bundle, &frame).join("\n")
        };
        let packed = with(&|frame| {
            let normals = frame.features[..3 * pixels].iter_mut();
            normals.for_each(|x| *x = *x / 2.0 + 0.5);
        });
        assert!(
            packed.contains("packed into 0 to 1"),
            "{}: {packed}",
            frame.name
        );
        let turned = with(&|frame| frame.features[..3 * pixels].rotate_left(pixels));
        assert!(turned.contains("axes swapped"), "{}: {turned}", frame.name);
        let swapped = with(&|frame| {
            let (normals, rest) = frame.features.split_at_mut(6 * pixels);
            normals[..3 * pixels].swap_with_slice(&mut rest[..3 * pixels]);
        });
        assert!(
            swapped.contains("normal: its length is"),
            "{}: {swapped}",
            frame.name
        );
        assert!(
            swapped.contains("texture1: its minimum is"),
            "{}: {swapped}",
            frame.name
        );
        let centimetres = with(&|frame| {
            let positions = frame.features[3 * pixels..6 * pixels].iter_mut();
            positions.for_each(|x| *x *= 100.0);
        });
        assert!(
            centimetres.contains("another unit"),
            "{}: {centimetres}",
            frame.name
        );
    }
}

#[test]
fn check_prints_the_table_and_fails_on_a_warning() {
    let (bundle, _) = trained();
    let dir = tempfile::tempdir().expect("a directory");
    let model = dir.path().join("model.safetensors");
    bundle
        .save(&model, Names::Burn, Precision::F32)
        .expect("saved");
    let list = arguments!["check", "--model", model, sample().join("test")];
    let outcome = demc_infer(list).success();
    assert_eq!(
        outcome.stdout.matches("| exposure ").count(),
        4,
        "{}",
        outcome.stdout
    );

    // A range that no image is in.
    let mut strict = bundle;
    let ranges = strict.meta.ranges.as_mut().expect("they were set");
    ranges.mean[6] = demc_data::input::ranges::Range {
        low: 1e6,
        high: 1e6 + 1.0,
    };
    strict
        .save(&model, Names::Burn, Precision::F32)
        .expect("saved");
    let list = arguments!["check", "--model", model, "--json", sample().join("test")];
    let outcome = demc_infer(list);
    assert_eq!(outcome.code, 1);
    let json: serde_json::Value = serde_json::from_str(&outcome.stdout).expect("JSON");
    for image in json.as_array().expect("a list") {
        let warning = image["warnings"][0].as_str().expect("a warning");
        assert!(warning.starts_with("texture1.r: its mean is "), "{warning}");
    }
    assert!(
        outcome
            .stderr
            .ends_with("error: 4 of 4 images have warnings\n"),
        "{}",
        outcome.stderr
    );
}

/// The noise of a pixel filter wider than a box: each pixel has a share of its neighbours.
#[test]
fn check_names_a_wide_pixel_filter() {
    let directory = tempfile::tempdir().expect("a directory");
    let (source, filtered) = (
        sample_image("gen-room-test-1.exr"),
        directory.path().join("wide.exr"),
    );
    let layout = ChannelLayout::resolve("demc-exr").expect("a preset");
    let frame = read_frame(&source, &layout).expect("the sample is sound");
    let (width, height) = (frame.width, frame.height);
    let at = |i: usize, dy: usize, dx: usize| {
        let (plane, pixel) = (i / (width * height), i % (width * height));
        let (y, x) = (pixel / width + dy, pixel % width + dx);
        let (y, x) = (y.clamp(1, height) - 1, x.clamp(1, width) - 1);
        frame.color[(plane * height + y) * width + x]
    };
    let wide = |i| {
        let beside = at(i, 0, 1) + at(i, 2, 1) + at(i, 1, 0) + at(i, 1, 2);
        0.6 * at(i, 1, 1) + 0.1 * beside
    };
    let color: Vec<f32> = (0..frame.color.len()).map(wide).collect();
    let options = WriteOptions::default();
    write_denoised(&source, &layout, &color, &filtered, &options).expect("written");
    let sharp = demc_infer(arguments!["check", source]).success();
    assert!(!sharp.stdout.contains("pixel filter"), "{}", sharp.stdout);
    let outcome = demc_infer(arguments!["check", filtered]);
    assert!(
        outcome
            .stdout
            .contains("set the renderer's pixel filter to box"),
        "{}",
        outcome.stdout
    );
    assert_eq!(outcome.code, 1);
}
