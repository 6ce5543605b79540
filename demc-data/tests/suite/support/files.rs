//! Files of every kind of the format, block by block: tiles, smaller levels, windows, attributes.

use std::fs::File;
use std::io::BufWriter;
use std::path::Path;

use exr::block::writer::ChunksWriter;
use exr::block::{BlockIndex, UncompressedBlock};
use exr::math::RoundingMode;
use exr::meta::attribute::{ChannelList, IntegerBounds, LevelMode, TileDescription};
use exr::meta::header::Header;
use exr::meta::{BlockDescription, Headers};
use exr::prelude::*;

/// The channels of the `demc-exr` layout with their types: position and mask are `float`, the rest
/// `half`.
pub fn scene_kinds() -> Vec<(String, SampleType)> {
    let channels = super::scene_channels(1, 1).into_iter();
    let kinds = channels.map(|(name, _)| {
        let float = name.starts_with("position") || name == "mask.A";
        let kind = if float {
            SampleType::F32
        } else {
            SampleType::F16
        };
        (name, kind)
    });
    kinds.collect()
}

/// Three channels `R G B` of `half`.
pub fn rgb_kinds() -> Vec<(String, SampleType)> {
    ["R", "G", "B"]
        .map(|name| (name.to_owned(), SampleType::F16))
        .into()
}

/// A part of scan lines at the origin.
pub fn header(
    name: Option<&str>,
    size: (usize, usize),
    channels: Vec<(String, SampleType)>,
    compression: Compression,
) -> Header {
    let mut channels: Vec<ChannelDescription> = channels
        .iter()
        .map(|(name, kind)| ChannelDescription::named(name.as_str(), *kind))
        .collect();
    channels.sort_by(|a, b| a.name.cmp(&b.name));
    let header = Header::new("".into(), size, channels.into_iter().collect());
    let attributes = LayerAttributes {
        layer_name: name.map(Text::from),
        ..Default::default()
    };
    header.with_attributes(attributes).with_encoding(
        compression,
        BlockDescription::ScanLines,
        LineOrder::Increasing,
    )
}

/// The same part in tiles of 16x16 pixels.
pub fn tiled(header: Header, level_mode: LevelMode, rounding_mode: RoundingMode) -> Header {
    let tiles = TileDescription {
        tile_size: Vec2(16, 16),
        level_mode,
        rounding_mode,
    };
    let compression = header.compression;
    header.with_encoding(
        compression,
        BlockDescription::Tiles(tiles),
        LineOrder::Increasing,
    )
}

/// The same part at another position in a larger picture.
pub fn placed(header: Header, corner: (i32, i32), display: IntegerBounds) -> Header {
    header
        .with_position(Vec2(corner.0, corner.1))
        .with_display_window(display)
}

/// A sample that identifies part, channel and pixel; all are exact in half.
pub fn sample(part: usize, channel: usize, (x, y): (usize, usize)) -> f32 {
    (part * 512 + channel * 16) as f32 + ((x * 7 + y * 13) % 64) as f32 / 4.0
}

/// Writes a file whose samples are [`sample`]'s; those of smaller levels are negative.
pub fn write_file(path: &Path, headers: Vec<Header>) {
    let file = BufWriter::new(File::create(path).expect("a writable directory"));
    let headers: Headers = headers.into_iter().collect();
    exr::block::write(file, headers, false, |meta, blocks| {
        let headers = meta.headers.clone();
        for (index, block) in meta.collect_ordered_block_data(|index| pixels(&headers, index)) {
            let block: UncompressedBlock = block;
            blocks.write_chunk(index, block.compress_to_chunk(&headers)?)?;
        }
        Ok(())
    })
    .expect("writable");
}

fn pixels(headers: &Headers, block: BlockIndex) -> Vec<u8> {
    let channels: &ChannelList = &headers[block.layer].channels;
    let small = block.level != Vec2(0, 0);
    let mut bytes = Vec::new();
    for y in block.pixel_position.1..block.pixel_position.1 + block.pixel_size.1 {
        for (index, channel) in channels.list.iter().enumerate() {
            for x in block.pixel_position.0..block.pixel_position.0 + block.pixel_size.0 {
                let full = sample(block.layer, index, (x, y));
                let value = if small { -1.0 - full } else { full };
                match channel.sample_type {
                    SampleType::F16 => bytes.extend(f16::from_f32(value).to_bits().to_ne_bytes()),
                    SampleType::F32 => bytes.extend(value.to_ne_bytes()),
                    SampleType::U32 => bytes.extend((value as u32 * 1_000_003).to_ne_bytes()),
                }
            }
        }
    }
    bytes
}
