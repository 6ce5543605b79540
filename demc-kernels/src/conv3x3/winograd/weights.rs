//! Weights in the transformed space.

use std::ops::Range;

use rayon::prelude::*;

use super::line::{self, both, each};
use crate::Isa;
use crate::conv3x3::parts::Axes;
use crate::product::Panels;
use crate::scratch::{Scratch, Shared};
use crate::simd::{Leaf, Simd, WIDEST, run};

pub(crate) struct WinogradWeights {
    pub(super) isa: Isa,
    pub(super) depth: usize,
    pub(super) columns: usize,
    pub(super) place_step: usize,
    pub(super) values: Scratch,
}

struct TransformWeights<'a, const IN: usize> {
    weight: &'a [f32],
    axes: Axes,
    rows: Range<usize>,
    target: Shared,
    place_step: usize,
}

impl<const IN: usize> Leaf for TransformWeights<'_, IN> {
    type Out = ();

    #[inline(always)]
    unsafe fn run<S: Simd>(self) {
        let panels = Panels::new::<S>(self.axes.outputs);
        for k in self.rows {
            for first in (0..panels.padded).step_by(S::LANES) {
                let mut taps = [[0.0; WIDEST]; 9];
                for lane in 0..S::LANES.min(self.axes.outputs - first) {
                    for (tap, lanes) in taps.iter_mut().enumerate() {
                        lanes[lane] = self.weight[self.axes.place(k, first + lane, tap)];
                    }
                }
                // SAFETY: `taps` holds one vector per tap. `target` has room for IN * IN places of a
                // whole vector, which belong to this row alone.
                unsafe {
                    let mut w = [[S::zero(); IN]; IN];
                    for (tap, lanes) in taps.iter().enumerate() {
                        w[tap / 3][tap % 3] = S::load(lanes.as_ptr());
                    }
                    let u = both!(line::weight::<S, IN>, S, IN, w);
                    let target =
                        self.target
                            .pointer()
                            .add(panels.place(self.axes.inputs, k, first));
                    for place in 0..IN * IN {
                        S::store(
                            target.add(place * self.place_step),
                            u[place / IN][place % IN],
                        );
                    }
                }
            }
        }
    }
}

struct Padded(usize);

impl Leaf for Padded {
    type Out = usize;

    #[inline(always)]
    unsafe fn run<S: Simd>(self) -> usize {
        self.0.next_multiple_of(S::LANES)
    }
}

pub(super) fn padded(isa: Isa, columns: usize) -> usize {
    // SAFETY: arithmetic only.
    unsafe { run(isa, Padded(columns)) }
}

/// Distance between places: an odd number of cache lines, so that the places of a tile map to
/// different cache sets.
pub(super) fn place_step(values: usize) -> usize {
    values.next_multiple_of(16) + 16
}

impl WinogradWeights {
    /// Transforms a weight `[out, in, 3, 3]`; `transposed` for the gradient with respect to the
    /// input.
    pub(crate) fn new<const IN: usize>(
        isa: Isa,
        weight: &[f32],
        outputs: usize,
        inputs: usize,
        transposed: bool,
    ) -> Self {
        let axes = Axes::new(outputs, inputs, transposed);
        let place_step = place_step(axes.inputs * padded(isa, axes.outputs));
        let mut values = Scratch::take(IN * IN * place_step);
        let target = Shared::new(&mut values);
        let step = (8192 / axes.outputs).max(1);
        (0..axes.inputs.div_ceil(step))
            .into_par_iter()
            .for_each(|task| {
                let rows = task * step..((task + 1) * step).min(axes.inputs);
                let leaf = TransformWeights::<IN> {
                    weight,
                    axes,
                    rows,
                    target,
                    place_step,
                };
                // SAFETY: tasks write different rows, all of them within `values`.
                unsafe { run(isa, leaf) }
            });
        WinogradWeights {
            isa,
            depth: axes.inputs,
            columns: axes.outputs,
            place_step,
            values,
        }
    }
}
