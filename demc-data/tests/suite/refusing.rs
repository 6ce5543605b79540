//! Files that are refused: each message names the file and the problem, in one line.

use std::fs;
use std::path::Path;

use crate::support::{ZIP, half, layout, named, part, sample, scene_channels, write, write_parts};
use demc_data::image::exr::{ExrFile, MAX_SIDE};
use demc_data::image::frame::decode_repaired;
use demc_data::{ChannelLayout, read_frame};
use exr::prelude::*;
use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;

const SIZE: (usize, usize) = (7, 5);
const PIXELS: usize = 35;

fn refusal(path: &Path) -> String {
    let message = read_frame(path, &layout())
        .expect_err("it must be refused")
        .to_string();
    assert!(message.contains(&path.display().to_string()), "{message}");
    assert!(!message.contains('\n'), "{message}");
    message
}

/// A file of the `demc-exr` layout with one modified channel.
fn changed(path: &Path, channel: &str, change: impl FnOnce(&mut FlatSamples)) {
    let mut channels = scene_channels(SIZE.0, SIZE.1);
    let (_, samples) = channels
        .iter_mut()
        .find(|(name, _)| name == channel)
        .expect("in the layout");
    change(samples);
    write(path, SIZE, channels);
}

#[test]
fn a_file_that_is_no_exr_or_not_there_is_refused() {
    let dir = tempfile::tempdir().expect("a temporary directory");
    let path = dir.path().join("a.exr");
    assert!(refusal(&path).starts_with("cannot read"));
    fs::write(&path, "not an image").expect("writable");
    assert!(refusal(&path).contains("not a readable OpenEXR file"));
    fs::write(&path, "").expect("writable");
    refusal(&path);
    refusal(dir.path());
}

#[test]
fn the_sample_cut_short_anywhere_is_refused() {
    let dir = tempfile::tempdir().expect("a temporary directory");
    let path = dir.path().join("cut.exr");
    let whole = fs::read(sample().join("train/col-spaceship-0.exr")).expect("the sample");
    for length in (0..2500)
        .step_by(97)
        .chain((2500..whole.len()).step_by(19_997))
        .chain([whole.len() - 1])
    {
        fs::write(&path, &whole[..length]).expect("writable");
        refusal(&path);
    }
}

#[test]
fn damaged_bytes_never_end_the_program() {
    let dir = tempfile::tempdir().expect("a temporary directory");
    let path = dir.path().join("damaged.exr");
    let mut rng = ChaCha8Rng::seed_from_u64(1);
    let mut refused = 0;
    for compression in [
        Compression::ZIP16,
        Compression::PIZ,
        Compression::B44,
        Compression::DWAA(None),
    ] {
        let encoding = Encoding { compression, ..ZIP };
        let layer = part(None, (33, 30), encoding, scene_channels(33, 30));
        Image::from_layer(layer)
            .write()
            .to_file(&path)
            .expect("writable");
        let whole = fs::read(&path).expect("just written");
        for round in 0..300 {
            let mut bytes = whole.clone();
            let reach = if round % 2 == 0 { bytes.len() } else { 1600 };
            for _ in 0..rng.random_range(1..4) {
                let place = rng.random_range(0..reach.min(bytes.len()));
                bytes[place] = rng.random();
            }
            fs::write(&path, &bytes).expect("writable");
            // Some damage has no effect; the program must only not end.
            refused += usize::from(read_frame(&path, &layout()).is_err());
        }
    }
    assert!(refused > 500, "{refused} of 1200");
}

#[test]
fn an_impossible_size_is_refused_before_decoding() {
    let dir = tempfile::tempdir().expect("a temporary directory");
    let path = dir.path().join("wide.exr");
    let width = MAX_SIDE + 1;
    write(&path, (width, 1), named([("R", half(vec![0.0; width]))]));
    assert!(refusal(&path).contains("its size is 32769x1"));
}

#[test]
fn missing_channels_are_named_with_those_present() {
    let dir = tempfile::tempdir().expect("a temporary directory");
    let path = dir.path().join("a.exr");
    let channels = scene_channels(SIZE.0, SIZE.1);
    write(
        &path,
        SIZE,
        channels
            .into_iter()
            .filter(|(name, _)| !name.starts_with("albedo2."))
            .collect(),
    );
    let message = refusal(&path);
    assert!(
        message.contains(
            "no channel albedo2.R, albedo2.G, albedo2.B; the file has B, G, R, albedo1.B"
        ),
        "{message}"
    );
}

