//! Blocks of pixels by their place in the image, as the file has them. The file is not trusted: what it says is held against its length
//! before memory is allocated for it.

use std::io::{Read, Seek, SeekFrom};

use ::exr::block::UncompressedBlock;
use ::exr::block::chunk::{
    Chunk, CompressedBlock, CompressedScanLineBlock, CompressedTileBlock, TileCoordinates,
};
use ::exr::error::Error as ExrError;
use ::exr::meta::header::Header;
use ::exr::meta::{BlockDescription, MetaData, compute_block_count};
use ::exr::prelude::Vec2;

use super::decode::{check_density, decompress};
use super::kept::Kept;
use super::{MAX_PIXELS, MAX_SIDE};
use crate::parallel;

/// Blocks that are decoded or coded at once, in bytes of pixels, but at least one for each thread (ours: little beside an
/// image).
const BATCH_BYTES: usize = 8 << 20;

/// Headers of a file, and its blocks on demand.
pub(super) struct Source<R> {
    reader: R,
    pub(super) meta: MetaData,
    /// Where the tables of block offsets begin, one a part.
    tables: u64,
    /// Where they end and blocks begin.
    blocks: u64,
    /// Bytes in the file.
    length: u64,
    /// How many decode and code blocks.
    pub(super) threads: usize,
    pub(super) kept: Kept,
}

/// Column and row of a block.
pub(super) type Place = (usize, usize);

enum Block {
    Compressed(Chunk),
    Decoded(UncompressedBlock),
}

/// The blocks of a part in its full size, in rows from the top; a block of scan lines is as wide as the image.
pub(super) struct Grid {
    pub(super) columns: usize,
    pub(super) rows: usize,
    pub(super) block: Vec2<usize>,
    /// Offsets of all blocks of the part; those of smaller levels come last.
    offsets: Vec<u64>,
}

impl Grid {
    /// The block that holds this pixel.
    pub(super) fn place(&self, pixel: Vec2<usize>) -> Place {
        let Vec2(column, row) = pixel / self.block;
        (column, row)
    }
}

