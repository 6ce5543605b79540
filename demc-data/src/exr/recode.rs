//! From the blocks of a file to those of its rewritten self, a few at a time.

use std::collections::{BTreeMap, BTreeSet};
use std::io::{Read, Seek, Write};
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
use half::f16;

use super::blocks::{Grid, Place, Source};
use super::decode::Span;
use super::plan::{Origin, Plan};
use super::write::{io_error, saturated_half};
use super::{ExrFile, attributes, guarded, zip};
use crate::parallel;
use crate::{Error, file};

/// Writes what was planned; returns how many samples of the colour are beyond half's range.
///
/// # Shapes
/// `color_hdr` is `[3, height, width]`.
pub(super) fn recode<R: Read + Seek>(
    file: &mut ExrFile<R>,
    plan: &Plan,
    color_hdr: &[f32],
    output: &Path,
) -> Result<usize, Error> {
    let path = file.path().to_owned();
    let mut recoder = Recoder {
        input: Input {
            path: &path,
            source: &mut file.source,
            error: None,
        },
        headers: &plan.headers,
        color_hdr,
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
        .and_then(|()| attributes::sort(writer, &plan.headers))
        .map_err(io_error)
    });
    match recoder.input.error {
        Some(error) => Err(error),
        None => written.map(|()| recoder.clamped),
    }
}

struct Recoder<'a, R> {
    input: Input<'a, R>,
    /// Of the output.
    headers: &'a Headers,
    color_hdr: &'a [f32],
    clamped: usize,
}

/// The input, and what was wrong with it: within the writer that would pass for an error of the output.
struct Input<'a, R> {
    path: &'a Path,
    source: &'a mut Source<R>,
    error: Option<Error>,
}

impl<R> Input<'_, R> {
    fn get<T>(
        &mut self,
        read: impl FnOnce(&mut Source<R>) -> Result<T, ExrError>,
    ) -> Result<T, ExrError> {
        guarded(self.path, || read(self.source)).map_err(|error| {
            self.error = Some(error);
            ExrError::Aborted
        })
    }
}

impl<R: Read + Seek> Recoder<'_, R> {
    /// Copies a part, compressed as it is.
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

    /// Codes a part anew.
    fn code<W: Write + Seek>(
        &mut self,
        part: usize,
        from: usize,
        origins: &[Origin],
        blocks: &mut ChunkWriter<W>,
    ) -> UnitResult {
        let header = &self.headers[part];
        let grid = self.input.get(|source| source.grid(from))?;
        let source = &self.input.source;
        let (batch, threads) = (source.batch(header), source.threads);
        let mut carried = Carried::new(from, grid, &source.meta.headers[from], origins);
        for batch in targets(header)?.chunks(batch) {
            carried.fetch(&mut self.input, batch)?;
            let code = |target: &Target| -> Result<(usize, Chunk, usize), ExrError> {
                let (data, clamped) = assemble(header, target, self.color_hdr, &carried);
                let chunk = compress(part, header, target, data)?;
                Ok((target.index, chunk, clamped))
            };
            for coded in parallel::map(threads, batch.iter().collect(), code) {
                let (index, chunk, clamped) = coded?;
                blocks.write_chunk(index, chunk)?;
                self.clamped += clamped;
            }
        }
        Ok(())
    }
}

/// A block of the output.
struct Target {
    /// Its place in the table of blocks.
    index: usize,
    tile: TileCoordinates,
    /// Its pixels.
    corner: Vec2<usize>,
    size: Vec2<usize>,
}

/// The blocks of a part, in the order of the file.
fn targets(header: &Header) -> Result<Vec<Target>, ExrError> {
    let blocks = header.enumerate_ordered_blocks();
    let targets = blocks.map(|(index, tile)| {
        let area = header.get_absolute_block_pixel_coordinates(tile.location)?;
        Ok(Target {
            index,
            tile: tile.location,
            corner: area.position.to_usize("block position")?,
            size: area.size,
        })
    });
    targets.collect()
}

/// The samples of a block of the output, and how many of the colour are beyond half's range.
fn assemble(
    header: &Header,
    target: &Target,
    color_hdr: &[f32],
    carried: &Carried,
) -> (Vec<u8>, usize) {
    let Vec2(image_width, image_height) = header.layer_size;
    let (Vec2(x, top), Vec2(width, height)) = (target.corner, target.size);
    let mut data = Vec::with_capacity(target.size.area() * header.channels.bytes_per_pixel);
    let mut clamped = 0;
    for y in top..top + height {
        let block = carried.blocks.get(&carried.grid.place(Vec2(x, y)));
        for (channel, content) in header.channels.list.iter().zip(&carried.contents) {
            match content {
                Content::Color(plane) => {
                    let start = (plane * image_height + y) * image_width + x;
                    let line = &color_hdr[start..start + width];
                    clamped += put(line, channel.sample_type, &mut data);
                }
                Content::Carried(span) => {
                    let block = block.expect("fetched before");
                    data.extend_from_slice(span.line(block, y));
                }
            }
        }
    }
    (data, clamped)
}

/// Compresses a block of the output.
fn compress(
    part: usize,
    header: &Header,
    target: &Target,
    data: Vec<u8>,
) -> Result<Chunk, ExrError> {
    let pixels = header.get_absolute_block_pixel_coordinates(target.tile)?;
    // The format's byte order is this machine's, but for a few.
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

/// What a channel of the output has.
enum Content {
    /// A plane of the denoised colour.
    Color(usize),
    /// A channel of the input's blocks.
    Carried(Span),
}

/// The channels of a part, and those of the input's blocks that the batch at hand needs.
struct Carried {
    part: usize,
    grid: Grid,
    /// In the order of the output's channels.
    contents: Vec<Content>,
    blocks: BTreeMap<Place, UncompressedBlock>,
}

impl Carried {
    fn new(part: usize, grid: Grid, input: &Header, origins: &[Origin]) -> Self {
        let content = |origin: &Origin| match origin.plane {
            Some(plane) => Content::Color(plane),
            None => Content::Carried(Span::of(&input.channels, origin.index)),
        };
        Self {
            part,
            grid,
            contents: origins.iter().map(content).collect(),
            blocks: BTreeMap::new(),
        }
    }

    /// Decodes the blocks that hold pixels of these targets, but for those at hand.
    fn fetch<R: Read + Seek>(
        &mut self,
        input: &mut Input<'_, R>,
        targets: &[Target],
    ) -> UnitResult {
        let carries = |content: &Content| matches!(content, Content::Carried(_));
        if !self.contents.iter().any(carries) {
            return Ok(());
        }
        let places = targets.iter().flat_map(|target| {
            let (column, first) = self.grid.place(target.corner);
            let (_, last) = self.grid.place(target.corner + target.size - Vec2(1, 1));
            (first..=last).map(move |row| (column, row))
        });
        let places: BTreeSet<Place> = places.collect();
        self.blocks.retain(|place, _| places.contains(place));
        let missing: Vec<Place> = places
            .into_iter()
            .filter(|place| !self.blocks.contains_key(place))
            .collect();
        let decoded = input.get(|source| source.decode(self.part, &self.grid, &missing))?;
        self.blocks.extend(missing.into_iter().zip(decoded));
        Ok(())
    }
}

/// Appends a line of colour as samples of this kind; returns how many are beyond its range.
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
