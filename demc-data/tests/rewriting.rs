//! Denoised images in the layout of their input: what changes and that nothing else does.

mod support;

use std::fs::{self, File};
use std::io::BufReader;
use std::path::Path;

use demc_data::channel::Channel;
use demc_data::exr::ExrFile;
use demc_data::plane::Plane;
use demc_data::{
    Change, ChannelLayout, Compression, Error, Keep, Precision, WriteOptions, Written,
    write_denoised,
};
use exr::math::RoundingMode;
use exr::meta::MetaData;
use exr::meta::attribute::{Chromaticities, IntegerBounds, LevelMode, TimeCode};
use exr::meta::header::Header;
use exr::prelude::{AttributeValue, Compression as Method, LineOrder, SampleType, Text, Vec2};
use support::files::{header, placed, rgb_kinds, scene_kinds, tiled, write_file};
use support::{layout, sample};

const SIZE: (usize, usize) = (37, 45);
const PIXELS: usize = SIZE.0 * SIZE.1;

/// A denoised colour that half holds exactly.
fn color(pixels: usize) -> Vec<f32> {
    (0..3 * pixels).map(|i| (i % 2039) as f32 / 8.0).collect()
}

fn rewrite(input: &Path, output: &Path, options: &WriteOptions) -> Written {
    write_denoised(input, &layout(), &color(PIXELS), output, options)
        .unwrap_or_else(|error| panic!("{error}"))
}

fn headers(path: &Path) -> Vec<Header> {
    let meta = MetaData::read_from_file(path, false).expect("readable");
    meta.headers.to_vec()
}

fn planes(path: &Path) -> Vec<(Channel, Plane)> {
    let file = ExrFile::open(path).unwrap_or_else(|error| panic!("{error}"));
    let channels = file.channels().to_vec();
    let names: Vec<&str> = channels.iter().map(|c| c.name.as_str()).collect();
    let planes = file.read(&names).unwrap_or_else(|error| panic!("{error}"));
    channels.clone().into_iter().zip(planes).collect()
}

/// Checks that `output` has the channels of `input`, of the same types and bits, but for its colour.
fn assert_carried(input: &Path, output: &Path, what: &str) {
    let (before, after) = (planes(input), planes(output));
    assert_eq!(before.len(), after.len(), "{what}");
    for ((channel, old), (same, new)) in before.into_iter().zip(after) {
        assert_eq!(channel, same, "{what}");
        let plane = ["R", "G", "B"]
            .iter()
            .position(|name| channel.name == *name);
        match plane {
            None => assert!(old == new, "{what}: {} changed", channel.name),
            Some(plane) => {
                let pixels = channel.window.width * channel.window.height;
                let expected = &color(pixels)[plane * pixels..][..pixels];
                assert!(new.to_f32() == expected, "{what}: {}", channel.name);
            }
        }
    }
}

/// The channels that these compressions change.
fn changes(method: Method) -> bool {
    matches!(
        method,
        Method::PXR24 | Method::B44 | Method::B44A | Method::DWAA(_) | Method::DWAB(_)
    )
}

#[test]
fn every_compression_and_block_shape_is_carried_over() {
    let dir = tempfile::tempdir().expect("a temporary directory");
    let (input, output) = (dir.path().join("in.exr"), dir.path().join("out.exr"));
    for compression in Compression::ALL {
        for tiles in [false, true] {
            let method = method(compression);
            let mut part = header(None, SIZE, scene_kinds(), method);
            if tiles {
                part = tiled(part, LevelMode::Singular, RoundingMode::Down);
            }
            write_file(&input, vec![part]);
            let what = format!("{compression}, tiles {tiles}");
            let written = rewrite(&input, &output, &WriteOptions::default());
            assert_carried(&input, &output, &what);
            let (before, after) = (&headers(&input)[0], &headers(&output)[0]);
            assert_eq!(before.blocks, after.blocks, "{what}");
            let changed = Change::Compression {
                part: String::new(),
                from: compression.name(),
                to: Compression::Zip,
            };
            match changes(method) {
                true => {
                    assert_eq!(after.compression, Method::ZIP16, "{what}");
                    assert_eq!(written.changes, [changed], "{what}");
                }
                false => {
                    assert_eq!(before, after, "{what}");
                    assert_eq!(written, Written::default(), "{what}");
                }
            }
        }
    }
}

fn method(compression: Compression) -> Method {
    match compression {
        Compression::None => Method::Uncompressed,
        Compression::Rle => Method::RLE,
        Compression::Zips => Method::ZIP1,
        Compression::Zip => Method::ZIP16,
        Compression::Piz => Method::PIZ,
        Compression::Pxr24 => Method::PXR24,
        Compression::B44 => Method::B44,
        Compression::B44a => Method::B44A,
        Compression::Dwaa => Method::DWAA(None),
        Compression::Dwab => Method::DWAB(None),
    }
}

