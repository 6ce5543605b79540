//! The cells of the output, and the padded copies that hold them contiguously.

use std::ops::Range;

use rayon::prelude::*;

use crate::product::padded_rows;
use crate::rows::{self, BLOCK, Copy, copy, whole};
use crate::scratch::Scratch;
use crate::{Grid, Isa};

/// Neighbouring cells of one line.
pub(super) struct CellRun {
    /// The first one, counted over all images.
    pub(super) first: usize,
    pub(super) image: usize,
    pub(super) row: usize,
    pub(super) column: usize,
    /// Their number.
    pub(super) count: usize,
}

#[derive(Clone, Copy)]
pub(super) struct Cells {
    pub(super) grid: Grid,
    pub(super) across: usize,
}

impl Cells {
    pub(super) fn new(grid: Grid) -> Self {
        Cells {
            grid,
            across: grid.width + 1,
        }
    }

    pub(super) fn of_image(self) -> usize {
        (self.grid.height + 1) * self.across
    }

    pub(super) fn count(self) -> usize {
        self.grid.batch * self.of_image()
    }

    /// The cells of `range`, divided into runs within a line of cells.
    pub(super) fn runs(self, range: Range<usize>) -> impl Iterator<Item = CellRun> {
        let mut first = range.start;
        std::iter::from_fn(move || {
            let (line, column) = (first / self.across, first % self.across);
            let run = CellRun {
                first,
                image: line / (self.grid.height + 1),
                row: line % (self.grid.height + 1),
                column,
                count: (self.across - column).min(range.end.checked_sub(first)?),
            };
            first += run.count;
            (run.count > 0).then_some(run)
        })
    }

    /// The padded inputs: cell `m` reads row `m + offset(tap)` at tap `(dy, dx)`.
    ///
    /// Every image starts with a row of zeros, which also ends the previous image.
    pub(super) fn inputs(self, isa: Isa, x: &[f32], channels: usize) -> Scratch {
        let Grid {
            batch,
            height,
            width,
        } = self.grid;
        let rows = self.count() + self.across + 1;
        let mut padded = Scratch::take((rows + padded_rows(BLOCK)) * channels);
        let (head, lines) = padded.split_at_mut(channels);
        head.fill(0.0);
        lines
            .par_chunks_mut(self.across * channels)
            .enumerate()
            .for_each(|(line, target)| {
                let (image, row) = (line / (height + 1), line % (height + 1));
                if image >= batch || row == 0 {
                    target.fill(0.0);
                    return;
                }
                let first = ((image * height + row - 1) * width) * channels;
                let (pixels, border) = target.split_at_mut(width * channels);
                copy(
                    isa,
                    Copy {
                        from: &x[first..],
                        from_step: width * channels,
                        gate: None,
                        bias: None,
                        relu: false,
                        target: pixels,
                        target_step: width * channels,
                        rows: 1,
                        channels: width * channels,
                    },
                );
                border.fill(0.0);
            });
        padded
    }

    /// First row of the padded inputs that cell 0 reads at a tap.
    pub(super) fn offset(self, (dy, dx): (usize, usize)) -> usize {
        (1 - dy) * self.across + 1 - dx
    }

    /// The gated gradient by cells, `4 * channels` values per cell, and its sum over pixels.
    pub(super) fn gradients(
        self,
        isa: Isa,
        dy: &[f32],
        y: Option<&[f32]>,
        channels: usize,
    ) -> (Scratch, Vec<f64>) {
        let Grid {
            batch,
            height,
            width,
        } = self.grid;
        let wide = whole(4 * channels);
        let lines = batch * (height + 1);
        let mut cells =
            Scratch::take((lines * self.across + self.across + 2 + padded_rows(BLOCK)) * wide);
        cells[lines * self.across * wide..].fill(0.0);
        let mut sums = vec![0.0f64; lines * channels];
        let all = cells
            .par_chunks_mut(self.across * wide)
            .take(lines)
            .zip(sums.par_chunks_mut(channels));
        all.enumerate().for_each(|(line, (cells, sums))| {
            let (image, row) = (line / (height + 1), line % (height + 1));
            if row == 0 || row == height || wide != 4 * channels {
                cells.fill(0.0);
            } else {
                cells[..wide].fill(0.0);
                cells[width * wide..].fill(0.0);
            }
            for py in 0..2 {
                let Some(y_row) = (2 * row + py).checked_sub(1).filter(|y| *y < 2 * height) else {
                    continue;
                };
                let first = ((image * 2 * height + y_row) * 2 * width) * channels;
                for px in 0..2 {
                    // Pixels px - 1, px + 1, ..., from the first that exists.
                    let skipped = 1 - px;
                    let from = first + (px + 2 * skipped - 1) * channels;
                    let target = &mut cells[skipped * wide + (2 * py + px) * channels..];
                    copy(
                        isa,
                        Copy {
                            from: &dy[from..],
                            from_step: 2 * channels,
                            gate: y.map(|y| &y[from..]),
                            bias: None,
                            relu: false,
                            target: &mut *target,
                            target_step: wide,
                            rows: width,
                            channels,
                        },
                    );
                    rows::column_sums(isa, target, wide, width, channels, sums);
                }
            }
        });
        let total = (0..channels)
            .map(|o| sums[o..].iter().step_by(channels).sum())
            .collect();
        (cells, total)
    }
}
