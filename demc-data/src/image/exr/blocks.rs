//! Blocks of pixels by their position in the image. The file is not trusted: its claims are checked
//! against its length before memory is allocated.

use std::collections::HashMap;
use std::io::{Read, Seek, SeekFrom};
use std::mem::size_of;

use ::exr::block::UncompressedBlock;
use ::exr::block::chunk::{
    Chunk, CompressedBlock, CompressedScanLineBlock, CompressedTileBlock, TileCoordinates,
};
use ::exr::error::Error as ExrError;
use ::exr::meta::header::Header;
use ::exr::meta::{BlockDescription, MetaData, compute_block_count};
use ::exr::prelude::Vec2;
use demc_program::parallel;

use super::decode::{check_density, decompress};
use super::failure::invalid;
use super::limits::check_size;

/// Bytes of pixels that are decoded or encoded at once, but at least one block per thread (ours:
/// small compared with an image).
const BATCH_BYTES: usize = 8 << 20;

/// The headers of a file, and its blocks on demand.
pub(super) struct BlockReader<R> {
    reader: R,
    pub(super) meta: MetaData,
    /// Start of the tables of block offsets, one per part.
    tables: u64,
    /// End of the tables and start of the blocks.
    blocks: u64,
    /// Length of the file in bytes.
    length: u64,
    pub(super) threads: usize,
    pub(super) kept: DecodedBlocks,
}

pub(super) type BlockPosition = (usize, usize);

enum LoadedBlock {
    Compressed(Chunk),
    Decoded(UncompressedBlock),
}

/// The blocks of a part at full size, in rows from the top. A block of scan lines is as wide as the
/// image.
pub(super) struct BlockGrid {
    pub(super) columns: usize,
    pub(super) rows: usize,
    pub(super) block: Vec2<usize>,
    /// Offsets of all blocks of the part; smaller levels come last.
    offsets: Vec<u64>,
}

impl BlockGrid {
    pub(super) fn place(&self, pixel: Vec2<usize>) -> BlockPosition {
        let Vec2(column, row) = pixel / self.block;
        (column, row)
    }
}

impl<R: Read + Seek> BlockReader<R> {
    pub(super) fn open(mut reader: R) -> Result<Self, ExrError> {
        let length = reader.seek(SeekFrom::End(0))?;
        reader.rewind()?;
        if length == 0 {
            return Err(invalid("it is empty".to_owned()));
        }
        let meta = ::exr::block::read(&mut reader, false)?.into_meta_data();
        for header in &meta.headers {
            let Vec2(width, height) = header.layer_size;
            check_size(width, height).map_err(|error| invalid(error.to_string()))?;
        }
        let tables = reader.stream_position()?;
        let counts = meta.headers.iter().map(|header| header.chunk_count as u64);
        let blocks = counts.fold(tables, |sum, count| {
            sum.saturating_add(count.saturating_mul(8))
        });
        if blocks > length {
            return Err(invalid(format!(
                "it is cut short: {length} bytes, but its blocks begin at {blocks}"
            )));
        }
        Ok(Self {
            reader,
            meta,
            tables,
            blocks,
            length,
            threads: parallel::threads().count,
            kept: DecodedBlocks::default(),
        })
    }

    /// Number of blocks of a part that are decoded or encoded at once.
    pub(super) fn batch(&self, header: &Header) -> usize {
        let blocks = BATCH_BYTES / block_bytes(header).max(1);
        blocks.next_multiple_of(self.threads).max(self.threads)
    }

    /// The table of a part's blocks.
    ///
    /// Refuses a part whose pixels cannot fit in the whole file.
    pub(super) fn grid(&mut self, part: usize) -> Result<BlockGrid, ExrError> {
        let header = &self.meta.headers[part];
        let (size, block) = (header.layer_size, header.max_block_pixel_size());
        check_density(header, size.area(), self.length)?;
        Ok(BlockGrid {
            columns: compute_block_count(size.width(), block.width()),
            rows: compute_block_count(size.height(), block.height()),
            block,
            offsets: self.offsets(part)?,
        })
    }

    /// Decodes blocks of the full-size image, except for cached ones.
    pub(super) fn decode(
        &mut self,
        part: usize,
        grid: &BlockGrid,
        places: &[BlockPosition],
    ) -> Result<Vec<UncompressedBlock>, ExrError> {
        let loaded: Vec<LoadedBlock> = places
            .iter()
            .map(|&place| match self.kept.take(part, place) {
                Some(block) => Ok(LoadedBlock::Decoded(block)),
                None => self.block(part, grid, place).map(LoadedBlock::Compressed),
            })
            .collect::<Result<_, ExrError>>()?;
        let meta = &self.meta;
        let decoded = parallel::map(self.threads, loaded, |block| match block {
            LoadedBlock::Decoded(block) => Ok(block),
            LoadedBlock::Compressed(chunk) => decompress(meta, chunk),
        });
        decoded.into_iter().collect()
    }

    fn block(
        &mut self,
        part: usize,
        grid: &BlockGrid,
        (column, row): BlockPosition,
    ) -> Result<Chunk, ExrError> {
        let place = TileCoordinates {
            tile_index: Vec2(column, row),
            level_index: Vec2(0, 0),
        };
        let offset = grid
            .offsets
            .get(row * grid.columns + column)
            .ok_or_else(|| invalid("it has too few blocks".to_owned()))?;
        self.chunk(part, *offset, place)
    }

