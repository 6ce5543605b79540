//! Blocks of pixels by their place in the image. The file is not trusted: what it says is held against its length
//! before memory is allocated for it.

use std::collections::HashMap;
use std::io::{Read, Seek, SeekFrom};

use ::exr::block::UncompressedBlock;
use ::exr::block::chunk::{
    Chunk, CompressedBlock, CompressedScanLineBlock, CompressedTileBlock, TileCoordinates,
};
use ::exr::error::Error as ExrError;
use ::exr::meta::attribute::ChannelList;
use ::exr::meta::header::Header;
use ::exr::meta::{BlockDescription, MetaData, compute_block_count};
use ::exr::prelude::{Compression, Vec2};

use super::{MAX_PIXELS, MAX_SIDE};
use crate::parallel::{self, processors};

/// Blocks that are decoded or coded at once, in bytes of pixels, but at least one for each processor (ours: what stays in
/// a cache).
const BATCH_BYTES: usize = 8 << 20;
/// A DWA block starts with this many 64-bit numbers: sizes, a version and a method.
const DWA_SIZES: usize = 11;
/// Largest size accepted there, in bytes: 256 lines of the widest image with a dozen channels and more.
const MAX_DWA_BYTES: u64 = 1 << 29;

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
    kept: Kept,
}

/// Decoded blocks that will be asked for again.
#[derive(Default)]
struct Kept {
    /// By part and place.
    blocks: HashMap<(usize, Place), UncompressedBlock>,
    /// Bytes for which there is room.
    room: usize,
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
            kept: Kept::default(),
        })
    }

    /// Makes room for decoded blocks.
    pub(super) fn make_room(&mut self, bytes: usize) {
        self.kept.room = bytes;
    }

    /// Keeps decoded blocks, as many as there is room for.
    pub(super) fn keep(&mut self, part: usize, places: &[Place], blocks: Vec<UncompressedBlock>) {
        for (place, block) in places.iter().zip(blocks) {
            if let Some(room) = self.kept.room.checked_sub(block.data.len()) {
                self.kept.room = room;
                self.kept.blocks.insert((part, *place), block);
            }
        }
    }

    /// Takes a block out of those that were kept.
    fn take(&mut self, part: usize, place: Place) -> Option<UncompressedBlock> {
        let block = self.kept.blocks.remove(&(part, place))?;
        self.kept.room += block.data.len();
        Some(block)
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

    /// Decodes blocks of the full-size image on all processors, but for those that were kept.
    pub(super) fn decode(
        &mut self,
        part: usize,
        grid: &Grid,
        places: &[Place],
    ) -> Result<Vec<UncompressedBlock>, ExrError> {
        let blocks = places.iter().map(|&place| match self.take(part, place) {
            Some(block) => Ok(Block::Decoded(block)),
            None => self.block(part, grid, place).map(Block::Compressed),
        });
        let blocks: Vec<Block> = blocks.collect::<Result<_, _>>()?;
        let meta = &self.meta;
        let blocks = parallel::map(processors(), blocks, |block| match block {
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

/// How many blocks of so many bytes are decoded or coded at once.
pub(super) fn batch(block_bytes: usize) -> usize {
    let threads = processors();
    (BATCH_BYTES / block_bytes.max(1))
        .next_multiple_of(threads)
        .max(threads)
}

/// Decompresses a block. Decoders allocate for all the pixels that it should have, and for the sizes at the start
/// of a DWA block whatever they are: both are checked first.
fn decompress(meta: &MetaData, chunk: Chunk) -> Result<UncompressedBlock, ExrError> {
    let header = &meta.headers[chunk.layer_index];
    let place = header.get_block_data_indices(&chunk.compressed_block)?;
    let pixels = header
        .get_absolute_block_pixel_coordinates(place)?
        .size
        .area();
    if let CompressedBlock::ScanLine(CompressedScanLineBlock {
        compressed_pixels_le: bytes,
        ..
    })
    | CompressedBlock::Tile(CompressedTileBlock {
        compressed_pixels_le: bytes,
        ..
    }) = &chunk.compressed_block
    {
        check_density(header, pixels, bytes.len() as u64)?;
        if let Compression::DWAA(_) | Compression::DWAB(_) = header.compression {
            let sizes = bytes.as_chunks().0.iter().take(DWA_SIZES);
            let mut sizes = sizes.map(|&bytes| u64::from_le_bytes(bytes));
            if sizes.any(|size| size > MAX_DWA_BYTES) {
                return Err(invalid(
                    "the sizes in a DWA block are impossible".to_owned(),
                ));
            }
        }
    }
    UncompressedBlock::decompress_chunk(chunk, meta, false)
}

/// The bytes of a channel's line in a block; `y` counts from the top of the image.
///
/// # Panics
/// If the block does not hold the line, or its part not the channel.
pub(super) fn line<'a>(
    block: &'a UncompressedBlock,
    list: &ChannelList,
    channel: usize,
    y: usize,
) -> &'a [u8] {
    let width = block.index.pixel_size.width();
    let (before, channel) = list
        .channels_with_byte_offset()
        .nth(channel)
        .expect("a channel of the part");
    let row = y - block.index.pixel_position.y();
    let start = (row * list.bytes_per_pixel + before) * width;
    &block.data[start..start + width * channel.sample_type.bytes_per_sample()]
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

/// Checks that so many bytes can stand for so many pixels.
fn check_density(header: &Header, pixels: usize, bytes: u64) -> Result<(), ExrError> {
    let decoded = pixels as u64 * header.channels.bytes_per_pixel as u64;
    match decoded <= bytes.saturating_mul(densest(header.compression)) {
        true => Ok(()),
        false => Err(invalid(format!(
            "{bytes} bytes with {} cannot hold {decoded} bytes of pixels",
            header.compression
        ))),
    }
}

/// The most bytes of pixels that a compressed byte can stand for.
fn densest(compression: Compression) -> u64 {
    match compression {
        Compression::Uncompressed => 1,
        // A run of 128 in two bytes.
        Compression::RLE => 64,
        // Deflate: 258 bytes in two bits.
        Compression::ZIP1 | Compression::ZIP16 => 1032,
        // Deflate, of three bytes in four.
        Compression::PXR24 => 1376,
        // Huffman codes: a run of 256 samples of two bytes in ten bits.
        Compression::PIZ => 512,
        // 16 samples of two bytes in three bytes.
        Compression::B44 | Compression::B44A => 11,
        // A flat square of 64 samples of four bytes is a number for its mean and one for the rest: 258 bytes of each in
        // two bits.
        Compression::DWAA(_) | Compression::DWAB(_) => 1 << 17,
        Compression::HTJ2K32 | Compression::HTJ2K256 => u64::MAX,
    }
}