impl<R: Read + Seek> Source<R> {
    /// Reads the headers and checks them.
    pub(super) fn open(mut reader: R) -> Result<Self, ExrError> {
        let length = reader.seek(SeekFrom::End(0))?;
        reader.rewind()?;
        let meta = ::exr::block::read(&mut reader, false)?.into_meta_data();
        meta.headers.iter().try_for_each(check_size)?;
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
            threads: parallel::available(),
            kept: Kept::default(),
        })
    }

    /// How many blocks of a part are decoded or coded at once.
    pub(super) fn batch(&self, header: &Header) -> usize {
        let blocks = BATCH_BYTES / block_bytes(header).max(1);
        blocks.next_multiple_of(self.threads).max(self.threads)
    }

    /// The table of a part's blocks.
    ///
    /// Refuses a part whose pixels are more than the whole file can stand for.
    pub(super) fn grid(&mut self, part: usize) -> Result<Grid, ExrError> {
        let header = &self.meta.headers[part];
        let (size, block) = (header.layer_size, header.max_block_pixel_size());
        check_density(header, size.area(), self.length)?;
        Ok(Grid {
            columns: compute_block_count(size.width(), block.width()),
            rows: compute_block_count(size.height(), block.height()),
            block,
            offsets: self.offsets(part)?,
        })
    }

    /// Decodes blocks of the full-size image, but for those that were kept.
    pub(super) fn decode(
        &mut self,
        part: usize,
        grid: &Grid,
        places: &[Place],
    ) -> Result<Vec<UncompressedBlock>, ExrError> {
        let blocks = places
            .iter()
            .map(|&place| match self.kept.take(part, place) {
                Some(block) => Ok(Block::Decoded(block)),
                None => self.block(part, grid, place).map(Block::Compressed),
            });
        let blocks: Vec<Block> = blocks.collect::<Result<_, _>>()?;
        let meta = &self.meta;
        let blocks = parallel::map(self.threads, blocks, |block| match block {
            Block::Decoded(block) => Ok(block),
            Block::Compressed(chunk) => decompress(meta, chunk),
        });
        blocks.into_iter().collect()
    }

    /// Reads the block in this place of the full-size image, still compressed.
    fn block(&mut self, part: usize, grid: &Grid, (column, row): Place) -> Result<Chunk, ExrError> {
        let place = TileCoordinates {
            tile_index: Vec2(column, row),
            level_index: Vec2(0, 0),
        };
        let offset = grid.offsets.get(row * grid.columns + column).copied();
        let offset = offset.ok_or_else(|| invalid("it has too few blocks".to_owned()))?;
        self.chunk(part, offset, place)
    }

    /// Where the blocks of a part are, in the order of the format: levels, then rows, then columns.
    pub(super) fn offsets(&mut self, part: usize) -> Result<Vec<u64>, ExrError> {
        let headers = &self.meta.headers;
        let before: usize = headers[..part].iter().map(|h| h.chunk_count).sum();
        let count = headers[part].chunk_count;
        self.reader
            .seek(SeekFrom::Start(self.tables + 8 * before as u64))?;
        // At most the file's own length: see `open`.
        let mut bytes = vec![0; 8 * count];
        self.reader.read_exact(&mut bytes)?;
        let offsets = bytes.as_chunks().0.iter();
        Ok(offsets.map(|&bytes| u64::from_le_bytes(bytes)).collect())
    }

    /// Reads the block at an offset, still compressed, and checks that it is the one that belongs to `place`.
    pub(super) fn chunk(
        &mut self,
        part: usize,
        offset: u64,
        place: TileCoordinates,
    ) -> Result<Chunk, ExrError> {
        if offset < self.blocks || offset >= self.length {
            return Err(invalid(
                "its table of blocks is incomplete or damaged".to_owned(),
            ));
        }
        self.reader.seek(SeekFrom::Start(offset))?;
        let several = self.meta.requirements.is_multilayer();
        let header = &self.meta.headers[part];
        let tiled = matches!(header.blocks, BlockDescription::Tiles(_));
        let lines = header.compression.scan_lines_per_block() * place.tile_index.y();
        let top = i64::from(header.own_attributes.layer_position.y()) + lines as i64;
        let top = i32::try_from(top)?;
        let (tile, level) = (place.tile_index, place.level_index);
        let mut expected = Vec::with_capacity(5);
        expected.extend(several.then_some(part as i64));
        match tiled {
            true => expected.extend([tile.0, tile.1, level.0, level.1].map(|index| index as i64)),
            false => expected.push(i64::from(top)),
        }
        for number in expected {
            if i64::from(integer(&mut self.reader)?) != number {
                return Err(invalid(
                    "a block of pixels is not where it belongs".to_owned(),
                ));
            }
        }
        let size = integer(&mut self.reader)?;
        let size = u64::try_from(size)
            .map_err(|_| invalid("the size of a block is negative".to_owned()))?;
        let room = self.length - self.reader.stream_position()?.min(self.length);
        if size > room {
            return Err(invalid(format!(
                "it is cut short: a block has {size} bytes, {room} are left"
            )));
        }
        // What does not shrink is stored as it is. Blocks may lie over each other: many of this size may come at once.
        let most = block_bytes(header);
        if size > most as u64 {
            return Err(invalid(format!(
                "a block has {size} bytes for {most} bytes of pixels"
            )));
        }
        let mut compressed_pixels_le = Vec::with_capacity(usize::try_from(size)?);
        (&mut self.reader)
            .take(size)
            .read_to_end(&mut compressed_pixels_le)?;
        Ok(Chunk {
            layer_index: part,
            compressed_block: match tiled {
                true => CompressedBlock::Tile(CompressedTileBlock {
                    coordinates: place,
                    compressed_pixels_le,
                }),
                false => CompressedBlock::ScanLine(CompressedScanLineBlock {
                    y_coordinate: top,
                    compressed_pixels_le,
                }),
            },
        })
    }
}

/// Bytes of pixels of a part's largest block.
fn block_bytes(header: &Header) -> usize {
    let (block, image) = (header.max_block_pixel_size(), header.layer_size);
    let pixels = block.width().min(image.width()) * block.height().min(image.height());
    pixels.saturating_mul(header.channels.bytes_per_pixel)
}

pub(super) fn invalid(detail: String) -> ExrError {
    ExrError::Invalid(detail.into())
}

fn integer(reader: &mut impl Read) -> Result<i32, ExrError> {
    let mut bytes = [0; 4];
    reader.read_exact(&mut bytes)?;
    Ok(i32::from_le_bytes(bytes))
}

fn check_size(header: &Header) -> Result<(), ExrError> {
    let Vec2(width, height) = header.layer_size;
    let sides = 1..=MAX_SIDE;
    if sides.contains(&width) && sides.contains(&height) && width * height <= MAX_PIXELS {
        return Ok(());
    }
    Err(invalid(format!(
        "its size is {width}x{height}, not 1x1 to {MAX_SIDE}x{MAX_SIDE} with at most {MAX_PIXELS} pixels"
    )))
}