#[test]
fn a_lossy_compression_stays_where_there_is_nothing_else_to_lose() {
    let dir = tempfile::tempdir().expect("a temporary directory");
    let (input, output) = (dir.path().join("in.exr"), dir.path().join("out.exr"));
    write_file(
        &input,
        vec![header(None, SIZE, rgb_kinds(), Method::DWAA(Some(20.0)))],
    );
    let written = rewrite(&input, &output, &WriteOptions::default());
    assert_eq!(written.changes, []);
    assert_eq!(headers(&output)[0].compression, Method::DWAA(Some(20.0)));
}

#[test]
fn the_sample_keeps_header_and_channels() {
    let dir = tempfile::tempdir().expect("a temporary directory");
    let output = dir.path().join("out.exr");
    for name in ["col-ashtray-0.exr", "col-bathroom-0.exr"] {
        let input = sample().join("train").join(name);
        let pixels = 224 * 224;
        let written = write_denoised(
            &input,
            &layout(),
            &color(pixels),
            &output,
            &WriteOptions::default(),
        )
        .expect("sound");
        assert_eq!(written, Written::default());
        assert_eq!(headers(&input), headers(&output));
        assert_carried(&input, &output, name);
    }
}

/// Attributes of every sort: standard, shared by parts, of unknown types.
fn with_attributes(mut header: Header) -> Header {
    let own = &mut header.own_attributes;
    own.software_name = Some("a renderer 1.0".into());
    own.white_luminance = Some(120.0);
    own.screen_window_center = Vec2(0.25, -0.5);
    let json = r#"{"spp": 4, "scene": "Küche"}"#;
    let text = AttributeValue::Text(Text::from_bytes_unchecked(json.as_bytes().into()));
    own.other.insert("demc".into(), text);
    let bytes = AttributeValue::Custom {
        kind: "stringvectorvector".into(),
        bytes: vec![1, 0, 255, 3].into(),
    };
    own.other.insert("renderer/passes".into(), bytes);
    let shared = &mut header.shared_attributes;
    shared.pixel_aspect = 1.5;
    shared.chromaticities = Some(Chromaticities {
        red: Vec2(0.64, 0.33),
        green: Vec2(0.3, 0.6),
        blue: Vec2(0.15, 0.06),
        white: Vec2(0.3127, 0.329),
    });
    shared.time_code = Some(TimeCode::from_tv60_time(0x0102_0304, 5));
    header
}

fn display() -> IntegerBounds {
    IntegerBounds::new((-10, -20), (200, 100))
}

#[test]
fn parts_windows_and_attributes_are_the_inputs() {
    let dir = tempfile::tempdir().expect("a temporary directory");
    let (input, output) = (dir.path().join("in.exr"), dir.path().join("out.exr"));
    let part = |name, size, kinds, method| with_attributes(header(Some(name), size, kinds, method));
    let ids = vec![("id".to_owned(), SampleType::U32)];
    let depth = vec![("Z".to_owned(), SampleType::F32)];
    let parts = vec![
        placed(
            part("ids", (20, 11), ids, Method::PXR24),
            (5, -7),
            display(),
        ),
        placed(
            part("rgba", SIZE, scene_kinds(), Method::PIZ),
            (-4, 9),
            display(),
        ),
        placed(
            tiled(
                part("depth", SIZE, depth, Method::B44A),
                LevelMode::RipMap,
                RoundingMode::Up,
            ),
            (0, 0),
            display(),
        ),
        placed(
            part("dct", SIZE, rgb_kinds(), Method::DWAB(None)),
            (-4, 9),
            display(),
        ),
    ];
    write_file(&input, parts);
    let mut named = layout();
    let name = |name: &mut String| *name = format!("rgba.{name}");
    named.color.iter_mut().for_each(name);
    let rewritten = write_denoised(
        &input,
        &named,
        &color(PIXELS),
        &output,
        &WriteOptions::default(),
    );
    assert_eq!(rewritten.expect("sound"), Written::default());
    assert_eq!(headers(&input), headers(&output));
    for ((channel, old), (same, new)) in planes(&input).into_iter().zip(planes(&output)) {
        assert_eq!(channel, same);
        let replaced = named.color.contains(&channel.name);
        assert_eq!(old == new, !replaced, "{}", channel.name);
    }
    // Its own blocks, smaller levels and all: nothing of a part without colour was decoded.
    for part in [0, 2, 3] {
        assert!(blocks(&input, part) == blocks(&output, part));
    }
}