    /// Offsets of the blocks of a part, in the order of the format: levels, then rows, then
    /// columns.
    pub(super) fn offsets(&mut self, part: usize) -> Result<Vec<u64>, ExrError> {
        let headers = &self.meta.headers;
        let before: usize = headers[..part].iter().map(|h| h.chunk_count).sum();
        let count = headers[part].chunk_count;
        self.reader
            .seek(SeekFrom::Start(self.tables + 8 * before as u64))?;
        // At most the length of the file: see `open`.
        let mut bytes = vec![0; 8 * count];
        self.reader.read_exact(&mut bytes)?;
        let offsets = bytes.as_chunks().0.iter();
        Ok(offsets.map(|&bytes| u64::from_le_bytes(bytes)).collect())
    }

    /// Checks that all blocks of a part are in the file: that each has an offset, and that the last one is
    /// complete.
    pub(super) fn check_whole(&mut self, part: usize) -> Result<(), ExrError> {
        let offsets = self.offsets(part)?;
        if offsets.iter().any(|offset| *offset < self.blocks) {
            return Err(incomplete_table());
        }
        let places = self.meta.headers[part].enumerate_ordered_blocks();
        let Some((index, tile)) = places.max_by_key(|(index, _)| offsets.get(*index)) else {
            return Ok(());
        };
        let offset = offsets.get(index).copied().ok_or_else(incomplete_table)?;
        self.chunk(part, offset, tile.location).map(drop)
    }

    /// Reads the block at an offset, still compressed, and checks that it belongs to `place`.
    pub(super) fn chunk(
        &mut self,
        part: usize,
        offset: u64,
        place: TileCoordinates,
    ) -> Result<Chunk, ExrError> {
        if offset < self.blocks || offset >= self.length {
            return Err(incomplete_table());
        }
        self.reader.seek(SeekFrom::Start(offset))?;
        let several = self.meta.requirements.is_multilayer();
        let header = &self.meta.headers[part];
        let tiled = matches!(header.blocks, BlockDescription::Tiles(_));
        let lines = header.compression.scan_lines_per_block() * place.tile_index.y();
        let first = i64::from(header.own_attributes.layer_position.y());
        let top = i32::try_from(first + lines as i64)?;
        let (tile, level) = (place.tile_index, place.level_index);
        let mut expected = Vec::with_capacity(5);
        expected.extend(several.then_some(part as i64));
        if tiled {
            expected.extend([tile.0, tile.1, level.0, level.1].map(|index| index as i64))
        } else {
            expected.push(i64::from(top))
        }
        for number in expected {
            if i64::from(integer(&mut self.reader)?) != number {
                return Err(invalid(
                    "a block of pixels is not where it belongs".to_owned(),
                ));
            }
        }
        let size = u64::try_from(integer(&mut self.reader)?)
            .map_err(|_| invalid("the size of a block is negative".to_owned()))?;
        let room = self.length - self.reader.stream_position()?.min(self.length);
        if size > room {
            return Err(invalid(format!(
                "it is cut short: a block has {size} bytes, {room} are left"
            )));
        }
        // An incompressible block is stored uncompressed. Blocks may overlap, so many blocks of
        // this size may be read at once.
        let limit = block_bytes(header);
        if size > limit as u64 {
            return Err(invalid(format!(
                "a block has {size} bytes for {limit} bytes of pixels"
            )));
        }
        let mut compressed_pixels_le = Vec::with_capacity(usize::try_from(size)?);
        (&mut self.reader)
            .take(size)
            .read_to_end(&mut compressed_pixels_le)?;
        Ok(Chunk {
            layer_index: part,
            compressed_block: if tiled {
                CompressedBlock::Tile(CompressedTileBlock {
                    coordinates: place,
                    compressed_pixels_le,
                })
            } else {
                CompressedBlock::ScanLine(CompressedScanLineBlock {
                    y_coordinate: top,
                    compressed_pixels_le,
                })
            },
        })
    }
}

fn incomplete_table() -> ExrError {
    invalid("its table of blocks is incomplete or damaged".to_owned())
}

type BlockKey = (usize, BlockPosition);

/// Decoded blocks of some parts, up to a memory limit.
#[derive(Default)]
pub(super) struct DecodedBlocks {
    parts: Vec<usize>,
    blocks: HashMap<BlockKey, UncompressedBlock>,
    bytes: usize,
    limit: usize,
}

impl DecodedBlocks {
    pub(super) fn new(parts: Vec<usize>, limit: usize) -> Self {
        Self {
            parts,
            limit,
            ..Self::default()
        }
    }

    pub(super) fn keep(
        &mut self,
        part: usize,
        places: &[BlockPosition],
        blocks: Vec<UncompressedBlock>,
    ) {
        if !self.parts.contains(&part) {
            return;
        }
        for (place, block) in places.iter().zip(blocks) {
            let bytes = self.bytes.saturating_add(bytes(&block));
            if bytes <= self.limit {
                self.bytes = bytes;
                self.blocks.insert((part, *place), block);
            }
        }
    }

    pub(super) fn take(&mut self, part: usize, place: BlockPosition) -> Option<UncompressedBlock> {
        let block = self.blocks.remove(&(part, place))?;
        self.bytes -= bytes(&block);
        Some(block)
    }
}

fn bytes(block: &UncompressedBlock) -> usize {
    block.data.len() + size_of::<BlockKey>() + size_of::<UncompressedBlock>()
}

/// Bytes of pixels in a part's largest block.
fn block_bytes(header: &Header) -> usize {
    let (block, image) = (header.max_block_pixel_size(), header.layer_size);
    let pixels = block.width().min(image.width()) * block.height().min(image.height());
    pixels.saturating_mul(header.channels.bytes_per_pixel)
}

fn integer(reader: &mut impl Read) -> Result<i32, ExrError> {
    let mut bytes = [0; 4];
    reader.read_exact(&mut bytes)?;
    Ok(i32::from_le_bytes(bytes))
}
