//! The plan of a rewritten file: its headers, and the source of each part's channels.

use std::fmt;
use std::io::{Read, Seek};

use ::exr::meta::attribute::{
    AttributeValue, ChannelDescription, ChannelList, LevelMode, SampleType,
};
use ::exr::meta::header::Header;
use ::exr::meta::{BlockDescription, Headers};

use super::compression::{Compression, name_of};
use super::failure::undecodable;
use super::key_code;
use super::read::{ExrFile, printable};
use super::write::SamplePrecision;
use crate::error::Error;
use crate::image::channel::Channel;

/// Options for writing a denoised image.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct WriteOptions<'a> {
    /// Channels of the input to keep.
    pub channels: OutputChannels,
    /// Type of the channels of colour and layers; `None`: as in the input (`float` instead of `uint`).
    pub precision: Option<SamplePrecision>,
    /// Compression of the parts with colour; `None`: as in the input. If that would change other
    /// channels or cannot be written, [`Compression::Zip`].
    pub compression: Option<Compression>,
    /// Text of the header attribute [`RECORD`] of parts with colour: how the image was made.
    pub record: Option<&'a str>,
}

/// The header attribute for [`WriteOptions::record`].
pub const RECORD: &str = "demc.options";

/// Channels of the input to keep in the output.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub enum OutputChannels {
    /// All channels.
    #[default]
    All,
    /// Only colour, layers, and the alpha channel of the same part (`A` beside `R`, `beauty.A` beside
    /// `beauty.R`).
    Color,
}

/// A difference between the layouts of input and output.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum Change {
    /// The input's compression would have changed other channels or cannot be written.
    Compression {
        /// The part's name; empty if it has none.
        part: String,
        /// The compression of the input.
        from: &'static str,
        /// The compression of the output.
        to: Compression,
    },
    /// The requested compression changes the other channels.
    Lossy {
        /// The part's name; empty if it has none.
        part: String,
        /// The requested compression.
        to: Compression,
    },
    /// Smaller copies of the image (mip or rip levels) were dropped, because they show the noise.
    Levels {
        /// The part's name; empty if it has none.
        part: String,
    },
}

impl fmt::Display for Change {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let (Change::Compression { part, .. }
        | Change::Lossy { part, .. }
        | Change::Levels { part }) = self;
        if !part.is_empty() {
            write!(f, "part {part}: ")?;
        }
        match self {
            Change::Compression { from, to, .. } => {
                write!(
                    f,
                    "compressed with {to} instead of {from}, so that the other channels stay unchanged"
                )
            }
            Change::Lossy { to, .. } => {
                write!(
                    f,
                    "compressed with {to}, which also changes the other channels"
                )
            }
            Change::Levels { .. } => f.write_str("written without its smaller levels"),
        }
    }
}

pub(in crate::image) struct RewritePlan {
    pub(super) headers: Headers,
    pub(super) parts: Vec<PlannedPart>,
    pub(in crate::image) changes: Vec<Change>,
}

/// The names of the channels that get other values.
#[derive(Debug, Clone, Copy)]
pub(in crate::image) struct ReplacedNames<'a> {
    /// Red, green, and blue.
    pub(in crate::image) color: &'a [String; 3],
    /// Alpha of the colour, which is replaced if there are samples for it.
    pub(in crate::image) alpha: Option<&'a str>,
    /// Further channels.
    pub(in crate::image) layers: &'a [String],
    /// Channels that the output has more, beside the colour.
    pub(in crate::image) added: &'a [&'a str],
}

pub(super) struct PlannedPart {
    pub(super) input: usize,
    /// Its channels, in the order of the header; `None` if the blocks of the input are copied.
    pub(super) channels: Option<Vec<ChannelOrigin>>,
}

/// Where the samples of an output channel come from.
#[derive(Debug, Clone, Copy)]
pub(super) enum ChannelOrigin {
    /// The input's channel of this index.
    Input(usize),
    /// This plane, in place of the input's channel of this index.
    Replaced { index: usize, plane: usize },
    /// This plane, for the added channel of this index.
    Added { index: usize, plane: usize },
}

impl ChannelOrigin {
    /// The plane of denoised values.
    pub(super) fn plane(self) -> Option<usize> {
        match self {
            Self::Input(_) => None,
            Self::Replaced { plane, .. } | Self::Added { plane, .. } => Some(plane),
        }
    }
}

impl RewritePlan {
    pub(in crate::image) fn new<R: Read + Seek>(
        file: &ExrFile<R>,
        names: &ReplacedNames<'_>,
        samples: usize,
        options: &WriteOptions,
    ) -> Result<Self, Error> {
        let replaced = replaced_channels(file, names, samples)?;
        let color = &replaced[..3];
        let added = |part: usize| {
            let planes = (0..names.added.len()).map(|index| ChannelOrigin::Added {
                index,
                plane: replaced.len() + index,
            });
            planes.filter(move |_| part == color[0].part)
        };
        let mut plan = Self {
            headers: Headers::new(),
            parts: Vec::new(),
            changes: Vec::new(),
        };
        for (input, header) in file.source.meta.headers.iter().enumerate() {
            let mut origins: Vec<ChannelOrigin> = file
                .channels()
                .iter()
                .filter(|channel| channel.part == input)
                .filter_map(|channel| origin(channel, &replaced, color, options.channels))
                .chain(added(input))
                .collect();
            if origins.is_empty() {
                continue;
            }
            let colored = origins.iter().any(|origin| origin.plane().is_some());
            let mut header = if colored {
                let described = described(header, &origins, names.added, options);
                origins = described.iter().map(|(origin, _)| *origin).collect();
                let channels = described.into_iter().map(|(_, channel)| channel);
                let list = ChannelList::new(channels.collect());
                colored_header(header, list, &origins, options, &mut plan.changes)
            } else {
                header.clone()
            };
            key_code::keep_whole(&mut header);
            plan.headers.push(header);
            let channels = colored.then_some(origins);
            plan.parts.push(PlannedPart { input, channels });
        }
        Ok(plan)
    }
}

