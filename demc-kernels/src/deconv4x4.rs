//! NAIVE stand-in.
use crate::{Grid, Isa, reference};
fn f64s(x: &[f32]) -> Vec<f64> { x.iter().map(|x| f64::from(*x)).collect() }
fn put(y: &mut [f32], x: &[f64]) { assert_eq!(y.len(), x.len()); for (y, x) in y.iter_mut().zip(x) { *y = *x as f32; } }
/// Forward.
#[allow(clippy::too_many_arguments)]
pub fn forward(_isa: Isa, grid: Grid, x: &[f32], weight: &[f32], bias: &[f32], relu: bool, y: &mut [f32]) {
    put(y, &reference::deconv4x4(grid, &f64s(x), &f64s(weight), &f64s(bias), relu));
}
/// Backward.
#[allow(clippy::too_many_arguments)]
pub fn backward(_isa: Isa, grid: Grid, x: &[f32], weight: &[f32], y: Option<&[f32]>, dy: &[f32], dx: Option<&mut [f32]>, dweight: &mut [f32], dbias: &mut [f32]) {
    let dy = match y { Some(y) => reference::gated(&f64s(dy), &f64s(y)), None => f64s(dy) };
    let g = reference::deconv4x4_backward(grid, &f64s(x), &f64s(weight), &dy);
    if let Some(dx) = dx { put(dx, &g.dx); }
    put(dweight, &g.dweight);
    put(dbias, &g.dbias);
}
