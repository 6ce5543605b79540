//! A denoised image in the layout of its input: the same file with another colour.
//!
//! Parts and their names, windows, header attributes, tiles, order of lines and every other channel are those of the
//! input; what had to be otherwise is said ([`Written::changes`]). Other channels are the input's bit for bit. Parts
//! without colour are copied as they are, compressed blocks, smaller levels and all. A part with colour is decoded and
//! compressed again a block at a time, so that memory beside the colour itself is a few blocks of it per processor,
//! whatever the size of the image.

use std::fmt;
use std::io::{Read, Seek};
use std::path::Path;

use super::plan::Plan;
use super::recode::recode;
use super::{Compression, ExrFile, Precision};
use crate::{ChannelLayout, Error};

/// How a denoised image is written.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct WriteOptions {
    /// Which channels of the input go into the output.
    pub channels: Keep,
    /// Type of the colour channels; `None`: that of the input (`float` in place of `uint`).
    pub precision: Option<Precision>,
    /// Compression of the parts that hold colour; `None`: that of the input, unless it would change other channels or
    /// cannot be written: then [`Compression::Zip`].
    pub compression: Option<Compression>,
}

/// Which channels of the input go into the output.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub enum Keep {
    /// All.
    #[default]
    All,
    /// Colour, and the alpha channel of the same part (`A` beside `R`, `beauty.A` beside `beauty.R`).
    Color,
}

/// What was written.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct Written {
    /// Samples of the colour beyond half's range that were written as its largest value, 65504.
    pub clamped: usize,
    /// Where the output's layout is not the input's.
    pub changes: Vec<Change>,
}

/// A difference to the layout of the input.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum Change {
    /// The input's compression would have changed the other channels, or cannot be written.
    Compression {
        /// The part's name; empty if it has none.
        part: String,
        /// The name of the input's.
        from: &'static str,
        /// What the part is compressed with.
        to: Compression,
    },
    /// The compression that was asked for changes the channels that were carried over.
    Lossy {
        /// The part's name; empty if it has none.
        part: String,
        /// What was asked for.
        to: Compression,
    },
    /// Smaller copies of the image (mip or rip levels) were left out: they show the noise.
    Levels {
        /// The part's name; empty if it has none.
        part: String,
    },
}

impl fmt::Display for Change {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let (Change::Compression { part, .. }
        | Change::Lossy { part, .. }
        | Change::Levels { part }) = self;
        if !part.is_empty() {
            write!(f, "part {part}: ")?;
        }
        match self {
            Change::Compression { from, to, .. } => {
                write!(
                    f,
                    "compressed with {to} in place of {from}, to keep the other channels as they are"
                )
            }
            Change::Lossy { to, .. } => {
                write!(
                    f,
                    "compressed with {to}, which changes the other channels too"
                )
            }
            Change::Levels { .. } => f.write_str("written without its smaller levels"),
        }
    }
}

/// [`rewrite`] of the file at `input`.
///
/// # Errors
/// As [`crate::read_frame`], and as [`rewrite`].
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

/// Writes a file again with the denoised colour in place of the channels that `layout` calls its colour, whole or not
/// at all.
///
/// # Shapes
/// `color_hdr` is `[3, height, width]` of the colour's window, linear radiance.
///
/// # Errors
/// [`Error::Read`], [`Error::Exr`] and [`Error::MissingChannels`] for the input, as [`ExrFile::read`];
/// [`Error::Sizes`] if its colour channels do not cover the same pixels, [`Error::Exr`] if these are not as many as
/// `color_hdr` has; [`Error::Write`] for the output.
pub fn rewrite<R: Read + Seek>(
    file: &mut ExrFile<R>,
    layout: &ChannelLayout,
    color_hdr: &[f32],
    output: &Path,
    options: &WriteOptions,
) -> Result<Written, Error> {
    let plan = Plan::new(file, layout, color_hdr.len(), options)?;
    let clamped = recode(file, &plan, color_hdr, output)?;
    Ok(Written {
        clamped,
        changes: plan.changes,
    })
}
