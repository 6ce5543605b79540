//! How far denoising has come, and who hears of it.

use std::ops::ControlFlow;

/// How far denoising an image has come.
#[derive(Debug, Clone, Copy, PartialEq)]
#[non_exhaustive]
pub struct DenoiseProgress {
    /// The tile that is computed, from 0.
    pub tile: usize,
    /// Number of tiles.
    pub tiles: usize,
    /// Finished share of the image and its layers, from 0 to 1. It stays at 0 in the pass of an albedo
    /// filter and at 1 in that of alpha.
    pub share: f64,
}

/// Receives the progress, and may stop the work. On the CPU it is called for every band of rows,
/// elsewhere for every tile.
pub type DenoiseObserver<'a> = dyn FnMut(DenoiseProgress) -> ControlFlow<()> + 'a;

/// Lets the work finish.
pub fn unobserved(_: DenoiseProgress) -> ControlFlow<()> {
    ControlFlow::Continue(())
}

/// The observer of the pass `pass` of `passes`, whose shares add up to 1.
pub(super) fn of_pass(
    observer: &mut DenoiseObserver,
    [pass, passes]: [usize; 2],
) -> impl FnMut(DenoiseProgress) -> ControlFlow<()> {
    move |progress| {
        let share = (pass as f64 + progress.share) / passes as f64;
        observer(DenoiseProgress { share, ..progress })
    }
}
