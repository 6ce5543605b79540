//! The passes of the paper's comparison, for methods that need them.

use std::io::{Read, Seek};

use super::light::pass_channels;
use super::read::finite;
use crate::error::Error;
use crate::image::exr::ExrFile;
use crate::image::layout::ChannelLayout;

/// Decoded buffers of one size.
#[derive(Debug, Clone, PartialEq)]
pub struct PassPlanes {
    /// Width in pixels.
    pub width: usize,
    /// Height in pixels.
    pub height: usize,
    /// Finite samples `[C, H, W]`, in the order of the request.
    pub buffers: Vec<Vec<f32>>,
}

/// Decodes buffers of a layout by their [content](crate::image::layout::NamedBuffer::content), such as
/// `half buffer 1 of color`.
///
/// # Errors
/// [`Error::MissingPasses`] for buffers that the layout does not name or the file lacks, [`Error::Sizes`]
/// and [`Error::NonFinite`] for unusable ones, and as [`ExrFile::read`].
///
/// # Panics
/// If `contents` is empty.
pub fn decode_passes<R: Read + Seek>(
    file: &mut ExrFile<R>,
    layout: &ChannelLayout,
    contents: &[&str],
) -> Result<PassPlanes, Error> {
    let path = file.path().to_owned();
    let layout = layout.in_file(file, None)?;
    let channels = pass_channels(file, &layout, contents.iter().copied())?;
    let names: Vec<&str> = channels.iter().flatten().map(String::as_str).collect();
    let windows: Vec<_> = names.iter().filter_map(|name| file.channel(name)).collect();
    let first = windows.first().expect("a request has contents");
    let window = first.window;
    if let Some(other) = windows.iter().find(|channel| channel.window != window) {
        return Err(Error::Sizes {
            path,
            a: first.name.clone(),
            a_window: window.to_string(),
            b: other.name.clone(),
            b_window: other.window.to_string(),
        });
    }
    let mut planes = file.read(&names)?.into_iter().zip(&names);
    let mut buffers = Vec::with_capacity(channels.len());
    for channels in &channels {
        let mut samples = Vec::with_capacity(channels.len() * window.width * window.height);
        for (plane, name) in planes.by_ref().take(channels.len()) {
            samples.extend(finite(&path, name, window.width, plane)?.to_f32());
        }
        buffers.push(samples);
    }
    Ok(PassPlanes {
        width: window.width,
        height: window.height,
        buffers,
    })
}
