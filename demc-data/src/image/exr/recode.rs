//! Conversion of a file's blocks to those of the rewritten file, in small batches.

use std::collections::{BTreeMap, BTreeSet};
use std::io::{Read, Seek, SeekFrom, Write};
use std::path::Path;

use ::exr::block::UncompressedBlock;
use ::exr::block::chunk::{
    Chunk, CompressedBlock, CompressedScanLineBlock, CompressedTileBlock, TileCoordinates,
};
use ::exr::block::writer::{ChunkWriter, ChunksWriter};
use ::exr::error::{Error as ExrError, UnitResult};
use ::exr::meta::attribute::SampleType;
use ::exr::meta::header::Header;
use ::exr::meta::{BlockDescription, Headers};
use ::exr::prelude::{Compression, Vec2};
use demc_program::{file, parallel};
use half::f16;

use super::blocks::{BlockGrid, BlockPosition, BlockReader};
use super::decode::SampleSpan;
use super::failure::{guarded, invalid, io_error};
use super::plan::{ChannelOrigin, RewritePlan};
use super::read::ExrFile;
use super::write::saturated_half;
use super::zip;
use crate::error::Error;

/// Headers begin after the magic number and the version, in bytes.
const HEADERS_START: u64 = 8;

/// Writes the planned file. Returns the number of replaced samples beyond the range of half.
///
/// # Shapes
/// `planes` is `[replaced channels, height, width]`.
pub(in crate::image) fn recode<R: Read + Seek>(
    file: &mut ExrFile<R>,
    plan: &RewritePlan,
    planes: &[f32],
    output: &Path,
) -> Result<usize, Error> {
    let path = file.path().to_owned();
    let mut recoder = Recoder {
        input: RewriteInput {
            path: &path,
            source: &mut file.source,
            error: None,
        },
        headers: &plan.headers,
        planes,
        clamped: 0,
    };
    let written = file::write_whole(output, |writer| {
        ::exr::block::write(&mut *writer, plan.headers.clone(), false, |_, blocks| {
            let mut parts = plan.parts.iter().enumerate();
            parts.try_for_each(|(part, from)| match &from.channels {
                None => recoder.copy(part, from.input, blocks),
                Some(origins) => recoder.code(part, from.input, origins, blocks),
            })
        })
        .and_then(|()| sort_attributes(writer, &plan.headers))
        .map_err(io_error)
    });
    match recoder.input.error {
        Some(error) => Err(error),
        None => {
            written?;
            Ok(recoder.clamped)
        }
    }
}

struct Recoder<'a, R> {
    input: RewriteInput<'a, R>,
    headers: &'a Headers,
    planes: &'a [f32],
    clamped: usize,
}

/// The input, and its error: inside the writer, that would be mistaken for an error of the output.
struct RewriteInput<'a, R> {
    path: &'a Path,
    source: &'a mut BlockReader<R>,
    error: Option<Error>,
}

impl<R> RewriteInput<'_, R> {
    fn get<T>(
        &mut self,
        read: impl FnOnce(&mut BlockReader<R>) -> Result<T, ExrError>,
    ) -> Result<T, ExrError> {
        guarded(self.path, || read(self.source)).map_err(|error| {
            self.error = Some(error);
            ExrError::Aborted
        })
    }
}

impl<R: Read + Seek> Recoder<'_, R> {
    /// Copies a part without decompressing it.
    fn copy<W: Write + Seek>(
        &mut self,
        part: usize,
        from: usize,
        blocks: &mut ChunkWriter<W>,
    ) -> UnitResult {
        let offsets = self.input.get(|source| source.offsets(from))?;
        for (index, tile) in self.headers[part].enumerate_ordered_blocks() {
            let chunk = self
                .input
                .get(|source| source.chunk(from, offsets[index], tile.location))?;
            let layer_index = part;
            blocks.write_chunk(
                index,
                Chunk {
                    layer_index,
                    ..chunk
                },
            )?;
        }
        Ok(())
    }

    fn code<W: Write + Seek>(
        &mut self,
        part: usize,
        from: usize,
        origins: &[ChannelOrigin],
        blocks: &mut ChunkWriter<W>,
    ) -> UnitResult {
        let header = &self.headers[part];
        let grid = self.input.get(|source| source.grid(from))?;
        let source = &self.input.source;
        let (batch, threads) = (source.batch(header), source.threads);
        let mut carried = CarriedChannels::new(from, grid, &source.meta.headers[from], origins);
        for batch in targets(header)?.chunks(batch) {
            carried.fetch(&mut self.input, batch)?;
            let code = |target: &OutputBlock| -> Result<CodedBlock, ExrError> {
                let (data, clamped) = assemble(header, target, self.planes, &carried);
                Ok(CodedBlock {
                    index: target.index,
                    chunk: compress(part, header, target, data)?,
                    clamped,
                })
            };
            for coded in parallel::map(threads, batch.iter().collect(), code) {
                let coded = coded?;
                blocks.write_chunk(coded.index, coded.chunk)?;
                self.clamped += coded.clamped;
            }
        }
        Ok(())
    }
}

