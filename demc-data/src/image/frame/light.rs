//! The passes that a frame has for KPCN: both parts of the light, depth, and variances.

use std::io::{Read, Seek};

use crate::error::Error;
use crate::image::exr::ExrFile;
use crate::image::layout::ChannelLayout;
use crate::image::plane::Plane;

/// The passes that KPCN takes: content in a [layout](crate::image::layout), and number of planes.
pub const PASSES: [(&str, usize); 8] = [
    ("diffuse", 3),
    ("specular", 3),
    ("depth", 1),
    ("variance of diffuse", 3),
    ("variance of specular", 3),
    ("variance of normal", 3),
    ("variance of texture1", 3),
    ("variance of depth", 1),
];

/// Planes of all [`PASSES`].
pub const PASS_PLANES: usize = 20;

/// The passes that training needs beside them.
pub const REFERENCE_PASSES: [(&str, usize); 2] =
    [("reference_diffuse", 3), ("reference_specular", 3)];

/// Planes of both parts of the light.
pub const LIGHT: usize = 6;

/// Index of the depth among them, after both parts of the light.
pub(crate) const DEPTH: usize = LIGHT;

/// The channels of each pass, by its [content](crate::image::layout::NamedBuffer::content).
///
/// # Errors
/// [`Error::MissingPasses`] for passes that the layout does not name or the file lacks.
pub(super) fn pass_channels<'a, R: Read + Seek>(
    file: &ExrFile<R>,
    layout: &ChannelLayout,
    contents: impl Iterator<Item = &'a str>,
) -> Result<Vec<Vec<String>>, Error> {
    let named = layout.buffers();
    let (mut channels, mut missing) = (Vec::new(), Vec::new());
    for content in contents {
        match named.iter().find(|buffer| buffer.content == content) {
            Some(buffer) => channels.push(buffer.channels.clone()),
            None => missing.push(content.to_owned()),
        }
    }
    let names = channels.iter().flatten();
    missing.extend(names.filter(|name| file.channel(name).is_none()).cloned());
    if missing.is_empty() {
        return Ok(channels);
    }
    Err(Error::MissingPasses {
        path: file.path().to_owned(),
        missing,
    })
}

/// Divides the depth of a whole image by its largest value, and its variance by the square of that.
pub(super) fn normalise_depth(passes: &mut [Plane]) {
    let largest = passes[DEPTH].max();
    let depths = [(DEPTH, largest), (PASS_PLANES - 1, largest * largest)];
    for (index, divisor) in depths.into_iter().filter(|(_, divisor)| *divisor > 0.0) {
        let values = passes[index].to_f32().into_iter();
        passes[index] = Plane::Float(values.map(|value| value / divisor).collect());
    }
}
