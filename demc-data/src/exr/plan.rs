//! What a rewritten file consists of: its headers, and where the channels of each part come from.

use std::io::{Read, Seek};

use ::exr::meta::attribute::{ChannelList, LevelMode, SampleType};
use ::exr::meta::header::Header;
use ::exr::meta::{BlockDescription, Headers};

use super::compression::name_of;
use super::read::printable;
use super::rewrite::{Change, Keep, WriteOptions};
use super::{Compression, ExrFile, Precision, undecodable};
use crate::channel::Channel;
use crate::{ChannelLayout, Error};

/// The output.
pub(super) struct Plan {
    pub(super) headers: Headers,
    /// One for each header.
    pub(super) parts: Vec<Part>,
    pub(super) changes: Vec<Change>,
}

/// Where the pixels of a part of the output come from.
pub(super) struct Part {
    /// The part's index in the input.
    pub(super) input: usize,
    /// Its channels, in the header's order; `None` if the input's blocks are copied.
    pub(super) channels: Option<Vec<Origin>>,
}

/// Where a channel of the output comes from.
#[derive(Debug, Clone, Copy)]
pub(super) struct Origin {
    /// Its index in the input's part.
    pub(super) index: usize,
    /// The plane of the denoised colour that takes its place.
    pub(super) plane: Option<usize>,
}

impl Plan {
    /// Plans the output for a denoised colour of so many samples.
    pub(super) fn new<R: Read + Seek>(
        file: &ExrFile<R>,
        layout: &ChannelLayout,
        samples: usize,
        options: &WriteOptions,
    ) -> Result<Self, Error> {
        let color = color_channels(file, layout, samples)?;
        let mut plan = Self {
            headers: Headers::new(),
            parts: Vec::new(),
            changes: Vec::new(),
        };
        for (input, header) in file.source.meta.headers.iter().enumerate() {
            let channels = file.channels().iter().filter(|c| c.part == input);
            let origins: Vec<Origin> = channels
                .filter_map(|channel| origin(channel, &color, options.channels))
                .collect();
            if origins.is_empty() {
                continue;
            }
            let colored = origins.iter().any(|origin| origin.plane.is_some());
            plan.headers.push(match colored {
                true => colored_header(header, &origins, options, &mut plan.changes),
                false => header.clone(),
            });
            let channels = colored.then_some(origins);
            plan.parts.push(Part { input, channels });
        }
        Ok(plan)
    }
}

/// The layout's colour channels in the file.
fn color_channels<'a, R: Read + Seek>(
    file: &'a ExrFile<R>,
    layout: &ChannelLayout,
    samples: usize,
) -> Result<Vec<&'a Channel>, Error> {
    file.require(&layout.color.each_ref().map(String::as_str))?;
    let names = layout.color.iter();
    let channels: Vec<&Channel> = names.filter_map(|name| file.channel(name)).collect();
    let (first, window) = (channels[0], channels[0].window);
    if let Some(other) = channels.iter().find(|channel| channel.window != window) {
        return Err(Error::Sizes {
            path: file.path().to_owned(),
            a: first.name.clone(),
            a_window: window.to_string(),
            b: other.name.clone(),
            b_window: other.window.to_string(),
        });
    }
    if 3 * window.width * window.height != samples {
        let detail = format!("{samples} samples of colour do not fit into {window}, its size now");
        return Err(undecodable(file.path(), detail));
    }
    Ok(channels)
}

/// What a channel of the input is in the output; `None` if it is left out.
fn origin(channel: &Channel, color: &[&Channel], keep: Keep) -> Option<Origin> {
    let index = channel.index;
    let plane = color
        .iter()
        .position(|c| (c.part, c.index) == (channel.part, index));
    let stays = plane.is_some() || keep == Keep::All || is_alpha(channel, color);
    stays.then_some(Origin { index, plane })
}

/// `A` beside `R`, `beauty.A` beside `beauty.R`, in one part.
fn is_alpha(channel: &Channel, color: &[&Channel]) -> bool {
    let split = |name: &str| {
        let at = name.rfind('.').map_or(0, |dot| dot + 1);
        (name[..at].to_owned(), name[at..].to_owned())
    };
    let (prefix, suffix) = split(&channel.name);
    let beside = |c: &&Channel| c.part == channel.part && split(&c.name).0 == prefix;
    suffix.eq_ignore_ascii_case("a") && color.iter().any(beside)
}

/// The header of a part with colour.
fn colored_header(
    input: &Header,
    origins: &[Origin],
    options: &WriteOptions,
    changes: &mut Vec<Change>,
) -> Header {
    let name = input.own_attributes.layer_name.as_ref();
    let part = name.map_or(String::new(), printable);
    let channels = origins.iter().map(|origin| {
        let mut channel = input.channels.list[origin.index].clone();
        if origin.plane.is_some() {
            channel.sample_type = match options.precision {
                Some(Precision::Half) => SampleType::F16,
                None if channel.sample_type == SampleType::F16 => SampleType::F16,
                _ => SampleType::F32,
            };
        }
        channel
    });
    let channels = ChannelList::new(channels.collect());

    let lossless = |compression: Compression| {
        let others = origins.iter().filter(|origin| origin.plane.is_none());
        let mut kinds = others.map(|origin| input.channels.list[origin.index].sample_type);
        kinds.all(|kind| compression.method().is_lossless_for(kind))
    };
    let compression = match (options.compression, Compression::of(input.compression)) {
        (Some(chosen), _) => {
            if !lossless(chosen) {
                changes.push(Change::Lossy {
                    part: part.clone(),
                    to: chosen,
                });
            }
            chosen.method()
        }
        (None, Some(own)) if lossless(own) => input.compression,
        (None, _) => {
            changes.push(Change::Compression {
                part: part.clone(),
                from: name_of(input.compression),
                to: Compression::Zip,
            });
            Compression::Zip.method()
        }
    };

    let mut blocks = input.blocks;
    if let BlockDescription::Tiles(tiles) = &mut blocks
        && tiles.level_mode != LevelMode::Singular
    {
        tiles.level_mode = LevelMode::Singular;
        changes.push(Change::Levels { part });
    }
    let header = Header {
        channels,
        ..input.clone()
    };
    header.with_encoding(compression, blocks, input.line_order)
}
