//! Any size to a multiple of 32 and back: the network halves five times (Fig. 3), so its sides must divide by 2^5
//! ([`DOWNSAMPLING`]).
//!
//! The image grows to the right and downwards by repeating its last column and row, which leaves no edge that the
//! network could take for one of the scene (ours: the paper trains and tests on sizes that divide).

use demc_model::DOWNSAMPLING;

/// The sizes of an image before and after padding, in pixels.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Padding {
    /// Height of the image.
    pub height: usize,
    /// Width of the image.
    pub width: usize,
}

impl Padding {
    /// Height after padding: the next multiple of [`DOWNSAMPLING`].
    pub fn padded_height(&self) -> usize {
        self.height.next_multiple_of(DOWNSAMPLING)
    }

    /// Width after padding: the next multiple of [`DOWNSAMPLING`].
    pub fn padded_width(&self) -> usize {
        self.width.next_multiple_of(DOWNSAMPLING)
    }

    /// Pads every plane by edge replication.
    ///
    /// # Shapes
    /// `[C, H, W]` -> `[C, padded H, padded W]`
    ///
    /// # Panics
    /// When `planes` does not hold whole planes of at least one pixel.
    pub fn pad(&self, planes: &[f32]) -> Vec<f32> {
        let Self { height, width } = *self;
        let (padded_height, padded_width) = (self.padded_height(), self.padded_width());
        assert!(height > 0 && width > 0 && planes.len().is_multiple_of(height * width));
        let channels = planes.len() / (height * width);
        let mut padded = Vec::with_capacity(channels * padded_height * padded_width);
        for plane in planes.chunks_exact(height * width) {
            for y in 0..padded_height {
                let start = y.min(height - 1) * width;
                let row = &plane[start..start + width];
                padded.extend_from_slice(row);
                padded.extend(std::iter::repeat_n(row[width - 1], padded_width - width));
            }
        }
        padded
    }

    /// Cuts the image out of every padded plane: the inverse of [`pad`](Self::pad).
    ///
    /// # Shapes
    /// `[C, padded H, padded W]` -> `[C, H, W]`
    pub fn crop(&self, padded: &[f32]) -> Vec<f32> {
        padded
            .chunks_exact(self.padded_height() * self.padded_width())
            .flat_map(|plane| plane.chunks_exact(self.padded_width()).take(self.height))
            .flat_map(|row| &row[..self.width])
            .copied()
            .collect()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn pattern(channels: usize, height: usize, width: usize) -> Vec<f32> {
        (0..channels * height * width).map(|i| i as f32).collect()
    }

    #[test]
    fn a_multiple_of_32_stays_as_it_is() {
        let padding = Padding {
            height: 32,
            width: 64,
        };
        let planes = pattern(3, 32, 64);
        assert_eq!(padding.pad(&planes), planes);
        assert_eq!(padding.crop(&planes), planes);
    }

    #[test]
    fn crop_undoes_pad_for_odd_sizes() {
        for (height, width) in [(1, 1), (33, 31), (5, 100), (224, 1)] {
            let padding = Padding { height, width };
            let planes = pattern(3, height, width);
            let padded = padding.pad(&planes);
            assert_eq!(
                padded.len(),
                3 * padding.padded_height() * padding.padded_width()
            );
            assert_eq!(padding.crop(&padded), planes);
        }
    }

    #[test]
    fn the_last_row_and_column_are_repeated() {
        let padding = Padding {
            height: 2,
            width: 3,
        };
        let padded = padding.pad(&[1.0, 2.0, 3.0, 4.0, 5.0, 6.0]);
        assert_eq!(&padded[..6], &[1.0, 2.0, 3.0, 3.0, 3.0, 3.0]);
        assert_eq!(&padded[31 * 32..31 * 32 + 4], &[4.0, 5.0, 6.0, 6.0]);
        assert_eq!(padded[32 * 32 - 1], 6.0);
    }
}
