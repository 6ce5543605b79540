//! From the blocks of a file to those of its rewritten self, a few at a time.

use std::io::{Read, Seek, Write};
use std::path::Path;
use std::thread;

use ::exr::block::chunk::Chunk;
use ::exr::block::writer::{ChunkWriter, ChunksWriter};
use ::exr::block::{BlockIndex, UncompressedBlock};
use ::exr::error::{Error as ExrError, UnitResult};
use ::exr::meta::Headers;
use ::exr::meta::attribute::SampleType;
use ::exr::prelude::Vec2;
use half::f16;

use super::blocks::{Grid, Source};
use super::plan::{Origin, Plan};
use super::write::{io_error, saturated_half};
use super::{ExrFile, attributes, guarded};
use crate::{Error, file};

/// Blocks that are compressed at once, in bytes, but for one that is larger by itself (ours: enough work for many
/// processors, little beside the 400 MB of an 8K colour).
const BATCH_BYTES: usize = 64 << 20;

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
        let headers = self.headers;
        let header = &headers[part];
        let grid = self.input.get(|source| source.grid(from))?;
        let mut carried = Carried::new(from, grid, origins);
        let (mut batch, mut bytes) = (Vec::new(), 0);
        for (index, tile) in header.enumerate_ordered_blocks() {
            let area = header.get_absolute_block_pixel_coordinates(tile.location)?;
            let corner = area.position.to_usize("block position")?;
            let mut data = Vec::with_capacity(area.size.area() * header.channels.bytes_per_pixel);
            for y in corner.y()..corner.y() + area.size.height() {
                carried.seek(&mut self.input, Vec2(corner.x(), y))?;
                for (channel, origin) in header.channels.list.iter().zip(origins) {
                    match origin.plane {
                        Some(plane) => {
                            let start = (plane * header.layer_size.height() + y)
                                * header.layer_size.width()
                                + corner.x();
                            let line = &self.color_hdr[start..start + area.size.width()];
                            self.clamped += put(line, channel.sample_type, &mut data);
                        }
                        None => {
                            data.extend_from_slice(carried.line(self.input.source, origin.index, y))
                        }
                    }
                }
            }
            bytes += data.len();
            let block = BlockIndex {
                layer: part,
                pixel_position: corner,
                pixel_size: area.size,
                level: Vec2(0, 0),
            };
            batch.push((index, UncompressedBlock { index: block, data }));
            if bytes >= BATCH_BYTES {
                compress(std::mem::take(&mut batch), headers, blocks)?;
                bytes = 0;
            }
        }
        compress(batch, headers, blocks)
    }
}

/// The channels that come from the input: the block of it that was decoded last.
struct Carried {
    part: usize,
    grid: Grid,
    /// Whether there are any.
    any: bool,
    /// The block's place in the grid, and the block.
    held: Option<((usize, usize), UncompressedBlock)>,
}

impl Carried {
    fn new(part: usize, grid: Grid, origins: &[Origin]) -> Self {
        Self {
            part,
            grid,
            any: origins.iter().any(|origin| origin.plane.is_none()),
            held: None,
        }
    }

    /// Decodes the block that holds this pixel, unless it is the one at hand.
    fn seek<R: Read + Seek>(&mut self, input: &mut Input<'_, R>, pixel: Vec2<usize>) -> UnitResult {
        let Vec2(column, row) = pixel / self.grid.block;
        let place = (column, row);
        if self.any && self.held.as_ref().is_none_or(|(held, _)| *held != place) {
            // First, so that there is one at a time.
            self.held = None;
            let block = input.get(|source| source.block(self.part, &self.grid, place))?;
            self.held = Some((place, block));
        }
        Ok(())
    }

    /// The bytes of a channel's line in the block at hand.
    fn line<R>(&self, source: &Source<R>, channel: usize, y: usize) -> &[u8] {
        let (_, block) = self.held.as_ref().expect("sought before");
        let list = &source.meta.headers[self.part].channels;
        let width = block.index.pixel_size.width();
        let (before, channel) = list
            .channels_with_byte_offset()
            .nth(channel)
            .expect("the plan has the file's channels");
        let row = y - block.index.pixel_position.y();
        let start = (row * list.bytes_per_pixel + before) * width;
        &block.data[start..start + width * channel.sample_type.bytes_per_sample()]
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

/// Compresses blocks on all processors and writes them in their order.
fn compress<W: Write + Seek>(
    mut batch: Vec<(usize, UncompressedBlock)>,
    headers: &Headers,
    blocks: &mut ChunkWriter<W>,
) -> UnitResult {
    let threads = thread::available_parallelism().map_or(1, usize::from);
    let share = batch.len().div_ceil(threads).max(1);
    thread::scope(|scope| {
        let mut workers = Vec::with_capacity(threads);
        while !batch.is_empty() {
            let rest = batch.split_off(share.min(batch.len()));
            let mine = std::mem::replace(&mut batch, rest);
            let work = move || -> Result<Vec<(usize, Chunk)>, ExrError> {
                let chunks = mine.into_iter().map(|(index, block)| {
                    block.compress_to_chunk(headers).map(|chunk| (index, chunk))
                });
                chunks.collect()
            };
            workers.push(thread::Builder::new().spawn_scoped(scope, work)?);
        }
        for worker in workers {
            let chunks = worker
                .join()
                .unwrap_or_else(|panic| std::panic::resume_unwind(panic))?;
            for (index, chunk) in chunks {
                blocks.write_chunk(index, chunk)?;
            }
        }
        Ok(())
    })
}
