//! Test-time augmentation: flipped and transposed copies of an image are denoised separately, and
//! the results are averaged.
//!
//! Lim et al. 2017, "Enhanced Deep Residual Networks for Single Image Super-Resolution", Sec. 3.3,
//! call this a geometric self-ensemble. The network makes different errors on each copy, and
//! averaging reduces them. Each copy takes one pass. Normals and positions are in world space, so
//! they do not change with the image's orientation.

use std::str::FromStr;

use burn::tensor::Tensor;

const ROWS: usize = 2;

const COLUMNS: usize = 3;

/// Number of passes over copies of an image.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum Ensemble {
    /// The image itself.
    #[default]
    One,
    /// The image and its three flipped copies.
    Four,
    /// Those four, and their transposed copies.
    Eight,
}

impl Ensemble {
    /// Number of passes through the network.
    pub fn count(self) -> usize {
        match self {
            Ensemble::One => 1,
            Ensemble::Four => 4,
            Ensemble::Eight => 8,
        }
    }

    /// Applies `denoise` to every copy of `images` and returns the mean, or the first error.
    ///
    /// # Shapes
    /// All images and the mean are `[B, channels, H, W]`.
    pub(crate) fn mean<const N: usize, E>(
        self,
        images: [Tensor<4>; N],
        mut denoise: impl FnMut([Tensor<4>; N]) -> Result<Tensor<4>, E>,
    ) -> Result<Tensor<4>, E> {
        if self == Ensemble::One {
            // No clones: the network frees its inputs early.
            return denoise(images);
        }
        let mut sum: Option<Tensor<4>> = None;
        for symmetry in (0..self.count()).map(Symmetry) {
            let copies = images.clone().map(|image| symmetry.apply(image));
            let image = symmetry.undo(denoise(copies)?);
            sum = Some(match sum {
                None => image,
                Some(sum) => sum + image,
            });
        }
        let sum = sum.expect("four or eight symmetries");
        Ok(sum.div_scalar(self.count() as f32))
    }

    /// Bytes per pixel that augmentation needs in addition to a pass: the copies of the images, the
    /// sum, and the latest output.
    pub(crate) fn bytes_per_pixel(self, channels_in: usize, channels_out: usize) -> u64 {
        match self {
            Ensemble::One => 0,
            _ => ((channels_in + 2 * channels_out) * size_of::<f32>()) as u64,
        }
    }
}

/// A number of passes other than 1, 4 and 8.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[error("the number of passes must be 1, 4 or 8")]
pub struct UnknownEnsemble;

impl FromStr for Ensemble {
    type Err = UnknownEnsemble;

    fn from_str(count: &str) -> Result<Self, UnknownEnsemble> {
        let all = [Ensemble::One, Ensemble::Four, Ensemble::Eight];
        let found = all.into_iter().find(|e| e.count().to_string() == count);
        found.ok_or(UnknownEnsemble)
    }
}

/// One of the eight symmetries of a square. Bit 0 reverses the rows, bit 1 the columns; bit 2 then
/// transposes.
#[derive(Clone, Copy, Debug)]
struct Symmetry(usize);

impl Symmetry {
    fn flip(self, image: Tensor<4>) -> Tensor<4> {
        match self.0 & 3 {
            0 => image,
            1 => image.flip([ROWS]),
            2 => image.flip([COLUMNS]),
            _ => image.flip([ROWS, COLUMNS]),
        }
    }

    fn transpose(self, image: Tensor<4>) -> Tensor<4> {
        match self.0 & 4 {
            0 => image,
            _ => image.swap_dims(ROWS, COLUMNS),
        }
    }

    fn apply(self, image: Tensor<4>) -> Tensor<4> {
        self.transpose(self.flip(image))
    }

    /// The inverse of [`apply`](Self::apply).
    fn undo(self, image: Tensor<4>) -> Tensor<4> {
        self.flip(self.transpose(image))
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use burn::tensor::{Device, TensorData};

    fn image() -> Tensor<4> {
        let values: Vec<f32> = (0..12).map(|i| i as f32).collect();
        Tensor::from_data(TensorData::new(values, [1, 2, 2, 3]), &Device::flex())
    }

    fn host(image: Tensor<4>) -> Vec<f32> {
        image.into_data().try_to_vec().unwrap()
    }

    #[test]
    fn symmetries_differ_and_can_be_undone() {
        let mut seen = Vec::new();
        for symmetry in (0..8).map(Symmetry) {
            let copy = symmetry.apply(image());
            let restored = host(symmetry.undo(copy.clone()));
            assert_eq!(restored, host(image()), "{symmetry:?}");
            let copy = (copy.dims(), host(copy));
            assert!(!seen.contains(&copy), "{symmetry:?}");
            seen.push(copy);
        }
    }

    /// A function that adds 1 to the first row shows up at every border that a symmetry maps to the
    /// first row.
    #[test]
    fn the_mean_covers_all_symmetries() {
        for (ensemble, borders) in [
            (Ensemble::One, [1.0, 0.0, 0.0]),
            (Ensemble::Four, [0.5, 0.5, 0.0]),
            (Ensemble::Eight, [0.25, 0.25, 0.25]),
        ] {
            let first_row = |[image]: [Tensor<4>; 1]| {
                let [b, c, _, width] = image.dims();
                let row = Tensor::ones([b, c, 1, width], &image.device());
                Ok::<_, ()>(
                    Tensor::zeros_like(&image).slice_assign([0..b, 0..c, 0..1, 0..width], row),
                )
            };
            let zeros = Tensor::zeros([1, 1, 3, 5], &Device::flex());
            let mean = host(ensemble.mean([zeros], first_row).expect("no error"));
            let at = |row: usize, column: usize| mean[5 * row + column];
            assert_eq!([at(0, 2), at(2, 2), at(1, 0)], borders, "{ensemble:?}");
            assert_eq!((at(1, 4), at(1, 2)), (borders[2], 0.0), "{ensemble:?}");
        }
    }

    #[test]
    fn counts_are_parsed() {
        assert_eq!("4".parse(), Ok(Ensemble::Four));
        assert_eq!("2".parse::<Ensemble>(), Err(UnknownEnsemble));
    }
}
