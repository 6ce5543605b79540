//! Writes files with only three channels.

use std::path::Path;

use ::exr::prelude::{
    AnyChannel, AnyChannels, Blocks, Compression, Encoding, FlatSamples, Image, Layer,
    LayerAttributes, LineOrder, WritableImage,
};
use demc_program::file;
use half::f16;

use super::failure::io_error;
use crate::error::Error;

/// The sample type of a written image.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum SamplePrecision {
    /// 16 bits; values beyond its range (65504) are clamped.
    Half,
    /// 32 bits.
    Float,
}

/// Writes linear radiance as a ZIP-compressed EXR file with channels `R G B`. The file is complete
/// or absent.
///
/// # Shapes
/// `rgb` is `[3, height, width]`.
///
/// # Errors
/// [`Error::File`], naming `path`.
///
/// # Panics
/// If `rgb` has another length.
pub fn write_rgb(
    path: &Path,
    width: usize,
    height: usize,
    rgb: &[f32],
    precision: SamplePrecision,
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
                SamplePrecision::Half => {
                    FlatSamples::F16(plane.iter().map(|&v| saturated_half(v)).collect())
                }
                SamplePrecision::Float => FlatSamples::F32(plane.to_vec()),
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
            .map_err(io_error)
    })?;
    Ok(())
}

/// The nearest half; values beyond its range become the largest half.
pub(super) fn saturated_half(value: f32) -> f16 {
    f16::from_f32(value.clamp(f16::MIN.to_f32(), f16::MAX.to_f32()))
}
