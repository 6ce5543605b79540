//! Joins the channels of several files in one file of one part.
//!
//! Samples keep their type and their bits. The attributes are those of the first file, and those of
//! the others that the first lacks. The compression is the first file's if it changes no sample,
//! otherwise ZIP.

use std::io::{Read, Seek};
use std::path::Path;

use ::exr::error::Error as ExrError;
use ::exr::meta::attribute::{self, AttributeValue, ChannelDescription, ChannelList, Text};
use ::exr::meta::header::{Header, standard_names};
use ::exr::meta::{BlockDescription, Headers, MetaData};
use ::exr::prelude::LineOrder;
use demc_program::file::{self, FileError};
use demc_program::message::printable;
use demc_program::parallel;

use super::compression::Compression;
use super::failure::{guarded, invalid, io_error};
use super::key_code;
use super::read::ExrFile;
use super::recode::{OutputBlock, compress, sort_attributes, targets};
use crate::error::Error;
use crate::image::channel::Channel;
use crate::image::plane::Plane;

/// Longest channel name of the format in bytes.
const LONGEST_NAME: usize = 255;

/// Magic number and version of an EXR file with long names.
const START: [u8; 8] = [0x76, 0x2f, 0x31, 0x01, 2, 4, 0, 0];

/// Attributes that describe how a part is stored; the joined part has its own.
const STORAGE: [&[u8]; 13] = [
    standard_names::TILES,
    standard_names::NAME,
    standard_names::BLOCK_TYPE,
    standard_names::DEEP_DATA_VERSION,
    standard_names::CHUNKS,
    standard_names::MAX_SAMPLES,
    standard_names::CHANNELS,
    standard_names::COMPRESSION,
    standard_names::DATA_WINDOW,
    standard_names::LINE_ORDER,
    standard_names::DWA_COMPRESSION_LEVEL,
    b"view",
    b"multiView",
];

/// A file to join.
pub struct MergeInput<R> {
    /// The open file.
    pub file: ExrFile<R>,
    /// Its channels are called `PREFIX.channel`; without a prefix they keep their names.
    pub prefix: Option<String>,
    /// A start of the channels' names, without its dot, that is removed before the prefix is added.
    pub strip: Option<String>,
}

/// The result of a merge.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Merged {
    /// The channels of the output, sorted.
    pub channels: Vec<String>,
    /// Attributes that differ between the files; the output has the value of the first file that
    /// has them.
    pub conflicts: Vec<String>,
}

/// Joins files. The output is complete or absent. All planes are in memory at once.
///
/// # Errors
/// [`Error::Merge`] without files, for channels of one name, and for channels that cover different
/// pixels. [`Error::Exr`] and [`Error::File`] for a damaged input; [`Error::File`] also for the output.
pub fn merge<R: Read + Seek>(inputs: &mut [MergeInput<R>], output: &Path) -> Result<Merged, Error> {
    let mut columns = columns(inputs)?;
    check_windows(inputs, &columns)?;
    columns.sort_by(|a, b| a.name.cmp(&b.name));
    check_names(inputs, &columns)?;

    let path = inputs[0].file.path().to_owned();
    let (header, conflicts) = guarded(&path, || joined_header(inputs, &columns))?;
    let planes = planes(inputs, &columns)?;
    let threads = inputs[0].file.source.threads;
    write(&header, &planes, threads, output)?;
    Ok(Merged {
        channels: columns.into_iter().map(|column| column.name).collect(),
        conflicts,
    })
}

/// A channel of the output and its origin.
struct Column {
    name: String,
    input: usize,
    channel: Channel,
}

fn columns<R: Read + Seek>(inputs: &[MergeInput<R>]) -> Result<Vec<Column>, Error> {
    let mut columns = Vec::new();
    for (
        input,
        MergeInput {
            file,
            prefix,
            strip,
        },
    ) in inputs.iter().enumerate()
    {
        columns.extend(file.channels().iter().map(|channel| {
            let stripped = strip.as_deref().and_then(|strip| {
                let rest = channel.name.strip_prefix(strip)?;
                rest.strip_prefix('.')
            });
            let name = stripped.unwrap_or(&channel.name);
            Column {
                name: match prefix {
                    Some(prefix) => format!("{prefix}.{name}"),
                    None => name.to_owned(),
                },
                input,
                channel: channel.clone(),
            }
        }));
    }
    if columns.is_empty() {
        Err(Error::Merge("no files".to_owned()))
    } else {
        Ok(columns)
    }
}

fn check_windows<R: Read + Seek>(
    inputs: &[MergeInput<R>],
    columns: &[Column],
) -> Result<(), Error> {
    let first = &columns[0];
    let differs = |column: &&Column| column.channel.window != first.channel.window;
    let Some(other) = columns.iter().find(differs) else {
        return Ok(());
    };
    let shown = |column: &Column| {
        let path = inputs[column.input].file.path().display();
        let Channel { name, window, .. } = &column.channel;
        format!("channel {name} of {path} covers {window}")
    };
    Err(Error::Merge(format!(
        "{}, {}; all files must have one size and data window",
        shown(first),
        shown(other)
    )))
}

