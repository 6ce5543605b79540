//! Reads EXR files of every supported kind.

use crate::support::{ZIP, half, layout, named, part, sample, scene_channels, write, write_parts};
use demc_data::image::exr::ExrFile;
use demc_data::image::layout::Missing;
use demc_data::image::plane::Plane;
use demc_data::{Error, FEATURES, read_frame};
use exr::prelude::*;

const SIZE: (usize, usize) = (7, 5);
const PIXELS: usize = 35;

#[test]
fn the_sample_reads_whole_and_finite() {
    let frame = read_frame(&sample().join("train/col-ashtray-0.exr"), &layout())
        .expect("the sample is sound");
    assert_eq!(
        (frame.name.as_str(), frame.width, frame.height),
        ("col-ashtray-0", 224, 224)
    );
    assert_eq!(frame.color.len(), 3 * 224 * 224);
    assert_eq!(frame.features.len(), FEATURES * 224 * 224);
    assert_eq!(frame.reference.map(|r| r.len()), Some(3 * 224 * 224));
    let mask = frame.mask.expect("the sample has masks");
    assert!(mask.iter().all(|share| (0.0..=1.0).contains(share)));
    // The renders are scaled to a mean luminance of about 0.2 (data/sample/manifest.json).
    let mean = frame.color.iter().sum::<f32>() / frame.color.len() as f32;
    assert!((0.02..2.0).contains(&mean), "{mean}");
}

#[test]
fn channels_land_in_the_networks_order() {
    let dir = tempfile::tempdir().expect("a temporary directory");
    let path = dir.path().join("a.exr");
    write(&path, SIZE, scene_channels(SIZE.0, SIZE.1));
    let frame = read_frame(&path, &layout()).expect("sound");
    for (channel, plane) in frame
        .color
        .chunks_exact(PIXELS)
        .chain(frame.features.chunks_exact(PIXELS))
        .enumerate()
    {
        assert_eq!(plane[0], channel as f32, "channel {channel}");
        assert!(
            (plane[PIXELS - 1] - channel as f32 - 34.0 / 35.0).abs() < 0.01,
            "channel {channel}"
        );
    }
    assert_eq!(frame.reference.expect("it is there")[0], 15.0);
}

#[test]
fn half_float_and_uint_keep_their_precision() {
    let dir = tempfile::tempdir().expect("a temporary directory");
    let path = dir.path().join("kinds.exr");
    let float: Vec<f32> = (0..PIXELS).map(|i| 1.0 + i as f32 * 1e-7).collect();
    let uint: Vec<u32> = (0..PIXELS as u32).map(|i| i * 1_000_003).collect();
    let channels = named([
        ("h", half((0..PIXELS).map(|i| i as f32))),
        ("f", FlatSamples::F32(float.clone())),
        ("u", FlatSamples::U32(uint.clone())),
    ]);
    write(&path, SIZE, channels);
    let planes = ExrFile::open(&path)
        .and_then(|mut file| file.read(&["u", "h", "f"]))
        .expect("sound");
    assert_eq!(planes[0], Plane::Uint(uint));
    assert_eq!(
        planes[1].to_f32(),
        (0..PIXELS).map(|i| i as f32).collect::<Vec<_>>()
    );
    assert_eq!(planes[2], Plane::Float(float));
}

#[test]
fn tiles_and_every_compression_read_the_same() {
    let dir = tempfile::tempdir().expect("a temporary directory");
    let path = dir.path().join("a.exr");
    write(&path, (40, 33), scene_channels(40, 33));
    let expected = read_frame(&path, &layout()).expect("sound");
    for compression in [
        Compression::Uncompressed,
        Compression::RLE,
        Compression::ZIP1,
        Compression::PIZ,
    ] {
        for blocks in [Blocks::ScanLines, Blocks::Tiles(Vec2(16, 16))] {
            let encoding = Encoding {
                compression,
                blocks,
                line_order: LineOrder::Increasing,
            };
            let layer = part(None, (40, 33), encoding, scene_channels(40, 33));
            Image::from_layer(layer)
                .write()
                .to_file(&path)
                .expect("writable");
            assert_eq!(
                read_frame(&path, &layout()).expect("sound"),
                expected,
                "{compression:?} {blocks:?}"
            );
        }
    }
}