#[test]
fn a_missing_channel_that_is_asked_for_twice_is_named_once() {
    let dir = tempfile::tempdir().expect("a temporary directory");
    let path = dir.path().join("a.exr");
    // The second texture copies it, too.
    let layout = ChannelLayout::resolve("mitsuba3").expect("a preset");
    write(&path, SIZE, scene_channels(SIZE.0, SIZE.1));
    let message = read_frame(&path, &layout)
        .expect_err("it has albedo1")
        .to_string();
    assert!(
        message.contains("no channel albedo.R, albedo.G, albedo.B; the file has"),
        "{message}"
    );
}

#[test]
fn buffers_of_different_sizes_are_refused() {
    let dir = tempfile::tempdir().expect("a temporary directory");
    let path = dir.path().join("a.exr");
    let color = part(
        Some("color"),
        SIZE,
        ZIP,
        named(["R", "G", "B"].map(|name| (name, half(vec![1.0; PIXELS])))),
    );
    let names = ["X", "Y", "Z"];
    let normal = part(
        Some("normal"),
        (6, 5),
        ZIP,
        named(names.map(|name| (name, half(vec![1.0; 30])))),
    );
    write_parts(&path, SIZE, vec![color, normal]);
    let layout = ChannelLayout::from_toml(
        "test",
        r#"
        color = ["color.R", "color.G", "color.B"]
        normal = ["normal.X", "normal.Y", "normal.Z"]
        missing = { position = "zeros", texture1 = "zeros", texture2 = "zeros" }
        "#,
    )
    .expect("a layout");
    let message = read_frame(&path, &layout)
        .expect_err("sizes differ")
        .to_string();
    assert!(
        message.ends_with("buffers of different sizes: color.R is 7x5, normal.X is 6x5"),
        "{message}"
    );
}

#[test]
fn nan_and_infinity_are_refused_with_their_place() {
    let dir = tempfile::tempdir().expect("a temporary directory");
    let path = dir.path().join("a.exr");
    for (channel, value) in [
        ("G", f32::INFINITY),
        ("position.Y", f32::NAN),
        ("ref.B", f32::NEG_INFINITY),
    ] {
        changed(&path, channel, |samples| match samples {
            FlatSamples::F16(samples) => {
                (samples[16], samples[30]) = (f16::from_f32(value), f16::from_f32(value))
            }
            FlatSamples::F32(samples) => (samples[16], samples[30]) = (value, value),
            FlatSamples::U32(_) => unreachable!("the layout has none"),
        });
        let expected =
            format!("channel {channel}: {value} at x 2, y 2 (2 NaN or infinite samples in all)");
        let message = refusal(&path);
        assert!(message.ends_with(&expected), "{message}");
        // The reference is no input of denoising.
        let bad = if channel == "ref.B" { 0 } else { 2 };
        let mut file = ExrFile::open(&path).expect("an EXR file");
        let (frame, repaired) = decode_repaired(&mut file, &layout()).expect("repaired");
        assert_eq!(repaired, bad, "{channel}");
        let mut values = frame.color.iter().chain(&frame.features);
        assert!(values.all(|x| x.is_finite()), "{channel}");
    }
}

/// LuxCore writes infinite positions where a camera ray hits nothing.
#[test]
fn three_infinite_coordinates_are_a_miss_and_fewer_are_refused() {
    let dir = tempfile::tempdir().expect("a temporary directory");
    let path = dir.path().join("a.exr");
    let infinite = |axes: &[&str]| {
        let mut channels = scene_channels(SIZE.0, SIZE.1);
        for (name, samples) in &mut channels {
            if axes.iter().any(|axis| *name == format!("position.{axis}")) {
                match samples {
                    FlatSamples::F16(samples) => samples[16] = f16::INFINITY,
                    FlatSamples::F32(samples) => samples[16] = f32::INFINITY,
                    FlatSamples::U32(_) => unreachable!("the layout has none"),
                }
            }
        }
        write(&path, SIZE, channels);
    };
    infinite(&["X", "Y", "Z"]);
    let frame = read_frame(&path, &layout()).expect("a miss");
    let position = [3, 4, 5].map(|channel| frame.features[channel * PIXELS + 16]);
    assert_eq!(position, [0.0; 3]);
    infinite(&["X", "Z"]);
    assert!(refusal(&path).contains("channel position.X: inf"));
}
