//! A finite image, with the intermediate results that several metrics share.

use std::sync::OnceLock;

use rayon::prelude::*;

use super::appearance::Appearance;

/// Gamma of the tone mapping for SSIM and pictures (Eq. 4).
pub const DISPLAY_GAMMA: f32 = 2.2;

/// The reason that an image has no metrics.
#[derive(Debug, Clone, Copy, PartialEq, Eq, thiserror::Error)]
pub enum ImageError {
    /// NaN or infinite values. Metrics without them would flatter the image.
    #[error("{count} NaN or infinite values in {pixels} pixels")]
    NonFinite {
        /// Number of such values.
        count: usize,
        /// Number of pixels with such values.
        pixels: usize,
    },
}

/// An image in linear HDR with finite values only.
pub struct Image<'a> {
    hdr: &'a [f32],
    height: usize,
    width: usize,
    display: OnceLock<Vec<f64>>,
    appearance: OnceLock<Appearance>,
}

impl<'a> Image<'a> {
    /// The image in `hdr`.
    ///
    /// # Shapes
    /// Planar `[3, height, width]` in linear HDR.
    ///
    /// # Errors
    /// [`ImageError::NonFinite`].
    ///
    /// # Panics
    /// If `hdr` has another length or the image has no pixels.
    pub fn new(hdr: &'a [f32], height: usize, width: usize) -> Result<Self, ImageError> {
        let pixels = height * width;
        assert!(pixels > 0, "an image has pixels");
        assert_eq!(hdr.len(), 3 * pixels, "three planes of {height} x {width}");
        let count = hdr.iter().filter(|x| !x.is_finite()).count();
        if count > 0 {
            let bad = |i: &usize| (0..3).any(|c| !hdr[c * pixels + i].is_finite());
            let pixels = (0..pixels).filter(bad).count();
            return Err(ImageError::NonFinite { count, pixels });
        }
        Ok(Self {
            hdr,
            height,
            width,
            display: OnceLock::new(),
            appearance: OnceLock::new(),
        })
    }

    /// The values, planar `[3, height, width]` in linear HDR.
    pub fn hdr(&self) -> &'a [f32] {
        self.hdr
    }

    /// Height and width in pixels.
    pub fn size(&self) -> (usize, usize) {
        (self.height, self.width)
    }

    /// Computes the intermediate results that metrics share, before they run on several threads.
    pub fn prepare(&self) {
        self.appearance();
    }

    pub(super) fn pixels(&self) -> usize {
        self.height * self.width
    }

    /// `clip(x, 0, 1)^(1 / 2.2)`, planar.
    pub(super) fn display(&self) -> &[f64] {
        once::<Vec<f64>>(&self.display, || {
            let power = 1.0 / DISPLAY_GAMMA;
            let display = |x: &f32| f64::from(x.clamp(0.0, 1.0).powf(power));
            self.hdr.par_iter().map(display).collect()
        })
    }

    pub(super) fn appearance(&self) -> &Appearance {
        once(&self.appearance, || {
            Appearance::new(self.display(), self.width)
        })
    }

    /// Panics if the images have different sizes, which is a programmer's error.
    pub(super) fn assert_size_of(&self, other: &Image) {
        assert_eq!(self.size(), other.size(), "images of one size");
    }
}

/// The value of the cell, computed at the first call. The cell is not locked meanwhile: a thread
/// that waits for parallel work may start another metric, which would then wait for its own thread.
fn once<T>(cell: &OnceLock<T>, compute: impl FnOnce() -> T) -> &T {
    match cell.get() {
        Some(value) => value,
        None => {
            let value = compute();
            cell.get_or_init(|| value)
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn nan_and_infinite_values_are_counted_and_refused() {
        let mut hdr = vec![0.5; 3 * 4];
        hdr[1] = f32::NAN;
        hdr[5] = f32::INFINITY;
        hdr[6] = f32::NEG_INFINITY;
        let error = Image::new(&hdr, 2, 2).map(|_| ()).expect_err("NaN");
        assert_eq!(
            error,
            ImageError::NonFinite {
                count: 3,
                pixels: 2
            }
        );
        assert_eq!(error.to_string(), "3 NaN or infinite values in 2 pixels");
    }
}
