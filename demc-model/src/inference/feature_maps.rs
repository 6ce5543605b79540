//! Feature maps in the host's memory, `[B, H, W, C]`.

use std::ops::Range;

use demc_kernels::{Grid, memory};

/// Feature maps of a batch of images, channels last.
pub(super) struct FeatureMaps {
    pub(super) grid: Grid,
    pub(super) values: Vec<f32>,
}

impl FeatureMaps {
    /// Maps to be written; their initial values are arbitrary.
    pub(super) fn new(grid: Grid, channels: usize) -> Self {
        FeatureMaps {
            grid,
            values: memory::buffer(grid.pixels() * channels),
        }
    }

    pub(super) fn channels(&self) -> usize {
        self.values.len() / self.grid.pixels()
    }

    /// The grid of `rows` rows of one image.
    pub(super) fn band(&self, rows: usize) -> Grid {
        Grid {
            batch: 1,
            height: rows,
            ..self.grid
        }
    }

    pub(super) fn rows(&self, image: usize, rows: Range<usize>) -> &[f32] {
        &self.values[self.range(image, rows)]
    }

    pub(super) fn rows_mut(&mut self, image: usize, rows: Range<usize>) -> &mut [f32] {
        let range = self.range(image, rows);
        &mut self.values[range]
    }

    /// All rows of some images.
    pub(super) fn images(&self, images: Range<usize>) -> &[f32] {
        let image = self.grid.height * self.grid.width * self.channels();
        &self.values[images.start * image..images.end * image]
    }

    /// The same rows of each of some images.
    pub(super) fn rows_of_images_mut(
        &mut self,
        images: Range<usize>,
        rows: Range<usize>,
    ) -> Vec<&mut [f32]> {
        let row = self.grid.width * self.channels();
        let all = self.values.chunks_mut(self.grid.height * row);
        all.skip(images.start)
            .take(images.len())
            .map(|values| &mut values[rows.start * row..rows.end * row])
            .collect()
    }

    pub(super) fn range(&self, image: usize, rows: Range<usize>) -> Range<usize> {
        let row = self.grid.width * self.channels();
        let first = image * self.grid.height;
        (first + rows.start) * row..(first + rows.end) * row
    }

    /// The rows with one more on each side, inside the map, and the number of rows added above.
    pub(super) fn with_neighbours(&self, rows: Range<usize>) -> (Range<usize>, usize) {
        let start = rows.start.saturating_sub(1);
        (
            start..(rows.end + 1).min(self.grid.height),
            rows.start - start,
        )
    }
}
