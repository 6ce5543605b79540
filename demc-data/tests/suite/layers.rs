//! Channels beside the colour: read, refused, and written with other values.

use std::path::Path;

use crate::support::files::{header, rgb_kinds, scene_kinds, write_file};
use crate::support::rewritten::{PIXELS, SIZE, color, planes};
use crate::support::{half, layout, named, write};
use demc_data::image::exr::ExrFile;
use demc_data::image::frame::layers::{check_layers, decode_layers};
use demc_data::image::plane::Plane;
use demc_data::image::rewrite::{Replaced, rewrite_with_layers};
use demc_data::{Error, OutputChannels, SamplePrecision, WriteOptions};
use exr::prelude::{Compression as Method, FlatSamples, SampleType};

fn names(names: &[&str]) -> Vec<String> {
    names.iter().map(|name| (*name).to_owned()).collect()
}

#[test]
fn layers_of_any_part_have_other_values_and_everything_else_stays() {
    let dir = tempfile::tempdir().expect("a temporary directory");
    let (input, output) = (dir.path().join("in.exr"), dir.path().join("out.exr"));
    let mut kinds = scene_kinds();
    kinds.push(("lamp.G".to_owned(), SampleType::F16));
    kinds.push(("A".to_owned(), SampleType::F16));
    let other = header(Some("diffuse"), SIZE, rgb_kinds(), Method::RLE);
    let id = vec![("id".to_owned(), SampleType::U32)];
    let third = header(Some("crypto"), SIZE, id, Method::ZIP1);
    let main = header(Some("main"), SIZE, kinds, Method::ZIP16);
    write_file(&input, vec![other, main, third]);
    let mut layout = layout();
    let prefixed = |name: &mut String| *name = format!("main.{name}");
    layout.color.iter_mut().for_each(prefixed);
    layout.alpha = Some("main.A".to_owned());
    let layers = names(&["main.lamp.G", "diffuse.B"]);
    for with_alpha in [false, true] {
        let mut values = color(PIXELS);
        let count = usize::from(with_alpha) + layers.len();
        values.extend((0..count * PIXELS).map(|i| -((i % 1021) as f32) / 4.0));
        let mut file = ExrFile::open(&input).expect("a file");
        let options = WriteOptions::default();
        let replaced = Replaced {
            layout: &layout,
            layers: &layers,
            added: &[],
            planes: &values,
        };
        rewrite_with_layers(&mut file, &replaced, &output, &options).expect("written");
        let alpha = with_alpha.then_some("main.A");
        let names: Vec<&str> = ["main.R", "main.G", "main.B"]
            .into_iter()
            .chain(alpha)
            .chain(layers.iter().map(String::as_str))
            .collect();
        for ((channel, before), (same, after)) in planes(&input).into_iter().zip(planes(&output)) {
            assert_eq!(channel, same);
            match names.iter().position(|name| *name == channel.name) {
                Some(plane) => {
                    let expected = &values[plane * PIXELS..][..PIXELS];
                    assert!(after.to_f32() == expected, "{}", channel.name);
                }
                None => assert!(before == after, "{} changed", channel.name),
            }
        }
    }
}

#[test]
fn only_colour_and_layers_stay_on_request_as_float() {
    let dir = tempfile::tempdir().expect("a temporary directory");
    let (input, output) = (dir.path().join("in.exr"), dir.path().join("out.exr"));
    let mut kinds = scene_kinds();
    kinds.push(("lamp.R".to_owned(), SampleType::F16));
    kinds.push(("sun.R".to_owned(), SampleType::F16));
    write_file(&input, vec![header(None, SIZE, kinds, Method::ZIP16)]);
    let mut values = color(PIXELS);
    values.extend((0..PIXELS).map(|i| 0.1 * i as f32));
    let options = WriteOptions {
        channels: OutputChannels::Color,
        precision: Some(SamplePrecision::Float),
        ..WriteOptions::default()
    };
    let mut file = ExrFile::open(&input).expect("a file");
    let replaced = Replaced {
        layout: &layout(),
        layers: &names(&["sun.R"]),
        added: &[],
        planes: &values,
    };
    rewrite_with_layers(&mut file, &replaced, &output, &options).expect("written");
    let after = planes(&output);
    let kept: Vec<&str> = after
        .iter()
        .map(|(channel, _)| channel.name.as_str())
        .collect();
    assert_eq!(kept, ["B", "G", "R", "sun.R"]);
    assert_eq!(after[3].1, Plane::Float(values[3 * PIXELS..].to_vec()));
}