/// A compressed block of the output.
struct CodedBlock {
    index: usize,
    chunk: Chunk,
    /// Replaced samples beyond the range of half.
    clamped: usize,
}

pub(super) struct OutputBlock {
    pub(super) index: usize,
    tile: TileCoordinates,
    pub(super) corner: Vec2<usize>,
    pub(super) size: Vec2<usize>,
}

pub(super) fn targets(header: &Header) -> Result<Vec<OutputBlock>, ExrError> {
    let blocks = header.enumerate_ordered_blocks();
    let targets = blocks.map(|(index, tile)| {
        let area = header.get_absolute_block_pixel_coordinates(tile.location)?;
        Ok(OutputBlock {
            index,
            tile: tile.location,
            corner: area.position.to_usize("block position")?,
            size: area.size,
        })
    });
    targets.collect()
}

/// The samples of an output block, and the number of replaced samples beyond the range of half.
fn assemble(
    header: &Header,
    target: &OutputBlock,
    planes: &[f32],
    carried: &CarriedChannels,
) -> (Vec<u8>, usize) {
    let Vec2(image_width, image_height) = header.layer_size;
    let (Vec2(x, top), Vec2(width, height)) = (target.corner, target.size);
    let mut data = Vec::with_capacity(target.size.area() * header.channels.bytes_per_pixel);
    let mut clamped = 0;
    for y in top..top + height {
        let block = carried.blocks.get(&carried.grid.place(Vec2(x, y)));
        for (channel, content) in header.channels.list.iter().zip(&carried.contents) {
            match content {
                ChannelContent::New(plane) => {
                    let start = (plane * image_height + y) * image_width + x;
                    let line = &planes[start..start + width];
                    clamped += put(line, channel.sample_type, &mut data);
                }
                ChannelContent::Carried(span) => {
                    let block = block.expect("fetched before");
                    data.extend_from_slice(span.line(block, y));
                }
            }
        }
    }
    (data, clamped)
}

pub(super) fn compress(
    part: usize,
    header: &Header,
    target: &OutputBlock,
    data: Vec<u8>,
) -> Result<Chunk, ExrError> {
    let pixels = header.get_absolute_block_pixel_coordinates(target.tile)?;
    // The byte order of the format is that of most machines.
    let ours = cfg!(target_endian = "little");
    let compressed_pixels_le = match header.compression {
        Compression::ZIP1 | Compression::ZIP16 if ours => zip::compress(data)?,
        other => other.compress_image_section_to_le(header, data, pixels)?,
    };
    Ok(Chunk {
        layer_index: part,
        compressed_block: match header.blocks {
            BlockDescription::ScanLines => CompressedBlock::ScanLine(CompressedScanLineBlock {
                y_coordinate: pixels.position.y() + header.own_attributes.layer_position.y(),
                compressed_pixels_le,
            }),
            BlockDescription::Tiles(_) => CompressedBlock::Tile(CompressedTileBlock {
                coordinates: target.tile,
                compressed_pixels_le,
            }),
        },
    })
}

enum ChannelContent {
    /// This plane.
    New(usize),
    Carried(SampleSpan),
}

/// The channels of a part, and the blocks of the input that the current batch needs.
struct CarriedChannels {
    part: usize,
    grid: BlockGrid,
    /// In the order of the output's channels.
    contents: Vec<ChannelContent>,
    blocks: BTreeMap<BlockPosition, UncompressedBlock>,
}