/// The blocks of a part as they are stored.
fn blocks(path: &Path, part: usize) -> Vec<String> {
    let file = BufReader::new(File::open(path).expect("readable"));
    let chunks = exr::block::read(file, false).and_then(|file| file.all_chunks(false));
    let chunks = chunks.expect("readable").map(|chunk| chunk.expect("whole"));
    let of_part = chunks.filter(|chunk| chunk.layer_index == part);
    let blocks: Vec<String> = of_part.map(|chunk| format!("{chunk:?}")).collect();
    assert!(!blocks.is_empty());
    blocks
}

#[test]
fn only_colour_and_its_alpha_stay_on_request() {
    let dir = tempfile::tempdir().expect("a temporary directory");
    let (input, output) = (dir.path().join("in.exr"), dir.path().join("out.exr"));
    let mut kinds = scene_kinds();
    kinds.push(("A".to_owned(), SampleType::F16));
    kinds.push(("fog.A".to_owned(), SampleType::F16));
    let other = header(Some("other"), SIZE, rgb_kinds(), Method::RLE);
    let main = placed(
        header(Some("main"), SIZE, kinds, Method::ZIP1),
        (3, 4),
        display(),
    );
    let other = placed(other, (3, 4), display());
    write_file(&input, vec![other, with_attributes(main)]);
    let mut named = layout();
    named
        .color
        .iter_mut()
        .for_each(|name| *name = format!("main.{name}"));
    let options = WriteOptions {
        channels: Keep::Color,
        ..WriteOptions::default()
    };
    write_denoised(&input, &named, &color(PIXELS), &output, &options).expect("sound");
    let after = planes(&output);
    let names: Vec<&str> = after
        .iter()
        .map(|(channel, _)| channel.name.as_str())
        .collect();
    assert_eq!(names, ["A", "B", "G", "R"]);
    assert_eq!(after[3].1.to_f32(), color(PIXELS)[..PIXELS]);
    let before = planes(&input);
    let alpha = before.iter().find(|(channel, _)| channel.name == "main.A");
    assert!(alpha.expect("written before").1 == after[0].1);
    // One part of two, with everything else that it had.
    let (before, after) = (&headers(&input)[1], &headers(&output)[0]);
    let channels = after.channels.clone();
    assert_eq!(
        *after,
        Header {
            channels,
            ..before.clone()
        }
    );
}

#[test]
fn smaller_levels_of_the_colour_are_left_out_and_said() {
    let dir = tempfile::tempdir().expect("a temporary directory");
    let (input, output) = (dir.path().join("in.exr"), dir.path().join("out.exr"));
    for levels in [LevelMode::MipMap, LevelMode::RipMap] {
        for rounding in [RoundingMode::Down, RoundingMode::Up] {
            let part = header(None, SIZE, scene_kinds(), Method::ZIP16);
            write_file(&input, vec![tiled(part, levels, rounding)]);
            let written = rewrite(&input, &output, &WriteOptions::default());
            let part = String::new();
            assert_eq!(written.changes, [Change::Levels { part }]);
            assert_eq!(
                written.changes[0].to_string(),
                "written without its smaller levels"
            );
            assert_carried(&input, &output, &format!("{levels:?} {rounding:?}"));
        }
    }
}

#[test]
fn lines_keep_their_order_in_the_file() {
    let dir = tempfile::tempdir().expect("a temporary directory");
    let (input, output) = (dir.path().join("in.exr"), dir.path().join("out.exr"));
    for method in [Method::ZIP1, Method::PIZ] {
        let mut part = header(None, SIZE, scene_kinds(), method);
        part.line_order = LineOrder::Decreasing;
        write_file(&input, vec![part]);
        for compression in [None, Some(Compression::Zip), Some(Compression::Dwab)] {
            let options = WriteOptions {
                compression,
                ..WriteOptions::default()
            };
            rewrite(&input, &output, &options);
            assert_eq!(headers(&output)[0].line_order, LineOrder::Decreasing);
            if compression != Some(Compression::Dwab) {
                assert_carried(&input, &output, &format!("{method} to {compression:?}"));
            }
        }
    }
}

