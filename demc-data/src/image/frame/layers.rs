//! Further channels of an image, which are denoised beside its colour.

use std::io::{Read, Seek};

use super::read::{finite, repair_plane};
use crate::error::Error;
use crate::image::channel::ChannelType;
use crate::image::exr::ExrFile;
use crate::image::layout::ChannelLayout;

/// Checks, without decoding pixels, that these channels can be denoised beside the layout's colour.
///
/// # Errors
/// [`Error::MissingChannels`]. [`Error::Layer`] for a channel of integers, or one that the layout has
/// as colour or as a feature. [`Error::Sizes`] for a channel with other pixels than the colour.
pub fn check_layers<R: Read + Seek>(
    file: &ExrFile<R>,
    layout: &ChannelLayout,
    names: &[String],
) -> Result<(), Error> {
    let layout = &*layout.in_file(file, None)?;
    let names: Vec<&str> = names.iter().map(String::as_str).collect();
    file.require(&names)?;
    let red: &str = &layout.color[0];
    file.require(&[red])?;
    let color = file.channel(red);
    for channel in names.iter().filter_map(|name| file.channel(name)) {
        let refuse = |detail: String| Error::Layer {
            path: file.path().to_owned(),
            channel: channel.name.clone(),
            detail,
        };
        if channel.kind == ChannelType::Uint {
            return Err(refuse("its type is uint, not half or float".to_owned()));
        }
        if let Some(buffer) = role(layout, &channel.name) {
            return Err(refuse(format!("it is the {buffer} that the network sees")));
        }
        if let Some(color) = color.filter(|color| color.window != channel.window) {
            return Err(Error::Sizes {
                path: file.path().to_owned(),
                a: color.name.clone(),
                a_window: color.window.to_string(),
                b: channel.name.clone(),
                b_window: channel.window.to_string(),
            });
        }
    }
    Ok(())
}

/// The buffer that the network sees as a channel, if any.
fn role(layout: &ChannelLayout, channel: &str) -> Option<&'static str> {
    let features = layout
        .features()
        .map(|feature| (feature.name, feature.channels));
    let (buffer, _) = [("colour", Some(&layout.color))]
        .into_iter()
        .chain(features)
        .find(|(_, names)| names.is_some_and(|names| names.iter().any(|name| name == channel)))?;
    Some(buffer)
}

/// Decodes channels that [`check_layers`] accepts. With `repair`, NaN and infinite samples are replaced
/// by the median of their neighbours. Also returns the number of those.
///
/// # Shapes
/// Returns `[H, W]` for each name.
///
/// # Errors
/// As `check_layers` and [`ExrFile::read`]; [`Error::NonFinite`] without `repair`, otherwise
/// [`Error::Unrepairable`].
pub fn decode_layers<R: Read + Seek>(
    file: &mut ExrFile<R>,
    layout: &ChannelLayout,
    names: &[String],
    repair: bool,
) -> Result<(Vec<Vec<f32>>, usize), Error> {
    check_layers(file, layout, names)?;
    let path = file.path().to_owned();
    let names: Vec<&str> = names.iter().map(String::as_str).collect();
    let sizes: Vec<(usize, usize)> = names
        .iter()
        .filter_map(|name| file.channel(name))
        .map(|channel| (channel.window.height, channel.window.width))
        .collect();
    let planes = file.read(&names)?;
    let mut repaired = 0;
    let mut layers = Vec::with_capacity(names.len());
    for ((mut plane, name), size) in planes.into_iter().zip(names).zip(sizes) {
        if repair {
            repaired += repair_plane(&path, name, &mut plane, size, false)?;
        }
        layers.push(finite(&path, name, size.1, plane)?.to_f32());
    }
    Ok((layers, repaired))
}
