//! Maps that come in bands of rows, from top to bottom, so that no whole one has to be there.
//!
//! A 3x3 convolution needs a row more than it makes on either side. Instead of computing such rows twice, each stage keeps
//! the few that the next band needs, and lags behind its input by up to a tile. Bands begin at multiples of a tile's rows,
//! so all bits are those of the whole map.

use std::ops::Range;

use demc_kernels::conv3x3::Ready;
use demc_kernels::{Grid, memory};
use rayon::prelude::*;

/// Rows of the largest tile of a convolution.
pub(super) const TILE_ROWS: usize = 4;

/// The bands of `height` rows, `band` each but the last.
pub(super) fn bands(height: usize, band: usize) -> impl Iterator<Item = Range<usize>> {
    let starts = (0..height).step_by(band);
    starts.map(move |start| start..(start + band).min(height))
}

/// The rows of one image's map that are there. Memory is held for those alone, so that what waits for its next band is
/// small.
pub(super) struct Stream {
    /// Rows of the whole map.
    height: usize,
    width: usize,
    channels: usize,
    /// The first row that is there.
    first: usize,
    /// How many are.
    rows: usize,
    values: Vec<f32>,
}

impl Stream {
    /// None yet.
    pub(super) fn new(grid: Grid, channels: usize) -> Self {
        Stream {
            height: grid.height,
            width: grid.width,
            channels,
            first: 0,
            rows: 0,
            values: Vec::new(),
        }
    }

    /// Back to the top, for the next image.
    pub(super) fn restart(&mut self) {
        (self.first, self.rows) = (0, 0);
        self.values = Vec::new();
    }

    /// The row after the last that is there.
    fn end(&self) -> usize {
        self.first + self.rows
    }

    /// The rows that are there.
    pub(super) fn range(&self) -> Range<usize> {
        self.first..self.end()
    }

    /// `rows` more, for the caller to write.
    pub(super) fn push(&mut self, rows: usize) -> &mut [f32] {
        let row = self.width * self.channels;
        let held = self.rows * row;
        let mut values = memory::buffer(held + rows * row);
        copy(&self.values, &mut values[..held]);
        self.values = values;
        self.rows += rows;
        &mut self.values[held..]
    }

    /// The last `rows`.
    pub(super) fn last(&self, rows: usize) -> &[f32] {
        let row = self.width * self.channels;
        &self.values[(self.rows - rows) * row..self.rows * row]
    }

    /// The last `rows`, to be written again.
    pub(super) fn last_mut(&mut self, rows: usize) -> &mut [f32] {
        let row = self.width * self.channels;
        &mut self.values[(self.rows - rows) * row..self.rows * row]
    }

    /// All that are there, and their grid.
    pub(super) fn all(&self) -> (Grid, &[f32]) {
        let grid = Grid {
            batch: 1,
            height: self.rows,
            width: self.width,
        };
        (grid, self.last(self.rows))
    }

    /// Forgets the rows above `row`.
    pub(super) fn forget_above(&mut self, row: usize) {
        let gone = row.clamp(self.first, self.end()) - self.first;
        if gone == 0 {
            return;
        }
        let rest = &self.values[gone * self.width * self.channels..];
        let mut values = memory::buffer(rest.len());
        copy(rest, &mut values);
        self.values = values;
        (self.first, self.rows) = (self.first + gone, self.rows - gone);
    }

    /// Forgets all rows.
    pub(super) fn forget(&mut self) {
        self.forget_above(self.end());
    }
}

/// Values that a thread copies at a time.
const PIECE: usize = 1 << 16;

fn copy(from: &[f32], to: &mut [f32]) {
    let pieces = to.par_chunks_mut(PIECE).zip(from.par_chunks(PIECE));
    pieces.for_each(|(to, from)| to.copy_from_slice(from));
}

/// A convolution and the rows that it reads.
pub(super) struct Stage<'a> {
    pub(super) conv: Ready<'a>,
    pub(super) input: Stream,
    /// Rows that it has made.
    made: usize,
}

impl<'a> Stage<'a> {
    pub(super) fn new(conv: Ready<'a>, input: Stream) -> Self {
        Stage {
            conv,
            input,
            made: 0,
        }
    }

    fn restart(&mut self) {
        self.input.restart();
        self.made = 0;
    }

    /// The rows that it can make now, whole tiles of them until the last.
    fn pending(&self) -> Range<usize> {
        let end = match self.input.end() {
            end if end == self.input.height => end,
            end => end.saturating_sub(1) / TILE_ROWS * TILE_ROWS,
        };
        self.made..end.max(self.made)
    }

    /// Makes them, and keeps the rows that the next ones need.
    fn make(&mut self, rows: &Range<usize>, y: &mut [f32]) {
        let (grid, x) = self.input.all();
        self.conv.forward(grid, x, rows.start - self.input.first, y);
        self.made = rows.end;
        self.input.forget_above(rows.end.saturating_sub(1));
    }
}

/// Convolutions one after another.
pub(super) struct Chain<'a> {
    pub(super) stages: Vec<Stage<'a>>,
    /// What the last one made.
    pub(super) output: Stream,
}

impl Chain<'_> {
    /// Back to the top, for the next image.
    pub(super) fn restart(&mut self) {
        self.stages.iter_mut().for_each(Stage::restart);
        self.output.restart();
    }

    /// Where the first convolution's input comes in.
    pub(super) fn input(&mut self) -> &mut Stream {
        let first = self.stages.first_mut();
        &mut first.expect("a chain of at least one convolution").input
    }

    /// Makes all that can be made of the rows that have come in. `see` is shown what each stage has made: the stage's
    /// index, the rows and their values.
    pub(super) fn advance(&mut self, mut see: impl FnMut(usize, Range<usize>, &[f32])) {
        for index in 0..self.stages.len() {
            let (stages, next) = self.stages.split_at_mut(index + 1);
            let next = next
                .first_mut()
                .map_or(&mut self.output, |stage| &mut stage.input);
            let rows = stages[index].pending();
            if !rows.is_empty() {
                stages[index].make(&rows, next.push(rows.len()));
                see(index, rows.clone(), next.last(rows.len()));
            }
        }
    }
}
