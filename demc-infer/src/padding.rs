//! Pads images and crops them back. The paper's network halves the resolution five times (Fig. 3), so both
//! sides must be multiples of 2^5.
//!
//! The last column and row are repeated to the right and downwards. This creates no edge that the
//! network could mistake for one in the scene (ours: the paper's sizes are multiples).

use std::ops::Range;

use crate::tiles::Span;

/// Rows or columns of the padded image, in pixels.
pub(crate) type PixelRange = Range<usize>;

/// The sizes of an image before and after padding, in pixels.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Padding {
    /// Height of the image.
    pub height: usize,
    /// Width of the image.
    pub width: usize,
    /// The padded sides are multiples of this.
    pub unit: usize,
}

impl Padding {
    /// Height after padding: the next multiple of the unit.
    pub fn padded_height(&self) -> usize {
        self.height.next_multiple_of(self.unit)
    }

    /// Width after padding: the next multiple of the unit.
    pub fn padded_width(&self) -> usize {
        self.width.next_multiple_of(self.unit)
    }

    /// Pads every plane by edge replication.
    ///
    /// # Shapes
    /// `[C, H, W]` -> `[C, padded H, padded W]`
    ///
    /// # Panics
    /// If `planes` does not hold whole planes of at least one pixel.
    pub fn pad(&self, planes: &[f32]) -> Vec<f32> {
        self.cut(planes, 0..self.padded_height(), 0..self.padded_width())
    }

    /// Cuts a part out of the padded planes, without padding the rest.
    ///
    /// # Shapes
    /// `[C, H, W]` -> `[C, rows, columns]`
    ///
    /// # Panics
    /// If `planes` does not hold whole planes of at least one pixel.
    pub fn cut(&self, planes: &[f32], rows: Range<usize>, columns: Range<usize>) -> Vec<f32> {
        let Self { height, width, .. } = *self;
        assert!(height > 0 && width > 0 && planes.len().is_multiple_of(height * width));
        let channels = planes.len() / (height * width);
        let inside = columns.start.min(width)..columns.end.min(width);
        let padding = columns.len() - inside.len();
        let mut part = Vec::with_capacity(channels * rows.len() * columns.len());
        for plane in planes.chunks_exact(height * width) {
            for y in rows.clone() {
                let row = &plane[y.min(height - 1) * width..][..width];
                part.extend_from_slice(&row[inside.clone()]);
                part.extend(std::iter::repeat_n(row[width - 1], padding));
            }
        }
        part
    }

    /// Copies the part of a tile's core that lies inside the image.
    ///
    /// # Shapes
    /// `tile` is `[C, rows.read, columns.read]`, `planes` `[C, H, W]`.
    pub fn paste(&self, tile: &[f32], rows: &Span, columns: &Span, planes: &mut [f32]) {
        let Self { height, width, .. } = *self;
        let (tall, wide) = (rows.read.len(), columns.read.len());
        let kept = columns.core.start..columns.core.end.min(width);
        let tiles = tile.chunks_exact(tall * wide);
        for (plane, tile) in planes.chunks_exact_mut(height * width).zip(tiles) {
            for y in rows.core.start..rows.core.end.min(height) {
                let row = &tile[(y - rows.read.start) * wide..][..wide];
                let from = kept.start - columns.read.start;
                plane[y * width..][kept.clone()].copy_from_slice(&row[from..][..kept.len()]);
            }
        }
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
            unit: 32,
        };
        let planes = pattern(3, 32, 64);
        assert_eq!(padding.pad(&planes), planes);
        assert_eq!(padding.crop(&planes), planes);
    }

    #[test]
    fn crop_undoes_pad_for_odd_sizes() {
        for (height, width) in [(1, 1), (33, 31), (5, 100), (224, 1)] {
            let padding = Padding {
                height,
                width,
                unit: 32,
            };
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
            unit: 32,
        };
        let padded = padding.pad(&[1.0, 2.0, 3.0, 4.0, 5.0, 6.0]);
        assert_eq!(&padded[..6], &[1.0, 2.0, 3.0, 3.0, 3.0, 3.0]);
        assert_eq!(&padded[31 * 32..31 * 32 + 4], &[4.0, 5.0, 6.0, 6.0]);
        assert_eq!(padded[32 * 32 - 1], 6.0);
    }

    #[test]
    fn a_cut_equals_that_part_of_the_padded_image() {
        let padding = Padding {
            height: 40,
            width: 50,
            unit: 32,
        };
        let planes = pattern(2, 40, 50);
        let padded = padding.pad(&planes);
        let part = padding.cut(&planes, 32..64, 10..60);
        for channel in 0..2 {
            for y in 0..32 {
                for x in 0..50 {
                    let expected = padded[(channel * 64 + y + 32) * 64 + x + 10];
                    assert_eq!(part[(channel * 32 + y) * 50 + x], expected);
                }
            }
        }
    }

    #[test]
    fn tiles_cut_and_pasted_give_the_image() {
        let (height, width) = (70, 100);
        let padding = Padding {
            height,
            width,
            unit: 32,
        };
        let planes = pattern(3, height, width);
        let span = |core: Range<usize>, end: usize| Span {
            read: core.start.saturating_sub(32)..(core.end + 32).min(end),
            core,
        };
        let mut out = vec![f32::NAN; planes.len()];
        for rows in [span(0..64, 96), span(64..96, 96)] {
            for columns in [span(0..32, 128), span(32..96, 128), span(96..128, 128)] {
                let tile = padding.cut(&planes, rows.read.clone(), columns.read.clone());
                padding.paste(&tile, &rows, &columns, &mut out);
            }
        }
        assert_eq!(out, planes);
    }
}
