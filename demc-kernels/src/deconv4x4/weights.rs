//! A weight as four matrices, one per tap.

use std::ops::Range;

use rayon::prelude::*;

use crate::Isa;
use crate::product::Panels;
use crate::rows::Packed;
use crate::scratch::Shared;
use crate::simd::{Leaf, Simd, WIDEST, run};

/// Offsets of the 2x2 inputs of a cell.
pub(super) const TAPS: [(usize, usize); 4] = [(0, 0), (0, 1), (1, 0), (1, 1)];

/// Packs a weight `[in, out, 4, 4]` by taps. Each task packs the rows of some inputs of `in x 4
/// out` matrices, or (transposed) the rows of some outputs of `4 out x in` matrices.
struct PackTaps<'a> {
    weight: &'a [f32],
    inputs: usize,
    outputs: usize,
    transposed: bool,
    /// Inputs, or outputs where transposed.
    range: Range<usize>,
    target: [Shared; 4],
}

impl Leaf for PackTaps<'_> {
    type Out = ();

    #[inline(always)]
    unsafe fn run<S: Simd>(self) {
        let PackTaps {
            inputs,
            outputs,
            transposed,
            ..
        } = self;
        let (depth, columns, lanes_of) = if transposed {
            (4 * outputs, inputs, inputs)
        } else {
            (inputs, 4 * outputs, outputs)
        };
        let panels = Panels::new::<S>(columns);
        // Adjacent outputs in the file are read together, one cache line each.
        for first in (0..lanes_of).step_by(S::LANES) {
            for index in self.range.clone() {
                let count = S::LANES.min(lanes_of - first);
                let mut taps = [[0.0; WIDEST]; 16];
                for lane in 0..count {
                    let (input, output) = if transposed {
                        (first + lane, index)
                    } else {
                        (index, first + lane)
                    };
                    let from = (input * outputs + output) * 16;
                    for (values, weight) in taps.iter_mut().zip(&self.weight[from..from + 16]) {
                        values[lane] = *weight;
                    }
                }
                for (t, values) in taps.iter().enumerate() {
                    let (y, x) = (t / 4, t % 4);
                    let (tap, phase) = (y / 2 * 2 + x / 2, y % 2 * 2 + x % 2);
                    let target = self.target[tap].pointer();
                    let (row, column) = if transposed {
                        (phase * outputs + index, first)
                    } else {
                        (index, phase * outputs + first)
                    };
                    // SAFETY: the row of this index is this leaf's; vectors and columns lie within
                    // the operand.
                    unsafe {
                        if column % S::LANES == 0 && (count == S::LANES || transposed) {
                            S::store(
                                target.add(panels.place(depth, row, column)),
                                S::load(values.as_ptr()),
                            );
                        } else {
                            for (lane, value) in values[..count].iter().enumerate() {
                                *target.add(panels.place(depth, row, column + lane)) = *value;
                            }
                        }
                    }
                }
            }
        }
    }
}

/// The four matrices of a weight, one for each of [`TAPS`].
pub(super) fn packed(
    isa: Isa,
    weight: &[f32],
    inputs: usize,
    outputs: usize,
    transposed: bool,
) -> [Packed; 4] {
    let (depth, columns, count) = if transposed {
        (4 * outputs, inputs, outputs)
    } else {
        (inputs, 4 * outputs, inputs)
    };
    let mut packed = TAPS.map(|_| Packed::empty(depth, columns));
    let [a, b, c, d] = &mut packed;
    let target = [a.values(), b.values(), c.values(), d.values()];
    let step = (2048 / (inputs * outputs / count)).max(1);
    (0..count.div_ceil(step)).into_par_iter().for_each(|task| {
        let range = task * step..((task + 1) * step).min(count);
        // SAFETY: tasks write different rows.
        unsafe {
            run(
                isa,
                PackTaps {
                    weight,
                    inputs,
                    outputs,
                    transposed,
                    range,
                    target,
                },
            )
        };
    });
    packed
}
