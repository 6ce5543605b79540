//! A finished image from any program: three colour channels of a file; other channels are ignored.

use std::path::Path;

use crate::error::Error;
use crate::image::exr::ExrFile;
use crate::image::plane::NonFiniteSamples;

/// An image as planar `f32`.
#[derive(Debug, Clone, PartialEq)]
pub struct Rgb {
    /// Width in pixels.
    pub width: usize,
    /// Height in pixels.
    pub height: usize,
    /// `[3, H, W]`: linear HDR, finite, not negative.
    pub planes: Vec<f32>,
    /// Number of negative samples that were set to 0.
    pub clamped: usize,
}

/// Reads `R`, `G`, `B`, or `LAYER.R`, `LAYER.G`, `LAYER.B` of the only layer that has them.
///
/// # Errors
/// [`Error::File`] and [`Error::Exr`] for a file that cannot be decoded. [`Error::MissingChannels`]
/// without such channels, or with those of several layers. [`Error::Sizes`] and
/// [`Error::NonFinite`] for unusable channels.
pub fn read_rgb(path: &Path) -> Result<Rgb, Error> {
    let mut file = ExrFile::open(path)?;
    let prefix = prefix(&file);
    let full_names = ["R", "G", "B"].map(|channel| format!("{prefix}{channel}"));
    let names = full_names.each_ref().map(String::as_str);
    file.require(&names)?;
    let [window, others @ ..] = names.map(|name| file.channel(name).expect("required").window);
    for (name, other) in names[1..].iter().zip(others) {
        if other != window {
            return Err(Error::Sizes {
                path: path.to_owned(),
                a: names[0].to_owned(),
                a_window: window.to_string(),
                b: (*name).to_owned(),
                b_window: other.to_string(),
            });
        }
    }
    let mut planes = Vec::with_capacity(3 * window.width * window.height);
    let mut clamped = 0;
    for (name, mut plane) in names.iter().zip(file.read(&names)?) {
        if let Some(NonFiniteSamples {
            index,
            value,
            count,
        }) = plane.non_finite()
        {
            return Err(Error::NonFinite {
                path: path.to_owned(),
                channel: (*name).to_owned(),
                value,
                x: index % window.width,
                y: index / window.width,
                count,
            });
        }
        clamped += plane.clamp_negative();
        planes.extend(plane.to_f32());
    }
    Ok(Rgb {
        width: window.width,
        height: window.height,
        planes,
        clamped,
    })
}

/// The prefix of `R`, `G` and `B`: empty, or the only layer that has all three.
fn prefix(file: &ExrFile) -> String {
    let has_all = |prefix: &str| {
        ["R", "G", "B"]
            .iter()
            .all(|channel| file.channel(&format!("{prefix}{channel}")).is_some())
    };
    let layers = file.channels().iter().filter_map(|channel| {
        let prefix = channel.name.strip_suffix('R')?;
        (prefix.ends_with('.') && has_all(prefix)).then(|| prefix.to_owned())
    });
    match (has_all(""), layers.collect::<Vec<_>>().as_slice()) {
        (false, [only]) => only.clone(),
        _ => String::new(),
    }
}
