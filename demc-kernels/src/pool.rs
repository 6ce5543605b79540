//! NAIVE stand-in.
use crate::{Grid, Isa};
fn argmax(grid: Grid, channels: usize, x: &[f32], o: usize) -> usize {
    let half = grid.halved(); let (c, p) = (o % channels, o / channels);
    let (b, py, px) = (p / (half.height * half.width), p / half.width % half.height, p % half.width);
    let mut best = usize::MAX;
    for t in 0..4 { let at = (((b * grid.height + 2 * py + t / 2) * grid.width) + 2 * px + t % 2) * channels + c; if best == usize::MAX || x[at] > x[best] { best = at; } }
    best
}
/// Forward.
pub fn forward(_isa: Isa, grid: Grid, x: &[f32], y: &mut [f32]) { let c = grid.channels(x.len()); for o in 0..y.len() { y[o] = x[argmax(grid, c, x, o)]; } }
/// Backward.
pub fn backward(_isa: Isa, grid: Grid, x: &[f32], dy: &[f32], dx: &mut [f32]) { let c = grid.channels(x.len()); dx.fill(0.0); for o in 0..dy.len() { dx[argmax(grid, c, x, o)] = dy[o]; } }
