//! Convolutions on bands of rows, from top to bottom, so that no whole map is in memory.
//!
//! A 3x3 convolution reads one row more than it writes on either side. It keeps the few rows that
//! the next band needs, instead of computing them twice, and lags behind its input by up to a tile.
//! Bands begin at multiples of a tile's rows, so the result has the bits of the whole map.

use std::ops::Range;

use demc_kernels::conv3x3::PreparedConvolution;
use demc_kernels::{Grid, memory};
use rayon::prelude::*;

/// Rows of the largest tile of a convolution.
pub(super) const TILE_ROWS: usize = 4;

/// The bands of `height` rows. All but the last have `band` rows.
pub(super) fn bands(height: usize, band: usize) -> impl Iterator<Item = Range<usize>> {
    let starts = (0..height).step_by(band);
    starts.map(move |start| start..(start + band).min(height))
}

pub(super) struct RowWindow {
    height: usize,
    width: usize,
    channels: usize,
    first: usize,
    rows: usize,
    values: Vec<f32>,
}

impl RowWindow {
    /// An empty window of a map.
    pub(super) fn new(grid: Grid, channels: usize) -> Self {
        RowWindow {
            height: grid.height,
            width: grid.width,
            channels,
            first: 0,
            rows: 0,
            values: Vec::new(),
        }
    }

    pub(super) fn restart(&mut self) {
        (self.first, self.rows) = (0, 0);
        self.values = Vec::new();
    }

    fn end(&self) -> usize {
        self.first + self.rows
    }

    pub(super) fn range(&self) -> Range<usize> {
        self.first..self.end()
    }

    pub(super) fn push(&mut self, rows: usize) -> &mut [f32] {
        let row = self.width * self.channels;
        let held = self.rows * row;
        let mut values = memory::buffer(held + rows * row);
        copy(&self.values, &mut values[..held]);
        self.values = values;
        self.rows += rows;
        &mut self.values[held..]
    }

    pub(super) fn last(&self, rows: usize) -> &[f32] {
        let row = self.width * self.channels;
        &self.values[(self.rows - rows) * row..self.rows * row]
    }

    pub(super) fn last_mut(&mut self, rows: usize) -> &mut [f32] {
        let row = self.width * self.channels;
        &mut self.values[(self.rows - rows) * row..self.rows * row]
    }

    pub(super) fn all(&self) -> (Grid, &[f32]) {
        let grid = Grid {
            batch: 1,
            height: self.rows,
            width: self.width,
        };
        (grid, self.last(self.rows))
    }

    pub(super) fn free_above(&mut self, row: usize) {
        let freed = row.clamp(self.first, self.end()) - self.first;
        if freed == 0 {
            return;
        }
        let rest = &self.values[freed * self.width * self.channels..];
        let mut values = memory::buffer(rest.len());
        copy(rest, &mut values);
        self.values = values;
        (self.first, self.rows) = (self.first + freed, self.rows - freed);
    }

    pub(super) fn free_all(&mut self) {
        self.free_above(self.end());
    }
}

/// Number of values that a thread copies at a time.
const COPY_LENGTH: usize = 1 << 16;

fn copy(source: &[f32], target: &mut [f32]) {
    let pieces = target.par_chunks_mut(COPY_LENGTH);
    pieces
        .zip(source.par_chunks(COPY_LENGTH))
        .for_each(|(target, source)| target.copy_from_slice(source));
}

/// A convolution and the input rows that it still needs.
pub(super) struct BandedConv<'a> {
    conv: PreparedConvolution<'a>,
    input: RowWindow,
    made: usize,
}

impl<'a> BandedConv<'a> {
    pub(super) fn new(conv: PreparedConvolution<'a>, grid: Grid) -> Self {
        let input = RowWindow::new(grid, conv.inputs());
        BandedConv {
            conv,
            input,
            made: 0,
        }
    }

    fn restart(&mut self) {
        self.input.restart();
        self.made = 0;
    }

    /// The rows that can be computed now: whole tiles, except at the end of the map.
    fn pending(&self) -> Range<usize> {
        let end = match self.input.end() {
            end if end == self.input.height => end,
            end => end.saturating_sub(1) / TILE_ROWS * TILE_ROWS,
        };
        self.made..end.max(self.made)
    }

    fn compute(&mut self, rows: &Range<usize>, y: &mut [f32]) {
        let (grid, x) = self.input.all();
        self.conv.forward(grid, x, rows.start - self.input.first, y);
        self.made = rows.end;
        self.input.free_above(rows.end.saturating_sub(1));
    }
}

pub(super) struct ConvChain<'a> {
    pub(super) convs: Vec<BandedConv<'a>>,
    pub(super) output: RowWindow,
}

impl ConvChain<'_> {
    pub(super) fn restart(&mut self) {
        self.convs.iter_mut().for_each(BandedConv::restart);
        self.output.restart();
    }

    pub(super) fn input(&mut self) -> &mut RowWindow {
        let first = self.convs.first_mut();
        &mut first.expect("a chain of at least one convolution").input
    }

    /// Computes all rows that the input allows. `observe` receives each convolution's index, the
    /// rows that it has computed, and their values, which it may change.
    pub(super) fn advance(&mut self, mut observe: impl FnMut(usize, Range<usize>, &mut [f32])) {
        for index in 0..self.convs.len() {
            let (convs, next) = self.convs.split_at_mut(index + 1);
            let next = next
                .first_mut()
                .map_or(&mut self.output, |conv| &mut conv.input);
            let rows = convs[index].pending();
            if !rows.is_empty() {
                convs[index].compute(&rows, next.push(rows.len()));
                observe(index, rows.clone(), next.last_mut(rows.len()));
            }
        }
    }
}
