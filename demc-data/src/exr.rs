//! OpenEXR in and out, and the only file that imports the `exr` crate.
//!
//! Reading is in two steps: [`ExrFile::open`] reads and checks the headers, [`ExrFile::read`] decodes the
//! channels that are asked for, each in its own precision. A channel's name is `Layer.channel` in a file of
//! several parts and the channel's own name (dots and all) in a file of one.

use std::collections::HashSet;
use std::fs::File;
use std::io::{self, BufReader};
use std::panic::{AssertUnwindSafe, catch_unwind};
use std::path::{Path, PathBuf};

use ::exr::block::UncompressedBlock;
use ::exr::block::chunk::{Chunk, CompressedBlock, CompressedScanLineBlock, CompressedTileBlock};
use ::exr::block::lines::LineRef;
use ::exr::block::reader::{ChunksReader, Reader};
use ::exr::error::{Error as ExrError, UnitResult};
use ::exr::meta::MetaData;
use ::exr::meta::attribute::SampleType;
use ::exr::meta::header::Header;
use ::exr::prelude::{
    AnyChannel, AnyChannels, Blocks, Compression, Encoding, FlatSamples, Image, Layer,
    LayerAttributes, LineOrder, WritableImage,
};
use half::f16;

use crate::channel::{Channel, Kind, Window, full_name};
use crate::plane::Plane;
use crate::{Error, file};

/// Largest accepted width or height, in pixels (ours: four times an 8K frame's width).
pub const MAX_SIDE: usize = 32_768;
/// Largest accepted number of pixels of a part (ours: 16K x 8K), so that a damaged header cannot ask for
/// all the memory there is.
pub const MAX_PIXELS: usize = 1 << 27;

/// A DWA block starts with this many 64-bit numbers: sizes, a version and a method.
const DWA_SIZES: usize = 11;
/// Largest size accepted there, in bytes: 256 lines of the widest image with a dozen channels and more.
const MAX_BLOCK_BYTES: u64 = 1 << 29;

/// An open file whose headers were read and checked; its pixels were not decoded yet.
pub struct ExrFile {
    path: PathBuf,
    reader: Reader<BufReader<File>>,
    channels: Vec<Channel>,
}

impl ExrFile {
    /// Opens `path` and reads its headers.
    ///
    /// # Errors
    /// [`Error::Read`] if it cannot be opened, [`Error::Exr`] if it is no EXR file, its header is damaged, or
    /// a part is empty or larger than [`MAX_SIDE`] or [`MAX_PIXELS`].
    pub fn open(path: &Path) -> Result<Self, Error> {
        let read_error = |source| Error::Read {
            path: path.to_owned(),
            source,
        };
        let file = File::open(path).map_err(read_error)?;
        let reader = guarded(path, || ::exr::block::read(BufReader::new(file), false))?;
        let mut channels = Vec::new();
        for (part, header) in reader.headers().iter().enumerate() {
            let window = window_of(header);
            let (width, height) = (window.width, window.height);
            if width == 0
                || height == 0
                || width > MAX_SIDE
                || height > MAX_SIDE
                || width * height > MAX_PIXELS
            {
                let limit =
                    format!("1x1 to {MAX_SIDE}x{MAX_SIDE} with at most {MAX_PIXELS} pixels");
                return Err(undecodable(
                    path,
                    format!("its size is {width}x{height}, not {limit}"),
                ));
            }
            let layer = header
                .own_attributes
                .layer_name
                .as_ref()
                .map(ToString::to_string);
            let several = reader.headers().len() > 1;
            for (index, channel) in header.channels.list.iter().enumerate() {
                channels.push(Channel {
                    name: full_name(
                        layer.as_deref().filter(|_| several),
                        &channel.name.to_string(),
                    ),
                    kind: match channel.sample_type {
                        SampleType::F16 => Kind::Half,
                        SampleType::F32 => Kind::Float,
                        SampleType::U32 => Kind::Uint,
                    },
                    layer: layer.clone(),
                    window,
                    part,
                    index,
                });
            }
        }
        Ok(Self {
            path: path.to_owned(),
            reader,
            channels,
        })
    }

