//! The headers of a file and, on demand, its channels.

use std::collections::{BTreeSet, HashMap};
use std::fs::File;
use std::io::{BufReader, Read, Seek};
use std::path::{Path, PathBuf};

use ::exr::block::UncompressedBlock;
use ::exr::error::Error as ExrError;
use ::exr::meta::attribute::{AttributeValue, SampleType, Text};
use ::exr::meta::header::Header;
use ::exr::prelude::Vec2;
use demc_program::file::{FileError, open_regular};
use demc_program::parallel;
use half::f16;

use super::blocks::{BlockPosition, BlockReader, DecodedBlocks};
use super::decode::SampleSpan;
use super::failure::guarded;
use crate::error::Error;
use crate::image::channel::{Channel, ChannelType, Window, full_name};
use crate::image::plane::Plane;

/// Memory that must be free for blocks while pixels are decoded, in bytes (ours: four batches).
const SPARE_BYTES: usize = 32 << 20;

/// An open file whose headers are read and checked; its pixels are not yet decoded.
pub struct ExrFile<R = BufReader<File>> {
    path: PathBuf,
    pub(super) source: BlockReader<R>,
    channels: Vec<Channel>,
    /// The first channel of each name, as an index into `channels`.
    by_name: HashMap<String, usize>,
}

impl ExrFile {
    /// Opens `path` and reads its headers.
    ///
    /// # Errors
    /// [`FileError::Read`] if it cannot be opened or is not a regular file, otherwise as
    /// [`parse`](Self::parse).
    pub fn open(path: &Path) -> Result<Self, Error> {
        let read_error = |source| FileError::Read {
            path: path.to_owned(),
            source,
        };
        let file = open_regular(path).map_err(read_error)?;
        Self::parse(path, BufReader::new(file))
    }
}

impl<R: Read + Seek> ExrFile<R> {
    /// Reads the headers of an open file or a file in memory. Errors refer to it as `path`.
    ///
    /// # Errors
    /// [`Error::Exr`] if it is not an EXR file, or if its header is damaged or claims more than the
    /// file can hold. Also if a part is empty or exceeds [`MAX_SIDE`](super::limits::MAX_SIDE) or
    /// [`MAX_PIXELS`](super::limits::MAX_PIXELS).
    pub fn parse(path: &Path, reader: R) -> Result<Self, Error> {
        let source = guarded(path, || BlockReader::open(reader))?;
        let headers = &source.meta.headers;
        let several = headers.len() > 1;
        let channels: Vec<Channel> = headers
            .iter()
            .enumerate()
            .flat_map(|(part, header)| channels_of(part, header, several))
            .collect();
        let mut by_name = HashMap::with_capacity(channels.len());
        for (index, channel) in channels.iter().enumerate() {
            by_name.entry(channel.name.clone()).or_insert(index);
        }
        Ok(Self {
            path: path.to_owned(),
            channels,
            by_name,
            source,
        })
    }

    /// The file's name in errors.
    pub fn path(&self) -> &Path {
        &self.path
    }

    /// The channels of all parts, in the file's order.
    pub fn channels(&self) -> &[Channel] {
        &self.channels
    }

    /// The channel with this name; the first one if there are several.
    pub fn channel(&self, name: &str) -> Option<&Channel> {
        self.by_name.get(name).map(|index| &self.channels[*index])
    }

    /// The text of a header attribute, of the first part that has it.
    pub fn attribute(&self, name: &str) -> Option<String> {
        let mut parts = self.source.meta.headers.iter();
        parts.find_map(
            |header| match header.own_attributes.other.get(name.as_bytes()) {
                Some(AttributeValue::Text(text)) => Some(text.to_string()),
                _ => None,
            },
        )
    }

    /// Checks that the file ends after its last block of pixels, without decoding any.
    ///
    /// # Errors
    /// [`Error::Exr`] if blocks are missing or cut off.
    pub fn check_whole(&mut self) -> Result<(), Error> {
        guarded(&self.path, || {
            (0..self.source.meta.headers.len()).try_for_each(|part| self.source.check_whole(part))
        })
    }

