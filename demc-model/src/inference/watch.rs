//! Progress and cancellation of a pass.

use std::cell::{Cell, RefCell};
use std::ops::ControlFlow;

use demc_kernels::Grid;

use crate::config::LEVELS;

/// The observer of a pass asked it to stop.
#[derive(Debug, Clone, Copy, PartialEq, Eq, thiserror::Error)]
#[error("cancelled")]
pub struct Cancelled;

/// Receives the finished share of a pass, from 0 to 1, and may stop it.
pub type Observer<'a> = dyn FnMut(f64) -> ControlFlow<()> + 'a;

/// Counts the pixels of the maps that a pass has computed, and tells the observer.
pub(super) struct Watch<'a, 'b> {
    observer: RefCell<&'a mut Observer<'b>>,
    done: Cell<f64>,
    all: f64,
}

impl<'a, 'b> Watch<'a, 'b> {
    /// Watches a pass over images on `grid` that computes every level `times` times, once in each encoder
    /// and in the decoder.
    pub(super) fn new(grid: Grid, times: usize, observer: &'a mut Observer<'b>) -> Self {
        let levels =
            (0..LEVELS).map(|level| grid.pixels() as f64 / f64::from(4u32.pow(level as u32)));
        Watch {
            observer: RefCell::new(observer),
            done: Cell::new(0.0),
            all: times as f64 * levels.sum::<f64>(),
        }
    }

    /// Adds `pixels` of an encoder's or decoder's level.
    ///
    /// # Errors
    /// The observer stops the pass.
    pub(super) fn add(&self, pixels: usize) -> Result<(), Cancelled> {
        let done = self.done.get() + pixels as f64;
        self.done.set(done);
        let mut observer = self.observer.borrow_mut();
        match observer((done / self.all).min(1.0)) {
            ControlFlow::Continue(()) => Ok(()),
            ControlFlow::Break(()) => Err(Cancelled),
        }
    }
}
