//! Error maps: the error of each pixel, whose mean is `relmse`, and the worst and the median patch.

use demc_model::metrics::{Image, rel_mse_map};

use super::codec::{Pixels, reduced};

/// Ends of the logarithmic colour scale.
pub const SCALE: [f32; 2] = [1e-3, 1e1];
/// Longest side of an error map in pixels; larger maps show means of blocks.
const LONGEST: usize = 640;
const PATCH: usize = 48;

pub struct ErrorMap {
    width: usize,
    height: usize,
    errors: Vec<f32>,
}

/// A square of pixels, or less if the image is smaller.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct ErrorPatch {
    pub x: usize,
    pub y: usize,
    pub width: usize,
    pub height: usize,
    /// Its `relmse`.
    pub relmse: f64,
}

impl ErrorMap {
    pub fn new(candidate: &Image, reference: &Image) -> Self {
        let (height, width) = reference.size();
        let errors = rel_mse_map(candidate, reference);
        Self {
            width,
            height,
            errors: errors.into_iter().map(|error| error as f32).collect(),
        }
    }

    /// Side of the blocks whose means are shown, in pixels.
    pub fn block(&self) -> usize {
        self.width.max(self.height).div_ceil(LONGEST)
    }

    /// The map on the colour scale; blocks are averaged before the logarithm.
    pub fn pixels(&self) -> Pixels {
        let block = self.block();
        let errors = reduced(&self.errors, self.height, self.width, block);
        Pixels {
            width: self.width.div_ceil(block),
            height: self.height.div_ceil(block),
            values: errors.iter().map(|error| shade(*error)).collect(),
        }
    }

    /// The part of the map in a patch, at full resolution.
    pub fn crop(&self, patch: &ErrorPatch) -> Pixels {
        Pixels {
            width: patch.width,
            height: patch.height,
            values: cropped(&self.errors, self.width, patch)
                .map(shade)
                .collect(),
        }
    }

    /// The patches of a grid with the largest and with the median error.
    pub fn worst_and_median(&self) -> [ErrorPatch; 2] {
        let side = |pixels: usize| (pixels.min(PATCH), (pixels / PATCH).max(1));
        let ((width, columns), (height, rows)) = (side(self.width), side(self.height));
        // The grid is centred; the remainder is at both edges.
        let start = |pixels: usize, size: usize, count: usize| (pixels - size * count) / 2;
        let (left, top) = (
            start(self.width, width, columns),
            start(self.height, height, rows),
        );
        let mut patches: Vec<ErrorPatch> = (0..rows * columns)
            .map(|i| {
                let mut patch = ErrorPatch {
                    x: left + i % columns * width,
                    y: top + i / columns * height,
                    width,
                    height,
                    relmse: 0.0,
                };
                let errors = cropped(&self.errors, self.width, &patch);
                patch.relmse = errors.map(f64::from).sum::<f64>() / (width * height) as f64;
                patch
            })
            .collect();
        patches.sort_by(|a, b| a.relmse.total_cmp(&b.relmse));
        [patches[patches.len() - 1], patches[patches.len() / 2]]
    }
}

impl ErrorPatch {
    /// This part of a planar `[3, H, W]` image.
    pub fn of_planes(&self, planes: &[f32], width: usize) -> Vec<f32> {
        let planes = planes.chunks(planes.len() / 3);
        planes
            .flat_map(|plane| cropped(plane, width, self))
            .collect()
    }
}

fn cropped(plane: &[f32], width: usize, patch: &ErrorPatch) -> impl Iterator<Item = f32> {
    let lines = plane.chunks(width).skip(patch.y).take(patch.height);
    let columns = patch.x..patch.x + patch.width;
    lines.flat_map(move |line| line[columns.clone()].iter().copied())
}

fn shade(error: f32) -> u8 {
    let [low, high] = SCALE;
    let position = (error.max(low) / low).log10() / (high / low).log10();
    (position * 255.0).round().min(255.0) as u8
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_scale_is_logarithmic_and_clipped() {
        assert_eq!(
            [0.0, 1e-3, 0.1, 10.0, 1e9].map(shade),
            [0, 0, 128, 255, 255]
        );
    }

    #[test]
    fn the_worst_patch_is_where_the_error_is() {
        let (height, width) = (100, 200);
        let mut errors = vec![1.0; height * width];
        errors[60 * width + 110] = 1e6;
        let map = ErrorMap {
            width,
            height,
            errors,
        };
        let [worst, median] = map.worst_and_median();
        // Two rows of four patches, centred: they start at 2 and at 4.
        assert_eq!((worst.x, worst.y), (4 + 2 * PATCH, 2 + PATCH));
        assert!(worst.relmse > 100.0 && median.relmse == 1.0);
        assert_eq!(map.crop(&worst).values.iter().max(), Some(&255));
    }

    #[test]
    fn a_small_image_is_one_patch_and_a_large_map_is_averaged() {
        let map = |height, width| ErrorMap {
            width,
            height,
            errors: vec![0.1; height * width],
        };
        let [worst, median] = map(10, 60).worst_and_median();
        assert_eq!((worst.x, worst.width, worst.height), (6, 48, 10));
        assert_eq!(worst, median);
        let large = map(3, 1281);
        assert_eq!(large.block(), 3);
        let pixels = large.pixels();
        assert_eq!(
            (pixels.width, pixels.height, pixels.values[0]),
            (427, 1, 128)
        );
    }
}
