//! A frame from images in memory.

use demc_data::Frame;
use demc_data::image::exr::check_size;
use demc_data::image::frame::{self, FEATURES, POSITIONS};
use demc_data::image::layout::Missing;

use super::error::BufferError;
use super::view::View;
use crate::Bundle;
use crate::denoise::Layer;

/// The images of a frame, all with the height and width of the colour.
#[derive(Debug, Clone)]
#[non_exhaustive]
pub struct Buffers<'a> {
    /// Noisy colour, 3 channels: linear HDR radiance. Negative samples count as 0.
    pub color: View<'a>,
    /// Shading normal at the first hit, 3 channels: world space, not encoded.
    pub normal: Option<View<'a>>,
    /// Position of the first hit, 3 channels: world space. A pixel whose three samples are infinite
    /// has none.
    pub position: Option<View<'a>>,
    /// Albedo of the first hit, 3 channels.
    pub albedo: Option<View<'a>>,
    /// Albedo of the second hit, 3 channels.
    pub albedo2: Option<View<'a>>,
    /// Alpha of the colour, 1 channel, 0 to 1.
    pub alpha: Option<View<'a>>,
}

impl<'a> Buffers<'a> {
    /// Colour without features.
    pub fn new(color: View<'a>) -> Self {
        Self {
            color,
            normal: None,
            position: None,
            albedo: None,
            albedo2: None,
            alpha: None,
        }
    }
}

impl Bundle {
    /// Copies images into a frame. Messages call it `name`. An absent buffer is replaced as in a
    /// file that lacks it ([`missing`](Self::missing)); a network without features needs none.
    ///
    /// # Errors
    /// An image of another size, or with NaN or infinite samples; a missing buffer.
    pub fn frame(&self, name: &str, buffers: &Buffers) -> Result<Frame, BufferError> {
        let [_, height, width] = buffers.color.shape();
        check_size(width, height).map_err(BufferError::Limit)?;
        let read = |buffer: &str, view: &View, channels| {
            planes(buffer, view, [channels, height, width], false)
        };
        let mut color = read("color", &buffers.color, 3)?;
        let mut clamped = 0;
        for value in color.iter_mut().filter(|value| **value < 0.0) {
            *value = 0.0;
            clamped += 1;
        }
        let pixels = height * width;
        let mut features = Vec::with_capacity(FEATURES * pixels);
        let views = [
            ("normal", &buffers.normal),
            ("position", &buffers.position),
            ("albedo", &buffers.albedo),
            ("albedo2", &buffers.albedo2),
        ];
        let is_used = self.meta.model.takes_features();
        for ((buffer, view), missing) in views.into_iter().zip(self.missing().in_order()) {
            match (view, missing) {
                (Some(view), _) => {
                    let shape = [3, height, width];
                    let is_position = features.len() == POSITIONS * pixels;
                    features.extend(planes(buffer, view, shape, is_position)?);
                }
                (None, Missing::Error) if is_used => return Err(BufferError::Missing { buffer }),
                (None, Missing::CopyTexture1) => {
                    features.extend_from_within(frame::TEXTURES * pixels..);
                }
                (None, _) => features.resize(features.len() + 3 * pixels, 0.0),
            }
        }
        let alpha = buffers.alpha.as_ref();
        let mut frame = Frame::new(name, width, height, color, features);
        frame.alpha = alpha.map(|view| read("alpha", view, 1)).transpose()?;
        frame.clamped = clamped;
        Ok(frame)
    }
}

impl Layer {
    /// Copies an image of one channel and of `height` x `width` pixels, the size of the frame, into
    /// a layer called `name`.
    ///
    /// # Errors
    /// Another shape; NaN or infinite samples.
    pub fn copied(
        name: &str,
        view: &View,
        [height, width]: [usize; 2],
    ) -> Result<Self, BufferError> {
        Ok(Self {
            name: name.to_owned(),
            samples: planes(name, view, [1, height, width], false)?,
        })
    }
}

/// The planes of a view, finite and of the right shape. With `clear`, pixels whose channels are all
/// infinite become 0.
fn planes(
    buffer: &str,
    view: &View,
    [channels, height, width]: [usize; 3],
    clear: bool,
) -> Result<Vec<f32>, BufferError> {
    let [found, own_height, own_width] = view.shape();
    if found != channels {
        return Err(BufferError::Channels {
            buffer: buffer.to_owned(),
            found,
            expected: channels,
        });
    }
    if [own_height, own_width] != [height, width] {
        return Err(BufferError::Size {
            buffer: buffer.to_owned(),
            found: [own_height, own_width],
            expected: [height, width],
        });
    }
    let mut planar = view.to_planar()?;
    let pixels = height * width;
    let is_bad = |value: &f32| !value.is_finite();
    if clear && planar.iter().any(is_bad) {
        for pixel in 0..pixels {
            let own = (0..channels).map(|channel| channel * pixels + pixel);
            if own.clone().all(|i| planar[i].is_infinite()) {
                own.for_each(|i| planar[i] = 0.0);
            }
        }
    }
    let Some(first) = planar.iter().position(is_bad) else {
        return Ok(planar);
    };
    Err(BufferError::NonFinite {
        buffer: buffer.to_owned(),
        count: planar.iter().filter(|value| is_bad(value)).count(),
        value: planar[first],
        row: first % pixels / width,
        column: first % width,
    })
}
