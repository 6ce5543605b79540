//! Limits of the size of an image. Files, frames in memory and tiles have the same ones.

/// Maximum width or height in pixels (ours: four times the width of an 8K frame).
pub const MAX_SIDE: usize = 32_768;
/// Maximum number of pixels of a part (ours: 16K x 8K), so that a damaged header cannot request all
/// memory.
pub const MAX_PIXELS: usize = 1 << 27;

/// An image that is empty or exceeds [`MAX_SIDE`] or [`MAX_PIXELS`].
#[derive(Clone, Copy, Debug, PartialEq, Eq, thiserror::Error)]
#[error(
    "its size is {width}x{height}, not 1x1 to {MAX_SIDE}x{MAX_SIDE} with at most {MAX_PIXELS} pixels"
)]
pub struct UnsupportedSize {
    /// Width in pixels.
    pub width: usize,
    /// Height in pixels.
    pub height: usize,
}

/// Checks the size of an image in pixels.
///
/// # Errors
/// The image is empty or too large.
pub fn check_size(width: usize, height: usize) -> Result<(), UnsupportedSize> {
    let sides = 1..=MAX_SIDE;
    if sides.contains(&width) && sides.contains(&height) && width * height <= MAX_PIXELS {
        Ok(())
    } else {
        Err(UnsupportedSize { width, height })
    }
}