impl CarriedChannels {
    fn new(part: usize, grid: BlockGrid, input: &Header, origins: &[ChannelOrigin]) -> Self {
        let spans = SampleSpan::all(&input.channels);
        let content = |origin: &ChannelOrigin| match *origin {
            ChannelOrigin::Input(index) => ChannelContent::Carried(spans[index]),
            ChannelOrigin::Replaced { plane, .. } | ChannelOrigin::Added { plane, .. } => {
                ChannelContent::New(plane)
            }
        };
        Self {
            part,
            grid,
            contents: origins.iter().map(content).collect(),
            blocks: BTreeMap::new(),
        }
    }

    /// Decodes the blocks that hold pixels of these output blocks, except for blocks already
    /// decoded.
    fn fetch<R: Read + Seek>(
        &mut self,
        input: &mut RewriteInput<'_, R>,
        targets: &[OutputBlock],
    ) -> UnitResult {
        let carries = |content: &ChannelContent| matches!(content, ChannelContent::Carried(_));
        if !self.contents.iter().any(carries) {
            return Ok(());
        }
        let of_targets = targets.iter().flat_map(|target| {
            let (column, first) = self.grid.place(target.corner);
            let (_, last) = self.grid.place(target.corner + target.size - Vec2(1, 1));
            (first..=last).map(move |row| (column, row))
        });
        let places: BTreeSet<BlockPosition> = of_targets.collect();
        self.blocks.retain(|place, _| places.contains(place));
        let missing: Vec<BlockPosition> = places
            .into_iter()
            .filter(|place| !self.blocks.contains_key(place))
            .collect();
        let decoded = input.get(|source| source.decode(self.part, &self.grid, &missing))?;
        self.blocks.extend(missing.into_iter().zip(decoded));
        Ok(())
    }
}

/// Appends a line of colour as samples of this type. Returns the number of samples beyond its
/// range.
fn put(line: &[f32], kind: SampleType, data: &mut Vec<u8>) -> usize {
    match kind {
        SampleType::F16 => {
            let halves = line.iter().map(|&value| saturated_half(value));
            data.extend(halves.flat_map(|half| half.to_bits().to_ne_bytes()));
            let largest = f16::MAX.to_f32();
            line.iter().filter(|value| value.abs() > largest).count()
        }
        _ => {
            data.extend(line.iter().flat_map(|value| value.to_ne_bytes()));
            0
        }
    }
}

/// Writes the headers of a finished file again, with attributes sorted by name, as OpenEXR's own
/// library does. The `exr` crate writes unknown attributes in the random order of a hash map, so
/// equal images would give different bytes. The length does not change.
pub(super) fn sort_attributes<W: Write + Seek>(
    writer: &mut W,
    headers: &Headers,
) -> Result<(), ExrError> {
    writer.seek(SeekFrom::Start(HEADERS_START))?;
    for header in headers {
        writer.write_all(&sorted(header)?)?;
    }
    writer.seek(SeekFrom::End(0))?;
    Ok(())
}

fn sorted(header: &Header) -> Result<Vec<u8>, ExrError> {
    let mut bytes = Vec::new();
    header.write(&mut bytes)?;
    // Without the terminating zero.
    let mut rest = &bytes[..bytes.len() - 1];
    let mut attributes = Vec::new();
    while !rest.is_empty() {
        let length = length(rest)
            .filter(|&length| length <= rest.len())
            .ok_or_else(|| invalid("an attribute cannot be written".to_owned()))?;
        let (attribute, others) = rest.split_at(length);
        attributes.push(attribute);
        rest = others;
    }
    attributes.sort_unstable();
    let mut sorted = attributes.concat();
    sorted.push(0);
    Ok(sorted)
}

/// The length of the first attribute: name, zero, type, zero, size of the value in four bytes,
/// value.
fn length(bytes: &[u8]) -> Option<usize> {
    let mut zeros = (0..bytes.len()).filter(|&i| bytes[i] == 0);
    let start = zeros.nth(1)? + 1;
    let size = bytes.get(start..start + 4)?.try_into().ok()?;
    Some(start + 4 + usize::try_from(i32::from_le_bytes(size)).ok()?)
}
