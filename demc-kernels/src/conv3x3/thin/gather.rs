//! Neighbourhoods of pixels as rows (*im2col*).

use std::ops::Range;

use crate::conv3x3::parts::GatedMap;
use crate::rows::{Copy, copy};
use crate::simd::{Leaf, Simd, run};
use crate::{Grid, Isa};

/// The neighbour of a pixel at a tap, if it lies in the image.
#[inline(always)]
pub(super) fn neighbour(grid: Grid, row: usize, column: usize, tap: usize) -> Option<isize> {
    let (y, x) = (row + tap / 3, column + tap % 3);
    let inside = y >= 1 && y <= grid.height && x >= 1 && x <= grid.width;
    inside.then(|| {
        (tap / 3) as isize * grid.width as isize + (tap % 3) as isize - grid.width as isize - 1
    })
}

#[inline(always)]
fn place(grid: Grid, pixel: usize) -> (usize, usize) {
    (pixel / grid.width % grid.height, pixel % grid.width)
}

/// The neighbourhoods of some pixels as rows of `9 * channels` values, `step` values apart.
struct Gather<'a> {
    source: GatedMap<'a>,
    grid: Grid,
    pixels: Range<usize>,
    /// If set, a row holds the pixels that this pixel contributes to, instead of those that it
    /// reads.
    mirrored: bool,
    rows: &'a mut [f32],
    step: usize,
}

impl Leaf for Gather<'_> {
    type Out = ();

    #[inline(always)]
    unsafe fn run<S: Simd>(self) {
        let Gather {
            source,
            grid,
            pixels,
            mirrored,
            rows,
            step,
        } = self;
        let channels = source.channels;
        assert!(
            rows.len() >= pixels.len() * step && step >= 9 * channels,
            "room for the neighbourhoods"
        );
        assert!(
            pixels.end * channels <= source.map.len(),
            "pixels of the map"
        );
        for (pixel, row) in pixels.zip(rows.chunks_exact_mut(step)) {
            let (y, x) = place(grid, pixel);
            let inside = y > 0 && y + 1 < grid.height && x > 0 && x + 1 < grid.width;
            if inside && !mirrored {
                // Three pixels side by side are three taps side by side.
                for line in 0..3 {
                    let first = (pixel + line * grid.width - grid.width - 1) * channels;
                    // SAFETY: the pixel's eight neighbours lie in the image.
                    unsafe {
                        copy_part::<S>(source, first, &mut row[line * 3 * channels..], 3 * channels)
                    };
                }
                continue;
            }
            for tap in 0..9 {
                let target = &mut row[tap * channels..(tap + 1) * channels];
                match neighbour(grid, y, x, if mirrored { 8 - tap } else { tap }) {
                    None => target.fill(0.0),
                    Some(offset) => {
                        let first = pixel.wrapping_add_signed(offset) * channels;
                        // SAFETY: the neighbour lies in the image.
                        unsafe { copy_part::<S>(source, first, target, channels) };
                    }
                }
            }
        }
    }
}

/// Copies `count` values from value `first`, gated.
///
/// # Safety
/// The machine has the path of `S`, and the map and its gate that many values there.
#[inline(always)]
unsafe fn copy_part<S: Simd>(source: GatedMap, first: usize, target: &mut [f32], count: usize) {
    assert!(target.len() >= count);
    for offset in (0..count).step_by(S::LANES) {
        let n = S::LANES.min(count - offset);
        // SAFETY: `n` values from `offset` on are there.
        unsafe {
            let mut v = S::load_part(source.map.as_ptr().add(first + offset), n);
            if let Some(gate) = source.gate {
                v = S::gate(v, S::load_part(gate.as_ptr().add(first + offset), n));
            }
            S::store_part(target.as_mut_ptr().add(offset), n, v);
        }
    }
}

impl GatedMap<'_> {
    pub(super) fn gather(
        &self,
        isa: Isa,
        grid: Grid,
        pixels: Range<usize>,
        mirrored: bool,
        rows: &mut [f32],
        step: usize,
    ) {
        assert!(
            self.gate.is_none_or(|gate| gate.len() == self.map.len()),
            "a gate of the map's size"
        );
        let leaf = Gather {
            source: *self,
            grid,
            pixels,
            mirrored,
            rows,
            step,
        };
        // SAFETY: the leaf checks its lengths, the gate's was checked.
        unsafe { run(isa, leaf) }
    }

    /// Some pixels themselves as rows, `step` values apart.
    pub(super) fn copy(&self, isa: Isa, pixels: Range<usize>, rows: &mut [f32], step: usize) {
        let (first, channels) = (pixels.start * self.channels, self.channels);
        copy(
            isa,
            Copy {
                from: &self.map[first..],
                from_step: channels,
                gate: self.gate.map(|gate| &gate[first..]),
                bias: None,
                relu: false,
                target: rows,
                target_step: step,
                rows: pixels.len(),
                channels,
            },
        );
    }

    /// The pixels of a line that some output pixels read: those from `first - 1` on, with zeros outside
    /// the image. `None` is the line above the image.
    pub(super) fn line(
        &self,
        isa: Isa,
        grid: Grid,
        image: usize,
        line: Option<usize>,
        first: usize,
        values: &mut [f32],
    ) {
        let channels = self.channels;
        let Some(line) = line.filter(|line| *line < grid.height) else {
            return values.fill(0.0);
        };
        let left = usize::from(first == 0);
        let end = first + values.len() / channels - 1;
        let right = end.saturating_sub(grid.width);
        let (before, inside) = values.split_at_mut(left * channels);
        let (inside, after) = inside.split_at_mut(inside.len() - right * channels);
        before.fill(0.0);
        after.fill(0.0);
        let start = (image * grid.height + line) * grid.width;
        let pixels = start + first + left - 1..start + end - right;
        self.copy(isa, pixels, inside, channels);
    }
}