/// The channels with other values, in the order of their planes: colour, alpha if there is a plane
/// for it, and the layers.
fn replaced_channels<'a, R: Read + Seek>(
    file: &'a ExrFile<R>,
    names: &ReplacedNames<'_>,
    samples: usize,
) -> Result<Vec<&'a Channel>, Error> {
    let ReplacedNames {
        color,
        alpha,
        layers,
        added,
    } = *names;
    let required: Vec<&str> = color.iter().chain(layers).map(String::as_str).collect();
    file.require(&required)?;
    let find = |name: &String| file.channel(name);
    let mut channels: Vec<&Channel> = color.iter().filter_map(find).collect();
    let (first, window) = (channels[0], channels[0].window);
    let pixels = window.width * window.height;
    if samples == (4 + layers.len() + added.len()) * pixels {
        channels.extend(alpha.and_then(|name| file.channel(name)));
    }
    channels.extend(layers.iter().filter_map(find));
    if let Some(other) = channels.iter().find(|channel| channel.window != window) {
        return Err(Error::Sizes {
            path: file.path().to_owned(),
            a: first.name.clone(),
            a_window: window.to_string(),
            b: other.name.clone(),
            b_window: other.window.to_string(),
        });
    }
    if (channels.len() + added.len()) * pixels != samples {
        let detail = format!("{samples} samples of colour do not match {window}, its current size");
        return Err(undecodable(file.path(), detail));
    }
    Ok(channels)
}

/// The source of an output channel; `None` if the channel is dropped.
fn origin(
    channel: &Channel,
    replaced: &[&Channel],
    color: &[&Channel],
    keep: OutputChannels,
) -> Option<ChannelOrigin> {
    let index = channel.index;
    let plane = replaced
        .iter()
        .position(|c| (c.part, c.index) == (channel.part, index));
    match plane {
        Some(plane) => Some(ChannelOrigin::Replaced { index, plane }),
        None if keep == OutputChannels::All || is_alpha(channel, color) => {
            Some(ChannelOrigin::Input(index))
        }
        None => None,
    }
}

/// Whether this is an alpha channel of the colour: `A` beside `R`, or `beauty.A` beside `beauty.R`,
/// in one part.
fn is_alpha(channel: &Channel, color: &[&Channel]) -> bool {
    let split = |name: &str| {
        let start = name.rfind('.').map_or(0, |dot| dot + 1);
        (name[..start].to_owned(), name[start..].to_owned())
    };
    let (prefix, suffix) = split(&channel.name);
    let beside = |c: &&Channel| c.part == channel.part && split(&c.name).0 == prefix;
    suffix.eq_ignore_ascii_case("a") && color.iter().any(beside)
}

/// The channels of a part with colour, in the order of their names.
fn described(
    input: &Header,
    origins: &[ChannelOrigin],
    added: &[&str],
    options: &WriteOptions,
) -> Vec<(ChannelOrigin, ChannelDescription)> {
    let kind = |own: SampleType| match options.precision {
        Some(SamplePrecision::Half) => SampleType::F16,
        None if own == SampleType::F16 => SampleType::F16,
        _ => SampleType::F32,
    };
    let describe = |origin: &ChannelOrigin| {
        let channel = match *origin {
            ChannelOrigin::Input(index) => input.channels.list[index].clone(),
            ChannelOrigin::Replaced { index, .. } => {
                let channel = input.channels.list[index].clone();
                ChannelDescription {
                    sample_type: kind(channel.sample_type),
                    ..channel
                }
            }
            ChannelOrigin::Added { index, .. } => {
                ChannelDescription::named(added[index], kind(SampleType::F32))
            }
        };
        (*origin, channel)
    };
    let mut described: Vec<_> = origins.iter().map(describe).collect();
    described.sort_by(|(_, a), (_, b)| a.name.cmp(&b.name));
    described
}

/// The header of a part with colour.
fn colored_header(
    input: &Header,
    channels: ChannelList,
    origins: &[ChannelOrigin],
    options: &WriteOptions,
    changes: &mut Vec<Change>,
) -> Header {
    let name = input.own_attributes.layer_name.as_ref();
    let part = name.map_or(String::new(), printable);
    let lossless = |compression: Compression| {
        let mut kinds = origins.iter().filter_map(|origin| match origin {
            ChannelOrigin::Input(index) => Some(input.channels.list[*index].sample_type),
            _ => None,
        });
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
    let mut header = Header {
        channels,
        ..input.clone()
    };
    if let Some(record) = options.record {
        let attributes = &mut header.own_attributes.other;
        attributes.insert(RECORD.into(), AttributeValue::Text(record.into()));
    }
    header.with_encoding(compression, blocks, input.line_order)
}
