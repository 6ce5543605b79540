//! Images in a caller's memory, with any strides: the input and output of other languages.
//!
//! A [`View`] is an image of half or float samples whose channels, rows, and columns lie at any
//! distance from each other. It may be planar or interleaved, flipped, or a part of a larger image.
//! [`Buffers`] are the views of a frame. [`Bundle::frame`](crate::Bundle::frame) copies them into a
//! [`Frame`](demc_data::Frame), with the checks that a file's channels get. A [`ViewMut`] takes the
//! result.
//!
//! ```
//! use demc_infer::buffers::{Buffers, Sample, View, ViewMut};
//! use demc_infer::{Bundle, device};
//!
//! let bundle = Bundle::load("quality".as_ref(), &device::parse("flex")?)?;
//! let (height, width) = (48, 64);
//! // Interleaved float samples, as in most renderers, of an image and of its features.
//! let [color, normal, albedo] = [(); 3].map(|()| vec![0u8; height * width * 3 * 4]);
//! let view = |memory| View::interleaved(memory, Sample::Float, [3, height, width]);
//! let mut buffers = Buffers::new(view(&color)?);
//! buffers.normal = Some(view(&normal)?);
//! buffers.albedo = Some(view(&albedo)?);
//! let denoised = bundle.denoise(&bundle.frame("frame 1", &buffers)?)?;
//!
//! let mut output = vec![0u8; color.len()];
//! ViewMut::interleaved(&mut output, Sample::Float, [3, height, width])?.write(&denoised)?;
//! # Ok::<(), Box<dyn std::error::Error>>(())
//! ```

mod error;
mod frame;
#[cfg(test)]
mod tests;
mod view;

pub use error::{BufferError, Shape};
pub use frame::Buffers;
pub use view::{Sample, View, ViewMut, extent};
