//! Writes a denoised image as a copy of its input with a different colour.
//!
//! Parts and their names, windows, header attributes, tiles, line order and all other channels stay
//! as in the input. Other channels keep their bits. [`Written::changes`] lists each unavoidable
//! difference.
//!
//! Parts without colour are copied in compressed form, including smaller levels. A part with colour
//! is decoded and compressed in small batches of blocks. Besides the colour, this needs memory for
//! a few blocks per processor, for any image size.

use std::borrow::Cow;
use std::io::{Read, Seek};
use std::path::Path;

use super::exr::ExrFile;
use super::exr::plan::{ReplacedNames, RewritePlan};
use super::exr::recode::recode;
use crate::error::Error;
use crate::image::layout::ChannelLayout;

pub use super::exr::plan::{Change, OutputChannels, RECORD, WriteOptions};

/// The result of writing an image.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct Written {
    /// Samples of colour and layers beyond the range of half, written as its largest value, 65504.
    pub clamped: usize,
    /// Differences between the layouts of output and input.
    pub changes: Vec<Change>,
}

/// The channels that get other values: the layout's colour, its alpha if there is a plane for it,
/// and layers.
#[derive(Debug, Clone, Copy)]
pub struct Replaced<'a> {
    /// Names the colour and alpha.
    pub layout: &'a ChannelLayout,
    /// The names of further channels.
    pub layers: &'a [String],
    /// The names of channels that the output has more, beside the colour. If the input has them, they are
    /// replaced.
    pub added: &'a [&'a str],
    /// Their values: colour, and alpha if given, as for [`rewrite`], then a plane for each layer and for
    /// each added channel.
    pub planes: &'a [f32],
}

/// As [`rewrite`], for the file at `input`.
///
/// # Errors
/// As [`crate::image::frame::read_frame`] and [`rewrite`].
pub fn write_denoised(
    input: &Path,
    layout: &ChannelLayout,
    color_hdr: &[f32],
    output: &Path,
    options: &WriteOptions,
) -> Result<Written, Error> {
    rewrite(
        &mut ExrFile::open(input)?,
        layout,
        color_hdr,
        output,
        options,
    )
}

/// Copies a file with the denoised colour, and alpha if given, in place of the layout's channels. The output is
/// complete or absent.
///
/// # Shapes
/// `color_hdr` is `[3, height, width]` of the colour's window, linear radiance, or
/// `[4, height, width]` with the layout's alpha.
///
/// # Errors
/// [`Error::File`], [`Error::Exr`] and [`Error::MissingChannels`] for the input, as
/// [`ExrFile::read`]. [`Error::Sizes`] if its colour channels cover different pixels.
/// [`Error::Exr`] if their number differs from `color_hdr`. [`Error::File`] for the output.
pub fn rewrite<R: Read + Seek>(
    file: &mut ExrFile<R>,
    layout: &ChannelLayout,
    color_hdr: &[f32],
    output: &Path,
    options: &WriteOptions,
) -> Result<Written, Error> {
    let replaced = Replaced {
        layout,
        layers: &[],
        added: &[],
        planes: color_hdr,
    };
    rewrite_with_layers(file, &replaced, output, options)
}

/// As [`rewrite`], with layers that have other values too.
///
/// # Errors
/// As [`rewrite`]; for layers as for the colour's channels. A file that has some of the added channels,
/// but not all.
pub fn rewrite_with_layers<R: Read + Seek>(
    file: &mut ExrFile<R>,
    replaced: &Replaced<'_>,
    output: &Path,
    options: &WriteOptions,
) -> Result<Written, Error> {
    let layout = replaced.layout.in_file(file, None)?;
    let present = |name: &&&str| file.channel(name).is_some();
    let (layers, added): (Cow<[String]>, _) = match replaced.added.iter().filter(present).count() {
        0 => (replaced.layers.into(), replaced.added),
        _ => {
            let added = replaced.added.iter().map(|name| (*name).to_owned());
            (
                replaced.layers.iter().cloned().chain(added).collect(),
                &[][..],
            )
        }
    };
    let names = ReplacedNames {
        color: &layout.color,
        alpha: layout.alpha.as_deref(),
        layers: &layers,
        added,
    };
    let plan = RewritePlan::new(file, &names, replaced.planes.len(), options)?;
    let clamped = recode(file, &plan, replaced.planes, output)?;
    Ok(Written {
        clamped,
        changes: plan.changes,
    })
}