    /// The channels of all parts, in the file's order.
    pub fn channels(&self) -> &[Channel] {
        &self.channels
    }

    /// The channel of this name; the first, should there be several.
    pub fn channel(&self, name: &str) -> Option<&Channel> {
        self.channels.iter().find(|channel| channel.name == name)
    }

    /// Checks that the file has all these channels.
    ///
    /// # Errors
    /// [`Error::MissingChannels`], naming those that it lacks, each once, and those that it has.
    pub fn require(&self, names: &[&str]) -> Result<(), Error> {
        let mut missing: Vec<String> = Vec::new();
        for name in names.iter().filter(|name| self.channel(name).is_none()) {
            // A texture that stands in for another is asked for twice.
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

    /// Decodes the named channels, in the order of `names`; other parts and smaller resolution levels are
    /// not touched.
    ///
    /// # Errors
    /// [`Error::MissingChannels`] if the file lacks any; [`Error::Exr`] if the pixel data is cut short or
    /// damaged, deep or subsampled.
    pub fn read(self, names: &[&str]) -> Result<Vec<Plane>, Error> {
        self.require(names)?;
        let wanted: Vec<Channel> = names
            .iter()
            .filter_map(|name| self.channel(name))
            .cloned()
            .collect();
        for channel in &wanted {
            let header = &self.reader.headers()[channel.part];
            if header.deep
                || header
                    .channels
                    .list
                    .iter()
                    .any(|c| c.sampling.0 != 1 || c.sampling.1 != 1)
            {
                let detail = format!(
                    "channel {}: deep or subsampled data is not read",
                    channel.name
                );
                return Err(undecodable(&self.path, detail));
            }
        }
        let reader = self.reader;
        guarded(&self.path, || decode(reader, &wanted))
    }
}

/// Decodes every block of the parts that hold a wanted channel, on this thread.
fn decode(reader: Reader<BufReader<File>>, wanted: &[Channel]) -> Result<Vec<Plane>, ExrError> {
    let mut planes: Vec<Plane> = wanted.iter().map(empty_plane).collect();
    let parts: HashSet<usize> = wanted.iter().map(|channel| channel.part).collect();
    let chunks = reader.filter_chunks(false, |_, tile, block| {
        parts.contains(&block.layer) && tile.is_largest_resolution_level()
    })?;
    // As many blocks are read as there should be: if all are new, none is missing.
    let mut seen = HashSet::new();
    let meta = chunks.meta_data().clone();
    for chunk in chunks {
        let block = decompress(chunk?, &meta)?;
        let at = block.index;
        let is_new = seen.insert((at.layer, at.pixel_position));
        if !parts.contains(&at.layer) || (at.level.0, at.level.1) != (0, 0) || !is_new {
            return Err(ExrError::Invalid(
                "a block of pixels is not where it belongs".into(),
            ));
        }
        for line in block.lines(&meta.headers[at.layer].channels) {
            let location = line.location;
            for (channel, plane) in wanted.iter().zip(&mut planes) {
                if (channel.part, channel.index) == (location.layer, location.channel) {
                    copy_line(line, channel.window.width, plane)?;
                }
            }
        }
    }
    Ok(planes)
}

/// Decompresses a block. The decoder allocates whatever the sizes at the start of a DWA block say, which in
/// a damaged file ends the program: they are checked first.
fn decompress(chunk: Chunk, meta: &MetaData) -> Result<UncompressedBlock, ExrError> {
    let compression = meta
        .headers
        .get(chunk.layer_index)
        .map(|header| header.compression);
    if let (
        Some(Compression::DWAA(_) | Compression::DWAB(_)),
        CompressedBlock::ScanLine(CompressedScanLineBlock {
            compressed_pixels_le: bytes,
            ..
        })
        | CompressedBlock::Tile(CompressedTileBlock {
            compressed_pixels_le: bytes,
            ..
        }),
    ) = (compression, &chunk.compressed_block)
    {
        let mut sizes = bytes
            .as_chunks()
            .0
            .iter()
            .take(DWA_SIZES)
            .map(|&bytes| u64::from_le_bytes(bytes));
        if sizes.any(|size| size > MAX_BLOCK_BYTES) {
            return Err(ExrError::Invalid(
                "the sizes in a DWA block are impossible".into(),
            ));
        }
    }
    UncompressedBlock::decompress_chunk(chunk, meta, false)
}

fn copy_line(line: LineRef<'_>, width: usize, plane: &mut Plane) -> UnitResult {
    let start = line.location.position.1 * width + line.location.position.0;
    let range = start..start + line.location.sample_count;
    match plane {
        Plane::Half(samples) => line.read_samples_into_slice(&mut samples[range]),
        Plane::Float(samples) => line.read_samples_into_slice(&mut samples[range]),
        Plane::Uint(samples) => line.read_samples_into_slice(&mut samples[range]),
    }
}

fn empty_plane(channel: &Channel) -> Plane {
    let samples = channel.window.width * channel.window.height;
    match channel.kind {
        Kind::Half => Plane::Half(vec![f16::ZERO; samples]),
        Kind::Float => Plane::Float(vec![0.0; samples]),
        Kind::Uint => Plane::Uint(vec![0; samples]),
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

/// Runs the decoder; damaged bytes can fail its internal assertions, which must not end the program.
fn guarded<T>(path: &Path, work: impl FnOnce() -> Result<T, ExrError>) -> Result<T, Error> {
    match catch_unwind(AssertUnwindSafe(work)) {
        Ok(Ok(value)) => Ok(value),
        Ok(Err(ExrError::Io(source))) => Err(Error::Read {
            path: path.to_owned(),
            source,
        }),
        Ok(Err(ExrError::Invalid(detail) | ExrError::NotSupported(detail))) => {
            Err(undecodable(path, detail.into_owned()))
        }
        Ok(Err(ExrError::Aborted)) => Err(undecodable(path, "reading was aborted".to_owned())),
        Err(_) => Err(undecodable(
            path,
            "the decoder gave up on damaged data".to_owned(),
        )),
    }
}

fn undecodable(path: &Path, detail: String) -> Error {
    Error::Exr {
        path: path.to_owned(),
        detail,
    }
}

/// The sample type of a written image.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Precision {
    /// 16 bits; values beyond its range (65504) are written as the largest.
    Half,
    /// 32 bits.
    Float,
}

/// Writes linear radiance as an EXR file with channels `R G B`, ZIP-compressed, whole or not at all.
///
/// # Shapes
/// `rgb` is `[3, height, width]`.
///
/// # Errors
/// [`Error::Write`], naming `path`.
///
/// # Panics
/// If `rgb` has another length.
pub fn write_rgb(
    path: &Path,
    width: usize,
    height: usize,
    rgb: &[f32],
    precision: Precision,
) -> Result<(), Error> {
    assert_eq!(
        rgb.len(),
        3 * width * height,
        "rgb must be [3, {height}, {width}]"
    );
    let channels = ["R", "G", "B"]
        .into_iter()
        .zip(rgb.chunks_exact(width * height))
        .map(|(name, plane)| {
            let samples = match precision {
                Precision::Half => {
                    FlatSamples::F16(plane.iter().map(|&v| saturated_half(v)).collect())
                }
                Precision::Float => FlatSamples::F32(plane.to_vec()),
            };
            AnyChannel::new(name, samples)
        });
    let layer = Layer::new(
        (width, height),
        LayerAttributes::default(),
        Encoding {
            compression: Compression::ZIP16,
            blocks: Blocks::ScanLines,
            line_order: LineOrder::Increasing,
        },
        AnyChannels::sort(channels.collect()),
    );
    let image = Image::from_layer(layer);
    file::write_whole(path, |writer| {
        image
            .write()
            .non_parallel()
            .to_buffered(writer)
            .map_err(|error| match error {
                ExrError::Io(source) => source,
                other => io::Error::other(other.to_string()),
            })
    })
}

fn saturated_half(value: f32) -> f16 {
    f16::from_f32(value.clamp(f16::MIN.to_f32(), f16::MAX.to_f32()))
}