    /// Checks that the file has all these channels.
    ///
    /// # Errors
    /// [`Error::MissingChannels`], naming each missing channel once, and the channels of the file.
    pub fn require(&self, names: &[&str]) -> Result<(), Error> {
        let mut missing: Vec<String> = Vec::new();
        for name in names.iter().filter(|name| self.channel(name).is_none()) {
            // A texture that replaces another one is requested twice.
            if !missing.iter().any(|known| known == name) {
                missing.push((*name).to_owned());
            }
        }
        if missing.is_empty() {
            return Ok(());
        }
        let present = self
            .channels
            .iter()
            .map(|channel| channel.name.clone())
            .collect();
        Err(Error::MissingChannels {
            path: self.path.clone(),
            missing,
            present,
        })
    }

    /// Decodes and encodes on this many threads, instead of `RAYON_NUM_THREADS` or the number of
    /// processors.
    pub fn on_threads(mut self, threads: usize) -> Self {
        self.source.threads = threads.max(1);
        self
    }

    /// Keeps decoded blocks of the parts with these channels, the colour's, up to `bytes` bytes.
    /// [`rewrite`](crate::image::rewrite::rewrite) then need not decompress them again.
    pub fn keeping(mut self, color: &[String], bytes: usize) -> Self {
        let color = color.iter().filter_map(|name| self.channel(name));
        self.source.kept = DecodedBlocks::new(color.map(|channel| channel.part).collect(), bytes);
        self
    }

    /// Decodes the named channels, in the order of `names`. Other parts and smaller levels are not
    /// read.
    ///
    /// # Errors
    /// [`Error::MissingChannels`] if the file lacks any; [`Error::Memory`]; [`Error::Exr`] if the
    /// pixel data is truncated or damaged.
    pub fn read(&mut self, names: &[&str]) -> Result<Vec<Plane>, Error> {
        self.require(names)?;
        let wanted: Vec<Channel> = names
            .iter()
            .filter_map(|name| self.channel(name))
            .cloned()
            .collect();
        let mut planes: Vec<Plane> = wanted.iter().map(|channel| empty(channel.kind)).collect();
        // A file that cannot hold its pixels is damaged, whatever memory there is.
        guarded(&self.path, || {
            let parts: BTreeSet<usize> = wanted.iter().map(|channel| channel.part).collect();
            parts
                .into_iter()
                .try_for_each(|part| self.source.grid(part).map(drop))
        })?;
        self.reserve(&wanted, &mut planes)?;
        guarded(&self.path, || {
            decode(&mut self.source, &wanted, &mut planes)
        })?;
        Ok(planes)
    }

    /// Reserves address space for whole planes; memory is used as rows are filled.
    fn reserve(&self, wanted: &[Channel], planes: &mut [Plane]) -> Result<(), Error> {
        let pixels = |channel: &Channel| channel.window.width * channel.window.height;
        let reserved = wanted
            .iter()
            .zip(planes)
            .try_for_each(|(channel, plane)| match plane {
                Plane::Half(plane) => plane.try_reserve_exact(pixels(channel)),
                Plane::Float(plane) => plane.try_reserve_exact(pixels(channel)),
                Plane::Uint(plane) => plane.try_reserve_exact(pixels(channel)),
            });
        // The decoder cannot report that its blocks have no room.
        let spare = reserved.and_then(|()| Vec::<u8>::new().try_reserve_exact(SPARE_BYTES));
        let bytes = |channel: &Channel| match channel.kind {
            ChannelType::Half => 2 * pixels(channel),
            ChannelType::Float | ChannelType::Uint => 4 * pixels(channel),
        };
        spare.map_err(|_| Error::Memory {
            path: self.path.clone(),
            needed: wanted.iter().map(bytes).sum::<usize>().div_ceil(1 << 20),
        })
    }
}