#[test]
fn channels_of_a_layer_are_addressed_by_its_name() {
    let dir = tempfile::tempdir().expect("a temporary directory");
    let path = dir.path().join("layers.exr");
    // Named as in `demc-exr`, with each buffer in its own part.
    let parts = ["normal", "position", "albedo1", "albedo2", "ref", "mask"].map(|name| {
        let prefix = format!("{name}.");
        let channels = scene_channels(SIZE.0, SIZE.1).into_iter();
        let own = channels
            .filter_map(|(channel, s)| Some((channel.strip_prefix(&prefix)?.to_owned(), s)));
        part(Some(name), SIZE, ZIP, own.collect())
    });
    let color = scene_channels(SIZE.0, SIZE.1).into_iter().take(3).collect();
    let mut parts = Vec::from(parts);
    parts.insert(2, part(Some("beauty"), SIZE, ZIP, color));
    write_parts(&path, SIZE, parts);
    let mut layout = layout();
    layout.color = ["R", "G", "B"].map(|name| format!("beauty.{name}"));
    let layers = read_frame(&path, &layout).expect("all channels are there");
    let single = dir.path().join("layers_single.exr");
    write(&single, SIZE, scene_channels(SIZE.0, SIZE.1));
    let single = read_frame(&single, &crate::support::layout()).expect("sound");
    assert_eq!(
        (layers.color, layers.features),
        (single.color, single.features)
    );
}

#[test]
fn a_missing_buffer_follows_the_stated_policy() {
    let dir = tempfile::tempdir().expect("a temporary directory");
    let path = dir.path().join("a.exr");
    let channels: Vec<_> = scene_channels(SIZE.0, SIZE.1);
    let keep = |left_out: &[&str]| -> Vec<_> {
        channels
            .iter()
            .filter(|(name, _)| !left_out.contains(&name.as_str()))
            .cloned()
            .collect()
    };
    let mut layout = layout();
    layout.missing.texture2 = Missing::CopyTexture1;
    write(&path, SIZE, keep(&["albedo2.R", "albedo2.G", "albedo2.B"]));
    let features = read_frame(&path, &layout)
        .expect("a policy is stated")
        .features;
    assert_eq!(features[9 * PIXELS..], features[6 * PIXELS..9 * PIXELS]);

    layout.missing.texture2 = Missing::Zeros;
    let features = read_frame(&path, &layout)
        .expect("a policy is stated")
        .features;
    assert!(features[9 * PIXELS..].iter().all(|&sample| sample == 0.0));
    assert_eq!(features[8 * PIXELS], 11.0);

    // A partly present buffer is a mistake, not a missing buffer.
    write(&path, SIZE, keep(&["albedo2.G"]));
    assert!(
        matches!(read_frame(&path, &layout), Err(Error::MissingChannels { missing, .. }) if missing == ["albedo2.G"])
    );
}

#[test]
fn an_image_to_denoise_needs_neither_reference_nor_mask() {
    let dir = tempfile::tempdir().expect("a temporary directory");
    let path = dir.path().join("a.exr");
    let channels = scene_channels(SIZE.0, SIZE.1).into_iter();
    write(
        &path,
        SIZE,
        channels
            .filter(|(name, _)| !name.starts_with("ref.") && name != "mask.A")
            .collect(),
    );
    let frame = read_frame(&path, &layout()).expect("features are there");
    assert_eq!((frame.reference, frame.mask), (None, None));
}

#[test]
fn negative_radiance_is_clamped_and_counted_and_features_are_not() {
    let dir = tempfile::tempdir().expect("a temporary directory");
    let path = dir.path().join("a.exr");
    let mut channels = scene_channels(SIZE.0, SIZE.1);
    for (name, samples) in &mut channels {
        if ["R", "ref.G", "normal.X"].contains(&name.as_str()) {
            *samples = half((0..PIXELS).map(|i| if i < 2 { -1.0 } else { 1.0 }));
        }
    }
    write(&path, SIZE, channels);
    let frame = read_frame(&path, &layout()).expect("clamped, not refused");
    assert_eq!(frame.clamped, 4);
    assert_eq!(frame.color[..3], [0.0, 0.0, 1.0]);
    assert_eq!(frame.features[..3], [-1.0, -1.0, 1.0]);
}
