//! Several looks at an image: mirrored and turned, each denoised for itself, and the mean of what comes out ("geometric
//! self-ensemble": Lim et al. 2017, "Enhanced Deep Residual Networks for Single Image Super-Resolution", Sec. 3.3).
//!
//! A network sees a mirrored image as another one and errs in another way; of errors that differ the mean is smaller. It takes
//! as many passes as there are looks. Normals and positions are those of the world, whichever way the image is held.

use std::str::FromStr;

use burn::tensor::Tensor;

/// Axis of the rows in a planar batch.
const ROWS: usize = 2;

/// Axis of the columns.
const COLUMNS: usize = 3;

/// How many looks at an image.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum Ensemble {
    /// The image as it is.
    #[default]
    One,
    /// It and its three mirror images.
    Four,
    /// Those and the four with rows as columns.
    Eight,
}

impl Ensemble {
    /// How many passes through the network that is.
    pub fn count(self) -> usize {
        match self {
            Ensemble::One => 1,
            Ensemble::Four => 4,
            Ensemble::Eight => 8,
        }
    }

    /// The mean of what `denoise` makes of all looks at `images`.
    ///
    /// # Shapes
    /// All images and the mean `[B, channels, H, W]`.
    pub(crate) fn mean<const N: usize>(
        self,
        images: [Tensor<4>; N],
        denoise: impl Fn([Tensor<4>; N]) -> Tensor<4>,
    ) -> Tensor<4> {
        if self == Ensemble::One {
            // The network lets go of its images when it can.
            return denoise(images);
        }
        let looks = (0..self.count()).map(Look);
        let sum = looks
            .map(|look| look.back(denoise(images.clone().map(|image| look.at(image)))))
            .reduce(|sum, image| sum + image)
            .expect("there are four looks or eight");
        sum.div_scalar(self.count() as f32)
    }

    /// Bytes for each pixel that looks take beside a pass: the images once more, the sum, and the last one's output.
    pub(crate) fn bytes_per_pixel(self, channels_in: usize, channels_out: usize) -> u64 {
        match self {
            Ensemble::One => 0,
            _ => ((channels_in + 2 * channels_out) * size_of::<f32>()) as u64,
        }
    }
}

/// A number of looks that there is no ensemble of.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[error("there are ensembles of 1, 4 and 8 looks")]
pub struct UnknownEnsemble;

impl FromStr for Ensemble {
    type Err = UnknownEnsemble;

    fn from_str(count: &str) -> Result<Self, UnknownEnsemble> {
        let all = [Ensemble::One, Ensemble::Four, Ensemble::Eight];
        let found = all.into_iter().find(|e| e.count().to_string() == count);
        found.ok_or(UnknownEnsemble)
    }
}

/// One of the eight ways to hold an image: bits for rows turned round, columns turned round, and then one as the other.
#[derive(Clone, Copy, Debug)]
struct Look(usize);

impl Look {
    /// Rows and columns turned round, where the look does.
    fn flip(self, image: Tensor<4>) -> Tensor<4> {
        match self.0 & 3 {
            0 => image,
            1 => image.flip([ROWS]),
            2 => image.flip([COLUMNS]),
            _ => image.flip([ROWS, COLUMNS]),
        }
    }

    /// Rows as columns, where the look does.
    fn transpose(self, image: Tensor<4>) -> Tensor<4> {
        match self.0 & 4 {
            0 => image,
            _ => image.swap_dims(ROWS, COLUMNS),
        }
    }

    /// The image, held so.
    fn at(self, image: Tensor<4>) -> Tensor<4> {
        self.transpose(self.flip(image))
    }

    /// An image that is held so, as it was.
    fn back(self, image: Tensor<4>) -> Tensor<4> {
        self.flip(self.transpose(image))
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use burn::tensor::{Device, TensorData};

    /// `[1, 2, 2, 3]`, every value another.
    fn image() -> Tensor<4> {
        let values: Vec<f32> = (0..12).map(|i| i as f32).collect();
        Tensor::from_data(TensorData::new(values, [1, 2, 2, 3]), &Device::flex())
    }

    fn host(image: Tensor<4>) -> Vec<f32> {
        image.into_data().try_to_vec().unwrap()
    }

    #[test]
    fn every_look_is_another_and_comes_back() {
        let mut seen = Vec::new();
        for look in (0..8).map(Look) {
            let held = look.at(image());
            assert_eq!(host(look.back(held.clone())), host(image()), "{look:?}");
            let held = (held.dims(), host(held));
            assert!(!seen.contains(&held), "{look:?}");
            seen.push(held);
        }
    }

    /// What does the same to every pixel is the same for any number of looks; what adds to the first row alone reaches every border
    /// of the mean that a look puts there.
    #[test]
    fn the_mean_is_of_all_looks() {
        for (ensemble, borders) in [
            (Ensemble::One, [1.0, 0.0, 0.0]),
            (Ensemble::Four, [0.5, 0.5, 0.0]),
            (Ensemble::Eight, [0.25, 0.25, 0.25]),
        ] {
            let first_row = |[image]: [Tensor<4>; 1]| {
                let [b, c, _, width] = image.dims();
                let row = Tensor::ones([b, c, 1, width], &image.device());
                Tensor::zeros_like(&image).slice_assign([0..b, 0..c, 0..1, 0..width], row)
            };
            let zeros = Tensor::zeros([1, 1, 3, 5], &Device::flex());
            let mean = host(ensemble.mean([zeros], first_row));
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
