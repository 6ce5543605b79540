//! The bundled model on files of Blender Cycles, Mitsuba and LuxCore.

use std::path::{Path, PathBuf};

use crate::arguments;
use crate::common::demc_infer;
use demc_data::Frame;
use demc_data::image::exr::ExrFile;
use demc_data::image::frame::decode_input;
use demc_data::image::layout::detect;
use demc_data::image::plane::Plane;
use demc_infer::{Bundle, device};
use demc_model::metrics::rel_mse_image;

const FILES: [(&str, &str, &str); 4] = [
    ("cycles-4.5.exr", "cycles-reference.exr", "layout cycles"),
    ("cycles-5.0.exr", "cycles-reference.exr", "layout cycles"),
    (
        "mitsuba-3.9.exr",
        "mitsuba-reference.exr",
        "layout mitsuba3",
    ),
    (
        "luxcore-2.11.exr",
        "luxcore-reference.exr",
        "layout luxcore",
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
    let planes = file
        .read(&color_names(&file).each_ref().map(String::as_str))
        .expect("colour");
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
    let device = device::parse("flex").expect("the CPU");
    Bundle::load("quality".as_ref(), &device).expect("the model")
}

/// RelMSE of a stock file whose frame `change` has changed, relative to the unchanged file. `back` is
/// the factor that undoes a change of the exposure.
fn ratio(
    bundle: &Bundle,
    name: &str,
    reference: &str,
    back: f32,
    change: impl Fn(&mut Frame),
) -> f64 {
    let mut file = open(&path(name));
    let layout = detect(&file, bundle.missing(), None).expect(name).layout;
    let frame = decode_input(&mut file, &layout).expect(name);
    let reference = color(&path(reference));
    let error = |frame: &Frame, back: f32| {
        let mut image = bundle.denoise(frame).expect("denoised");
        image.iter_mut().for_each(|x| *x *= back);
        rel_mse_image(&image, &reference)
    };
    let mut changed = frame.clone();
    change(&mut changed);
    error(&changed, back) / error(&frame, 1.0)
}

/// The normals, positions or textures of a frame.
fn buffer(frame: &mut Frame, index: usize) -> &mut [f32] {
    let size = 3 * frame.width * frame.height;
    &mut frame.features[index * size..][..size]
}

#[test]
fn the_exposure_of_a_stock_file_hardly_matters() {
    let bundle = bundle();
    for (name, reference, _) in FILES {
        for factor in [1e-3, 1e3] {
            let ratio = ratio(&bundle, name, reference, 1.0 / factor, |frame| {
                frame.color.iter_mut().for_each(|x| *x *= factor);
            });
            assert!((ratio - 1.0).abs() < 0.05, "{name}, {factor}: {ratio}");
        }
    }
}

#[test]
fn origin_and_unit_of_the_positions_hardly_matter() {
    let bundle = bundle();
    for (name, reference, _) in FILES {
        let moves: [(f32, f32); 3] = [(1.0, 1e6), (1e3, 0.0), (1e3, 1e6)];
        for (factor, offset) in moves {
            let ratio = ratio(&bundle, name, reference, 1.0, |frame| {
                let pixels = frame.width * frame.height;
                let positions = buffer(frame, 1);
                // A coordinate of a hit may be 0, as on a floor.
                let is_hit = |i: &usize| (0..3).any(|axis| positions[axis * pixels + i] != 0.0);
                let hits: Vec<usize> = (0..pixels).filter(is_hit).collect();
                for place in (0..3).flat_map(|axis| hits.iter().map(move |i| axis * pixels + i)) {
                    positions[place] = positions[place] * factor + offset;
                }
            });
            assert!(
                (ratio - 1.0).abs() < 0.05,
                "{name}, {factor}, {offset}: {ratio}"
            );
        }
    }
}

/// The camera of the scenes looks down by about half a radian and does not look along an axis.
#[test]
fn normals_in_camera_space_hardly_matter() {
    let bundle = bundle();
    let (turn, tilt) = (0.8_f32.sin_cos(), 0.5_f32.sin_cos());
    for (name, reference, _) in FILES {
        let ratio = ratio(&bundle, name, reference, 1.0, |frame| {
            let pixels = frame.width * frame.height;
            let normals = buffer(frame, 0);
            for i in 0..pixels {
                let [x, y, z] = [0, 1, 2].map(|axis| normals[axis * pixels + i]);
                let (x, y) = (turn.1 * x - turn.0 * y, turn.0 * x + turn.1 * y);
                let (y, z) = (tilt.1 * y - tilt.0 * z, tilt.0 * y + tilt.1 * z);
                for (axis, value) in [x, z, -y].into_iter().enumerate() {
                    normals[axis * pixels + i] = value;
                }
            }
        });
        assert!((ratio - 1.0).abs() < 0.05, "{name}: {ratio}");
    }
}

#[test]
fn a_missing_position_hardly_matters() {
    let bundle = bundle();
    for (name, reference, _) in FILES {
        let ratio = ratio(&bundle, name, reference, 1.0, |frame| {
            buffer(frame, 1).fill(0.0)
        });
        assert!((ratio - 1.0).abs() < 0.1, "{name}: {ratio}");
    }
}

/// The sample has a second texture, which stock renderers lack.
#[test]
fn a_missing_second_texture_hardly_matters() {
    let bundle = bundle();
    let scenes = Path::new(env!("CARGO_MANIFEST_DIR")).join("../data/sample/test");
    let layout = demc_data::ChannelLayout::resolve("demc-exr").expect("a preset");
    for name in [
        "col-classroom-1",
        "col-dining-room-1",
        "gen-room-test-1",
        "gen-table-test-1",
    ] {
        let frame = demc_data::read_frame(&scenes.join(format!("{name}.exr")), &layout)
            .expect("the sample is sound");
        let reference = frame.reference.clone().expect("the sample has one");
        let mut without = frame.clone();
        let first = buffer(&mut without, 2).to_vec();
        buffer(&mut without, 3).copy_from_slice(&first);
        let [with, without] = [&frame, &without]
            .map(|frame| rel_mse_image(&bundle.denoise(frame).expect("denoised"), &reference));
        let ratio = without / with;
        assert!((ratio - 1.0).abs() < 0.1, "{name}: {ratio}");
    }
}

/// The alpha of an image on a transparent film is denoised; where it does not vary, it stays.
#[test]
fn alpha_is_denoised_with_the_colour() {
    let directory = tempfile::tempdir().expect("a directory");
    let (input, output) = (path("cycles-alpha.exr"), directory.path().join("out.exr"));
    demc_infer(arguments!["denoise", input, "-o", output]).success();
    let alpha = |path: &Path| {
        let planes = open(path).read(&["ViewLayer.Combined.A"]);
        planes.expect("alpha")[0].to_f32()
    };
    let reference = alpha(&path("cycles-alpha-reference.exr"));
    let [noisy, denoised] = [&input, &output].map(|path| alpha(path));
    let error = |image: &[f32]| {
        let pairs = image.iter().zip(&reference);
        pairs.map(|(a, b)| (a - b) * (a - b)).sum::<f32>()
    };
    assert!(
        error(&denoised) < 0.7 * error(&noisy),
        "{} {}",
        error(&denoised),
        error(&noisy)
    );
    assert!(denoised.iter().all(|alpha| (0.0..=1.0).contains(alpha)));
    assert_eq!((denoised[0], noisy[0]), (0.0, 0.0));
    let opaque = denoised.iter().filter(|alpha| **alpha == 1.0).count();
    assert!(opaque > 100, "{opaque} pixels stay opaque");
}
