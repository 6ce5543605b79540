//! Inputs for rewriting, and checks of the output.

use std::path::Path;

use demc_data::image::channel::Channel;
use demc_data::image::exr::ExrFile;
use demc_data::image::plane::Plane;
use demc_data::{Compression, WriteOptions, Written, write_denoised};
use exr::meta::MetaData;
use exr::meta::attribute::{Chromaticities, IntegerBounds, TimeCode};
use exr::meta::header::Header;
use exr::prelude::{AttributeValue, Compression as Method, Text, Vec2};

use super::layout;

pub const SIZE: (usize, usize) = (37, 45);
pub const PIXELS: usize = SIZE.0 * SIZE.1;

/// A denoised colour that is exact in half.
pub fn color(pixels: usize) -> Vec<f32> {
    (0..3 * pixels).map(|i| (i % 2039) as f32 / 8.0).collect()
}

pub fn rewrite(input: &Path, output: &Path, options: &WriteOptions) -> Written {
    write_denoised(input, &layout(), &color(PIXELS), output, options)
        .unwrap_or_else(|error| panic!("{error}"))
}

pub fn headers(path: &Path) -> Vec<Header> {
    let meta = MetaData::read_from_file(path, false).expect("readable");
    meta.headers.to_vec()
}

pub fn planes(path: &Path) -> Vec<(Channel, Plane)> {
    let mut file = ExrFile::open(path).unwrap_or_else(|error| panic!("{error}"));
    let channels = file.channels().to_vec();
    let names: Vec<&str> = channels.iter().map(|c| c.name.as_str()).collect();
    let planes = file.read(&names).unwrap_or_else(|error| panic!("{error}"));
    channels.clone().into_iter().zip(planes).collect()
}

/// Checks that `output` has the channels of `input`, with the same types and bits, except for its
/// colour.
pub fn assert_carried(input: &Path, output: &Path, what: &str) {
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
pub fn changes(method: Method) -> bool {
    matches!(
        method,
        Method::PXR24 | Method::B44 | Method::B44A | Method::DWAA(_) | Method::DWAB(_)
    )
}

pub fn method(compression: Compression) -> Method {
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

/// Attributes of every kind: standard ones, those shared by all parts, and unknown types.
pub fn with_attributes(mut header: Header) -> Header {
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
    // As OpenEXR's library writes it: the `exr` crate leaves one of the seven numbers out.
    let key_code = AttributeValue::Custom {
        kind: "keycode".into(),
        bytes: (1..=7).flat_map(i32::to_le_bytes).collect(),
    };
    own.other.insert("keyCode".into(), key_code);
    for index in 0..8 {
        let number = AttributeValue::I32(index);
        own.other
            .insert(format!("x{index}").as_str().into(), number);
    }
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

pub fn display() -> IntegerBounds {
    IntegerBounds::new((-10, -20), (200, 100))
}