/// Checks sorted columns.
fn check_names<R: Read + Seek>(inputs: &[MergeInput<R>], columns: &[Column]) -> Result<(), Error> {
    let path = |column: &Column| inputs[column.input].file.path().display();
    if let Some(long) = columns.iter().find(|c| c.name.len() > LONGEST_NAME) {
        return Err(Error::Merge(format!(
            "a channel name of {} would have {} bytes; the format allows {LONGEST_NAME}",
            path(long),
            long.name.len()
        )));
    }
    match columns.windows(2).find(|pair| pair[0].name == pair[1].name) {
        None => Ok(()),
        Some([a, b]) if a.input == b.input => Err(Error::Merge(format!(
            "{} has two channels called {}",
            path(a),
            a.name
        ))),
        Some(pair) => Err(Error::Merge(format!(
            "{} and {} both give a channel {}; rename one with NAME=FILE",
            path(&pair[0]),
            path(&pair[1]),
            pair[0].name
        ))),
    }
}

/// The header of the output, and the names of attributes with several values.
fn joined_header<R: Read + Seek>(
    inputs: &[MergeInput<R>],
    columns: &[Column],
) -> Result<(Header, Vec<String>), ExrError> {
    let headers = |input: &MergeInput<R>| input.file.source.meta.headers.clone();
    let first = &headers(&inputs[0])[0];
    let mut known: Vec<(Vec<u8>, AttributeValue)> = Vec::new();
    let mut conflicts = Vec::new();
    for header in inputs.iter().flat_map(headers) {
        let mut header = header;
        key_code::keep_whole(&mut header);
        for (name, value) in header.all_named_attributes() {
            if STORAGE.contains(&name) {
                continue;
            }
            match known.iter().find(|(other, _)| other == name) {
                None => known.push((name.to_vec(), value)),
                Some((_, other)) if *other == value => {}
                Some(_) => {
                    let name = String::from_utf8_lossy(name);
                    conflicts.push(printable(&name));
                }
            }
        }
    }
    // The name of the only part of the first file is no part of the channels' names.
    let layer_name = first
        .own_attributes
        .layer_name
        .clone()
        .filter(|_| headers(&inputs[0]).len() == 1);
    conflicts.sort_unstable();
    conflicts.dedup();

    // The crate has a field for each standard attribute; its parser fills them by name.
    let mut bytes = START.to_vec();
    for (name, value) in first.all_named_attributes() {
        if STORAGE.contains(&name) {
            attribute::write(name, &value, &mut bytes)?;
        }
    }
    for (name, value) in &known {
        attribute::write(name, value, &mut bytes)?;
    }
    bytes.push(0);
    let mut header = MetaData::read_from_buffered(&bytes[..], false)?
        .headers
        .pop()
        .ok_or_else(|| invalid("it has no header".to_owned()))?;
    header.own_attributes.layer_name = layer_name;
    header.channels = ChannelList::new(columns.iter().map(|c| description(inputs, c)).collect());

    let mut kinds = header.channels.list.iter().map(|c| c.sample_type);
    let kept = Compression::of(first.compression)
        .filter(|_| kinds.all(|kind| first.compression.is_lossless_for(kind)));
    let compression = kept.map_or(Compression::Zip.method(), |_| first.compression);
    let mut encoded = header.with_encoding(
        compression,
        BlockDescription::ScanLines,
        LineOrder::Increasing,
    );
    key_code::keep_whole(&mut encoded);
    Ok((encoded, conflicts))
}

fn description<R: Read + Seek>(inputs: &[MergeInput<R>], column: &Column) -> ChannelDescription {
    let header = &inputs[column.input].file.source.meta.headers[column.channel.part];
    ChannelDescription {
        name: Text::from_slice_unchecked(column.name.as_bytes()),
        ..header.channels.list[column.channel.index].clone()
    }
}

/// The samples of the columns, in their order.
fn planes<R: Read + Seek>(
    inputs: &mut [MergeInput<R>],
    columns: &[Column],
) -> Result<Vec<Plane>, Error> {
    let mut planes: Vec<Option<Plane>> = vec![None; columns.len()];
    for (index, input) in inputs.iter_mut().enumerate() {
        let own = columns.iter().enumerate().filter(|(_, c)| c.input == index);
        let (places, names): (Vec<usize>, Vec<&str>) = own
            .map(|(place, c)| (place, c.channel.name.as_str()))
            .unzip();
        for (place, plane) in places.into_iter().zip(input.file.read(&names)?) {
            planes[place] = Some(plane);
        }
    }
    Ok(planes.into_iter().flatten().collect())
}

fn write(
    header: &Header,
    planes: &[Plane],
    threads: usize,
    output: &Path,
) -> Result<(), FileError> {
    let headers: Headers = [header.clone()].into_iter().collect();
    file::write_whole(output, |writer| {
        ::exr::block::write(&mut *writer, headers.clone(), false, |_, blocks| {
            use ::exr::block::writer::ChunksWriter;
            for batch in targets(header)?.chunks(threads) {
                let code = |target: &OutputBlock| {
                    let chunk = compress(0, header, target, samples(target, planes, header));
                    chunk.map(|chunk| (target.index, chunk))
                };
                for coded in parallel::map(threads, batch.iter().collect(), code) {
                    let (index, chunk) = coded?;
                    blocks.write_chunk(index, chunk)?;
                }
            }
            Ok(())
        })
        .and_then(|()| sort_attributes(writer, &headers))
        .map_err(io_error)
    })
}

/// The samples of a block: line by line, all channels of a line.
fn samples(target: &OutputBlock, planes: &[Plane], header: &Header) -> Vec<u8> {
    let width = header.layer_size.width();
    let (top, height) = (target.corner.y(), target.size.height());
    let mut data = Vec::with_capacity(target.size.area() * header.channels.bytes_per_pixel);
    for line in (top..top + height).map(|y| y * width..(y + 1) * width) {
        for plane in planes {
            plane.append_bytes(line.clone(), &mut data);
        }
    }
    data
}