fn channels_of(part: usize, header: &Header, several: bool) -> Vec<Channel> {
    let layer = header.own_attributes.layer_name.as_ref().map(printable);
    let described = header.channels.list.iter().enumerate();
    let channels = described.map(|(index, channel)| Channel {
        name: full_name(
            layer.as_deref().filter(|_| several),
            &printable(&channel.name),
        ),
        kind: match channel.sample_type {
            SampleType::F16 => ChannelType::Half,
            SampleType::F32 => ChannelType::Float,
            SampleType::U32 => ChannelType::Uint,
        },
        layer: layer.clone(),
        window: window_of(header),
        part,
        index,
    });
    channels.collect()
}

/// A name from the file, as a layout must spell it.
pub(super) fn printable(name: &Text) -> String {
    let name = String::from_utf8_lossy(name.bytes());
    name.replace(char::is_control, "\u{fffd}")
}

/// Decodes every full-size block of the parts that hold a wanted channel.
fn decode<R: Read + Seek>(
    source: &mut BlockReader<R>,
    wanted: &[Channel],
    planes: &mut [Plane],
) -> Result<(), ExrError> {
    for part in 0..source.meta.headers.len() {
        if !wanted.iter().any(|channel| channel.part == part) {
            continue;
        }
        let grid = source.grid(part)?;
        let header = &source.meta.headers[part];
        let rows = source.batch(header).div_ceil(grid.columns);
        let spans = SampleSpan::all(&header.channels);
        let mut part_channels = Vec::with_capacity(wanted.len());
        for (channel, plane) in wanted.iter().zip(&mut *planes) {
            if channel.part == part {
                part_channels.push((channel.window, spans[channel.index], plane));
            }
        }
        for top in (0..grid.rows).step_by(rows) {
            let bottom = grid.rows.min(top + rows);
            let row = |row| (0..grid.columns).map(move |column| (column, row));
            let places: Vec<BlockPosition> = (top..bottom).flat_map(row).collect();
            let blocks = source.decode(part, &grid, &places)?;
            let lines = bottom * grid.block.height();
            let targets = part_channels.iter_mut().collect();
            parallel::map(source.threads, targets, |(window, span, plane)| {
                grow(plane, window.width * window.height.min(lines));
                for block in &blocks {
                    copy(block, *span, window.width, plane);
                }
            });
            source.kept.keep(part, &places, blocks);
        }
    }
    Ok(())
}

/// Copies a channel's samples from a block to their positions in an image of this width.
fn copy(block: &UncompressedBlock, span: SampleSpan, image_width: usize, plane: &mut Plane) {
    let (Vec2(left, top), Vec2(width, height)) =
        (block.index.pixel_position, block.index.pixel_size);
    for y in top..top + height {
        let start = y * image_width + left;
        let samples = start..start + width;
        let bytes = span.line(block, y);
        match plane {
            Plane::Half(plane) => put(bytes, &mut plane[samples], f16::from_ne_bytes),
            Plane::Float(plane) => put(bytes, &mut plane[samples], f32::from_ne_bytes),
            Plane::Uint(plane) => put(bytes, &mut plane[samples], u32::from_ne_bytes),
        }
    }
}

fn put<T, const N: usize>(bytes: &[u8], samples: &mut [T], from: impl Fn([u8; N]) -> T) {
    for (sample, &bytes) in samples.iter_mut().zip(bytes.as_chunks().0) {
        *sample = from(bytes);
    }
}

fn empty(kind: ChannelType) -> Plane {
    match kind {
        ChannelType::Half => Plane::Half(Vec::new()),
        ChannelType::Float => Plane::Float(Vec::new()),
        ChannelType::Uint => Plane::Uint(Vec::new()),
    }
}

fn grow(plane: &mut Plane, samples: usize) {
    match plane {
        Plane::Half(plane) => plane.resize(samples, f16::ZERO),
        Plane::Float(plane) => plane.resize(samples, 0.0),
        Plane::Uint(plane) => plane.resize(samples, 0),
    }
}

fn window_of(header: &Header) -> Window {
    let position = header.own_attributes.layer_position;
    Window {
        x: position.0,
        y: position.1,
        width: header.layer_size.0,
        height: header.layer_size.1,
    }
}
