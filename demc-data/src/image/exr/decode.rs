//! Decompression of blocks. The file is not trusted: a block's claims are checked against its
//! length first.

use ::exr::block::UncompressedBlock;
use ::exr::block::chunk::{Chunk, CompressedBlock, CompressedScanLineBlock, CompressedTileBlock};
use ::exr::error::Error as ExrError;
use ::exr::meta::MetaData;
use ::exr::meta::attribute::ChannelList;
use ::exr::meta::header::Header;
use ::exr::prelude::{Compression, Vec2};

use super::failure::invalid;

/// A DWA block starts with this many 64-bit numbers: sizes, a version and a method.
const DWA_SIZES: usize = 11;
/// Bytes that compression may add to a part of an incompressible DWA block (ours).
const DWA_MARGIN: u64 = 1 << 16;

/// Decompresses a block. Decoders allocate memory for all its pixels, and for the sizes at the
/// start of a DWA block. Both are checked first.
pub(super) fn decompress(meta: &MetaData, chunk: Chunk) -> Result<UncompressedBlock, ExrError> {
    let header = &meta.headers[chunk.layer_index];
    let place = header.get_block_data_indices(&chunk.compressed_block)?;
    let area = header.get_absolute_block_pixel_coordinates(place)?.size;
    if let CompressedBlock::ScanLine(CompressedScanLineBlock {
        compressed_pixels_le: bytes,
        ..
    })
    | CompressedBlock::Tile(CompressedTileBlock {
        compressed_pixels_le: bytes,
        ..
    }) = &chunk.compressed_block
    {
        check_density(header, area.area(), bytes.len() as u64)?;
        // An incompressible block is stored as it is, without sizes.
        let stored = bytes.len() == area.area() * header.channels.bytes_per_pixel;
        if let Compression::DWAA(_) | Compression::DWAB(_) = header.compression
            && !stored
        {
            let mut sizes = bytes
                .as_chunks()
                .0
                .iter()
                .take(DWA_SIZES)
                .map(|&bytes| u64::from_le_bytes(bytes));
            // Samples of 8x8 squares, including partial ones, of two or four bytes, plus the growth
            // that compression may add.
            let Vec2(width, height) = area;
            let padded = width.next_multiple_of(8) * height.next_multiple_of(8);
            let limit = 2 * padded as u64 * header.channels.bytes_per_pixel as u64 + DWA_MARGIN;
            if sizes.any(|size| size > limit) {
                return Err(invalid(
                    "the sizes in a DWA block are impossible".to_owned(),
                ));
            }
        }
    }
    UncompressedBlock::decompress_chunk(chunk, meta, false)
}

/// Location of a channel's samples in the lines of a part's blocks.
#[derive(Clone, Copy)]
pub(super) struct SampleSpan {
    /// Bytes per pixel in all channels, and in the channels before this one.
    pixel: usize,
    before: usize,
    sample: usize,
}

impl SampleSpan {
    /// The locations of all channels of a part, in its order.
    pub(super) fn all(list: &ChannelList) -> Vec<Self> {
        let channels = list.channels_with_byte_offset();
        let spans = channels.map(|(before, channel)| Self {
            pixel: list.bytes_per_pixel,
            before,
            sample: channel.sample_type.bytes_per_sample(),
        });
        spans.collect()
    }

    /// The channel's bytes of a line in a block; `y` counts from the top of the image.
    ///
    /// # Panics
    /// If the block does not hold the line.
    pub(super) fn line(self, block: &UncompressedBlock, y: usize) -> &[u8] {
        let width = block.index.pixel_size.width();
        let row = y - block.index.pixel_position.y();
        let start = (row * self.pixel + self.before) * width;
        &block.data[start..start + width * self.sample]
    }
}

/// Checks that this many bytes can encode this many pixels.
pub(super) fn check_density(header: &Header, pixels: usize, bytes: u64) -> Result<(), ExrError> {
    let decoded = pixels as u64 * header.channels.bytes_per_pixel as u64;
    if decoded <= bytes.saturating_mul(densest(header.compression)) {
        Ok(())
    } else {
        Err(invalid(format!(
            "{bytes} bytes with {} cannot hold {decoded} bytes of pixels",
            header.compression
        )))
    }
}

/// Maximum number of bytes of pixels per compressed byte.
fn densest(compression: Compression) -> u64 {
    match compression {
        Compression::Uncompressed => 1,
        // A run of 128 bytes in two bytes.
        Compression::RLE => 64,
        // Deflate: 258 bytes in two bits.
        Compression::ZIP1 | Compression::ZIP16 => 1032,
        // Deflate, of three bytes out of four.
        Compression::PXR24 => 1376,
        // Huffman codes: a run of 256 samples of two bytes in ten bits.
        Compression::PIZ => 512,
        // 16 samples of two bytes in three bytes.
        Compression::B44 | Compression::B44A => 11,
        // A flat 8x8 square of four-byte samples is two numbers, one for its mean and one for the
        // rest. Deflate stores 258 bytes of each in two bits.
        Compression::DWAA(_) | Compression::DWAB(_) => 1 << 17,
        Compression::HTJ2K32 | Compression::HTJ2K256 => u64::MAX,
    }
}