#[test]
fn the_chosen_precision_wins_and_what_half_cannot_hold_is_counted() {
    let dir = tempfile::tempdir().expect("a temporary directory");
    let (input, output) = (dir.path().join("in.exr"), dir.path().join("out.exr"));
    let mut bright = color(PIXELS);
    (bright[3], bright[PIXELS + 4], bright[5]) = (65519.9, 1e9, f32::INFINITY);
    let kinds = [
        (SampleType::F16, None, SampleType::F16),
        (SampleType::F32, None, SampleType::F32),
        (SampleType::U32, None, SampleType::F32),
        (SampleType::F32, Some(Precision::Half), SampleType::F16),
        (SampleType::F16, Some(Precision::Float), SampleType::F32),
    ];
    for (before, precision, after) in kinds {
        let mut kinds = scene_kinds();
        let color = kinds
            .iter_mut()
            .filter(|(name, _)| ["R", "G", "B"].contains(&name.as_str()));
        color.for_each(|(_, kind)| *kind = before);
        write_file(&input, vec![header(None, SIZE, kinds, Method::ZIP16)]);
        let options = WriteOptions {
            precision,
            ..WriteOptions::default()
        };
        let written = write_denoised(&input, &layout(), &bright, &output, &options);
        let half = after == SampleType::F16;
        assert_eq!(written.expect("sound").clamped, if half { 3 } else { 0 });
        let read = ExrFile::open(&output).and_then(|file| file.read(&["R", "G", "B"]));
        let read: Vec<f32> = read
            .expect("sound")
            .iter()
            .flat_map(Plane::to_f32)
            .collect();
        let expected = bright
            .iter()
            .map(|&v| if half { v.min(65504.0) } else { v });
        assert!(read.into_iter().eq(expected), "{before:?} to {after:?}");
        let after_kinds = &headers(&output)[0].channels.list;
        assert!(
            after_kinds
                .iter()
                .all(|c| !["R", "G", "B"].map(Text::from).contains(&c.name)
                    || c.sample_type == after)
        );
    }
}

#[test]
fn a_chosen_compression_is_taken_and_its_losses_are_said() {
    let dir = tempfile::tempdir().expect("a temporary directory");
    let (input, output) = (dir.path().join("in.exr"), dir.path().join("out.exr"));
    write_file(
        &input,
        vec![header(Some("main"), SIZE, scene_kinds(), Method::PIZ)],
    );
    for to in Compression::ALL {
        let options = WriteOptions {
            compression: Some(to),
            ..WriteOptions::default()
        };
        let written = rewrite(&input, &output, &options);
        assert_eq!(Some(headers(&output)[0].compression), Some(method(to)));
        if changes(method(to)) {
            let part = "main".to_owned();
            assert_eq!(written.changes, [Change::Lossy { part, to }]);
            assert_eq!(
                written.changes[0].to_string(),
                format!("part main: compressed with {to}, which changes the other channels too")
            );
        } else {
            assert_eq!(written, Written::default());
            assert_carried(&input, &output, to.name());
        }
    }
}

#[test]
fn an_input_that_cannot_be_carried_over_is_named_and_the_output_left_alone() {
    let dir = tempfile::tempdir().expect("a temporary directory");
    let (input, output) = (dir.path().join("in.exr"), dir.path().join("out.exr"));
    fs::write(&output, "old").expect("writable");
    write_file(
        &input,
        vec![header(None, SIZE, scene_kinds(), Method::ZIP16)],
    );
    let denoise = |layout: &ChannelLayout, pixels: usize| -> Error {
        let options = WriteOptions::default();
        write_denoised(&input, layout, &color(pixels), &output, &options).expect_err("refused")
    };
    let name = |error: &Error| {
        error
            .to_string()
            .replace(&input.display().to_string(), "IN")
    };

    let error = denoise(&layout(), 12);
    assert!(name(&error).ends_with("36 samples of colour do not fit into 37x45, its size now"));
    let mut other = layout();
    other.color[1] = "beauty.G".to_owned();
    assert!(name(&denoise(&other, PIXELS)).starts_with("IN: no channel beauty.G; the file has B,"));

    let whole = fs::read(&input).expect("just written");
    for length in [whole.len() - 1, whole.len() / 2, 1500, 300, 0] {
        fs::write(&input, &whole[..length]).expect("writable");
        let error = name(&denoise(&layout(), PIXELS));
        assert!(
            error.starts_with("IN: not a readable OpenEXR file: "),
            "{error}"
        );
        assert!(!error.contains('\n'), "{error}");
    }
    assert_eq!(fs::read(&output).expect("it is"), b"old");
    assert_eq!(fs::read_dir(dir.path()).expect("readable").count(), 2);
}

#[test]
fn an_input_may_be_its_own_output() {
    let dir = tempfile::tempdir().expect("a temporary directory");
    let (input, copy) = (dir.path().join("in.exr"), dir.path().join("copy.exr"));
    write_file(
        &input,
        vec![header(None, SIZE, scene_kinds(), Method::ZIP16)],
    );
    fs::copy(&input, &copy).expect("writable");
    rewrite(&input, &input, &WriteOptions::default());
    assert_carried(&copy, &input, "in place");
}
