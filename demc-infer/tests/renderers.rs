//! The bundled model on files that Blender Cycles and Mitsuba wrote, as they are.

mod common;

use std::path::{Path, PathBuf};

use common::demc_infer;
use demc_data::Frame;
use demc_data::exr::ExrFile;
use demc_data::frame::decode_input;
use demc_data::layout::detect;
use demc_data::plane::Plane;
use demc_infer::{Bundle, device};
use demc_model::metrics::rel_mse_image;

const FILES: [(&str, &str, &str); 3] = [
    ("cycles-4.5.exr", "cycles-reference.exr", "layout cycles"),
    ("cycles-5.0.exr", "cycles-reference.exr", "layout cycles"),
    (
        "mitsuba-3.9.exr",
        "mitsuba-reference.exr",
        "layout mitsuba3",
    ),
];

fn path(name: &str) -> PathBuf {
    let tests = Path::new(env!("CARGO_MANIFEST_DIR")).join("../tests/renderers/files");
    tests.join(name)
}

fn open(path: &Path) -> ExrFile {
    ExrFile::open(path).expect("an EXR file")
}

/// The names of red, green and blue of the colour.
fn color_names(file: &ExrFile) -> [String; 3] {
    ["R", "G", "B"].map(|channel| {
        let combined = format!("ViewLayer.Combined.{channel}");
        match file.channel(&combined) {
            Some(_) => combined,
            None => channel.to_owned(),
        }
    })
}

fn color(path: &Path) -> Vec<f32> {
    let mut file = open(path);
    let planes = file.read(&color_names(&file).each_ref().map(String::as_str));
    let planes = planes.expect("colour");
    planes.iter().flat_map(Plane::to_f32).collect()
}

#[test]
fn stock_files_are_denoised_without_an_option_and_keep_their_other_channels() {
    let directory = tempfile::tempdir().expect("a directory");
    for (name, reference, layout) in FILES {
        let (input, output) = (path(name), directory.path().join(name));
        let outcome = demc_infer(arguments!["denoise", input, "-o", output]).success();
        outcome.says(layout);
        outcome.says("no texture2: texture1 replaces it");
        let reference = color(&path(reference));
        let [noisy, denoised] =
            [&input, &output].map(|path| rel_mse_image(&color(path), &reference));
        assert!(denoised < 0.7 * noisy, "{name}: {denoised}, noisy {noisy}");
        let (mut before, mut after) = (open(&input), open(&output));
        let names = |file: &ExrFile| -> Vec<String> {
            let channels = file.channels().iter();
            channels.map(|channel| channel.name.clone()).collect()
        };
        assert_eq!(names(&before), names(&after), "{name}");
        for channel in names(&before) {
            let is_color = color_names(&before).contains(&channel);
            let planes =
                [&mut before, &mut after].map(|file| file.read(&[&channel]).expect("read"));
            assert_eq!(planes[0] == planes[1], !is_color, "{name}: {channel}");
        }
    }
}

/// The choice of the layout is printed once for a sequence, although its exposure is read first.
#[test]
fn the_layout_of_a_sequence_is_printed_once() {
    let directory = tempfile::tempdir().expect("a directory");
    for frame in ["0001", "0002", "0003"] {
        let copy = directory.path().join(format!("shot.{frame}.exr"));
        std::fs::copy(path("cycles-5.0.exr"), copy).expect("copied");
    }
    let sequence = directory.path().join("shot.####.exr");
    let outputs = directory.path().join("out");
    let outcome = demc_infer(arguments!["denoise", sequence, "-o", outputs]).success();
    let notes = outcome.stderr.matches("layout cycles").count();
    assert_eq!(notes, 1, "{}", outcome.stderr);
}

fn bundle() -> Bundle {
    let model = Path::new(env!("CARGO_MANIFEST_DIR")).join("../models/demc.safetensors");
    Bundle::load(&model, &device::parse("flex").expect("the CPU")).expect("the model")
}

/// RelMSE at 0.001 and 1000 times the exposure, relative to the unchanged file.
#[test]
fn the_exposure_of_a_stock_file_hardly_matters() {
    let bundle = bundle();
    for (name, reference, _) in FILES {
        let mut file = open(&path(name));
        let layout = detect(&file, bundle.missing(), None).expect(name).layout;
        let frame = decode_input(&mut file, &layout).expect(name);
        let reference = color(&path(reference));
        let error = |factor: f32| {
            let scaled = Frame {
                color: frame.color.iter().map(|x| x * factor).collect(),
                ..frame.clone()
            };
            let mut image = bundle.denoise(&scaled).expect("denoised");
            image.iter_mut().for_each(|x| *x /= factor);
            rel_mse_image(&image, &reference)
        };
        let unchanged = error(1.0);
        for factor in [1e-3, 1e3] {
            let ratio = error(factor) / unchanged;
            assert!((ratio - 1.0).abs() < 0.2, "{name}, {factor}: {ratio}");
        }
    }
}
