//! A map with zeros around it.

use rayon::prelude::*;

use crate::product::{ROW_BLOCK, padded_rows};
use crate::rows::{self, BLOCK, Copy, copy};
use crate::scratch::Scratch;
use crate::{Grid, Isa};

/// Side of the kernel.
pub(super) const SIDE: usize = 5;
/// Pixels of padding on each side.
const REACH: usize = SIDE / 2;

/// Images with two more pixels of zeros on each side, and room for whole blocks of rows at the end.
pub(super) struct PaddedMap {
    /// The grid without padding.
    pub(super) grid: Grid,
    /// Values of a pixel.
    pub(super) step: usize,
    values: Scratch,
}

impl PaddedMap {
    /// Pads `map`, zero where `gate` is not positive. A pixel's `channels` get zeros up to `step`.
    pub(super) fn new(
        isa: Isa,
        grid: Grid,
        map: &[f32],
        gate: Option<&[f32]>,
        [channels, step]: [usize; 2],
    ) -> Self {
        let line = Self::width(grid) * step;
        let image = (grid.height + 2 * REACH) * line;
        // Products compute whole blocks of rows, the last of which may start at the last pixel.
        let room = (padded_rows(BLOCK) + SIDE) * step + ROW_BLOCK;
        let mut values = Scratch::take(grid.batch * image + room);
        let (images, end) = values.split_at_mut(grid.batch * image);
        end.fill(0.0);
        images
            .par_chunks_mut(line)
            .enumerate()
            .for_each(|(row, target)| {
                target.fill(0.0);
                let (image, row) = (row / (image / line), row % (image / line));
                let Some(row) = row.checked_sub(REACH).filter(|row| *row < grid.height) else {
                    return;
                };
                let first = (image * grid.height + row) * grid.width * channels;
                copy(
                    isa,
                    Copy {
                        from: &map[first..],
                        from_step: channels,
                        gate: gate.map(|gate| &gate[first..]),
                        bias: None,
                        relu: false,
                        target: &mut target[REACH * step..],
                        target_step: step,
                        rows: grid.width,
                        channels,
                    },
                );
            });
        PaddedMap { grid, step, values }
    }

    /// Pixels of a padded row.
    pub(super) fn width(grid: Grid) -> usize {
        grid.width + 2 * REACH
    }

    /// All values from a pixel of an image on; row and column count from the padding's corner.
    pub(super) fn from(&self, image: usize, row: usize, column: usize) -> &[f32] {
        let line = image * (self.grid.height + 2 * REACH) + row;
        &self.values[(line * Self::width(self.grid) + column) * self.step..]
    }

    /// The sums over all pixels of the first `channels`.
    pub(super) fn sums(&self, isa: Isa, channels: usize) -> Vec<f64> {
        let lines = self.grid.batch * (self.grid.height + 2 * REACH);
        let width = Self::width(self.grid);
        let mut sums = vec![0.0; channels];
        for line in 0..lines {
            let values = &self.values[line * width * self.step..];
            rows::column_sums(isa, values, self.step, width, channels, &mut sums);
        }
        sums
    }
}