#[test]
fn added_channels_stand_among_the_others_and_are_replaced_the_second_time() {
    let dir = tempfile::tempdir().expect("a temporary directory");
    let [input, output, again] =
        ["in.exr", "out.exr", "again.exr"].map(|name| dir.path().join(name));
    write_file(
        &input,
        vec![header(None, SIZE, scene_kinds(), Method::ZIP16)],
    );
    let added = ["extra.B", "zz"];
    let write = |from: &Path, to: &Path, added: &[&str], values: &[f32]| {
        let mut file = ExrFile::open(from).expect("a file");
        let replaced = Replaced {
            layout: &layout(),
            layers: &[],
            added,
            planes: values,
        };
        rewrite_with_layers(&mut file, &replaced, to, &WriteOptions::default())
    };
    let mut values = color(PIXELS);
    values.extend((0..2 * PIXELS).map(|i| 0.1 * i as f32));
    write(&input, &output, &added, &values).expect("written");
    let (before, after) = (planes(&input), planes(&output));
    assert_eq!(after.len(), before.len() + 2);
    assert!(after.is_sorted_by_key(|(channel, _)| channel.name.clone()));
    let (new, old): (Vec<_>, Vec<_>) = after
        .into_iter()
        .partition(|(channel, _)| added.contains(&channel.name.as_str()));
    for (index, (_, plane)) in new.into_iter().enumerate() {
        let expected = &values[(3 + index) * PIXELS..][..PIXELS];
        assert_eq!(plane, Plane::Float(expected.to_vec()));
    }
    for ((channel, before), (_, after)) in before.into_iter().zip(old) {
        let is_color = ["R", "G", "B"].contains(&channel.name.as_str());
        assert!(is_color || before == after, "{} changed", channel.name);
    }

    values.iter_mut().for_each(|value| *value += 1.0);
    write(&output, &again, &added, &values).expect("written");
    let names = |path| -> Vec<String> {
        let planes = planes(path).into_iter();
        planes.map(|(channel, _)| channel.name.clone()).collect()
    };
    assert_eq!(names(&again), names(&output));
    let (_, last) = planes(&again).pop().expect("channels");
    assert_eq!(last, Plane::Float(values[4 * PIXELS..].to_vec()));
    let mixed = write(&output, &again, &["zz", "zzz"], &values);
    assert!(
        matches!(mixed, Err(Error::MissingChannels { .. })),
        "{mixed:?}"
    );
}

fn refusal(path: &Path, names: &[String]) -> String {
    let file = ExrFile::open(path).expect("a file");
    let error = check_layers(&file, &layout(), names).expect_err("refused");
    error.to_string().replace(&path.display().to_string(), "IN")
}

#[test]
fn channels_that_are_no_layers_are_named_with_the_reason() {
    let dir = tempfile::tempdir().expect("a temporary directory");
    let input = dir.path().join("in.exr");
    let mut kinds = scene_kinds();
    kinds.push(("id".to_owned(), SampleType::U32));
    write_file(&input, vec![header(None, SIZE, kinds, Method::ZIP16)]);
    for (name, expected) in [
        (
            "id",
            "IN: channel id is no layer: its type is uint, not half or float",
        ),
        (
            "normal.Y",
            "IN: channel normal.Y is no layer: it is the normal that the network sees",
        ),
        (
            "albedo1.R",
            "IN: channel albedo1.R is no layer: it is the texture1 that the network sees",
        ),
        (
            "G",
            "IN: channel G is no layer: it is the colour that the network sees",
        ),
    ] {
        assert_eq!(refusal(&input, &names(&["mask.A", name])), expected);
    }
    assert!(
        refusal(&input, &names(&["lamp.R"])).starts_with("IN: no channel lamp.R; the file has")
    );

    let parts = vec![
        header(None, SIZE, scene_kinds(), Method::ZIP16),
        header(Some("small"), (8, 4), rgb_kinds(), Method::ZIP16),
    ];
    write_file(&input, parts);
    assert_eq!(
        refusal(&input, &names(&["small.R"])),
        "IN: buffers of different sizes: R is 37x45, small.R is 8x4"
    );
}

#[test]
fn bad_samples_of_a_layer_are_refused_or_repaired_and_negative_ones_kept() {
    let dir = tempfile::tempdir().expect("a temporary directory");
    let input = dir.path().join("in.exr");
    let lamp: Vec<f32> = [vec![-1.0, f32::NAN], vec![-3.0; 14]].concat();
    let flat = |x: f32| half(vec![x; 16]);
    let channels = named([
        ("R", flat(0.5)),
        ("G", flat(0.5)),
        ("B", flat(0.5)),
        ("lamp.R", FlatSamples::F32(lamp)),
        ("sun.R", flat(-0.25)),
    ]);
    write(&input, (4, 4), channels);
    let decode = |repair: bool| {
        let mut file = ExrFile::open(&input).expect("a file");
        decode_layers(&mut file, &layout(), &names(&["sun.R", "lamp.R"]), repair)
    };
    match decode(false) {
        Err(Error::NonFinite {
            channel,
            x,
            y,
            count,
            ..
        }) => assert_eq!((&*channel, x, y, count), ("lamp.R", 1, 0, 1)),
        other => panic!("{other:?}"),
    }
    let (layers, repaired) = decode(true).expect("repaired");
    assert_eq!(repaired, 1);
    let mended = [vec![-1.0], vec![-3.0; 15]].concat();
    assert_eq!(layers, [vec![-0.25; 16], mended]);
}
