//! NAIVE stand-in.
use crate::{Grid, Isa, reference};
fn f64s(x: &[f32]) -> Vec<f64> { x.iter().map(|x| f64::from(*x)).collect() }
fn put(y: &mut [f32], x: &[f64]) { assert_eq!(y.len(), x.len()); for (y, x) in y.iter_mut().zip(x) { *y = *x as f32; } }
fn cat(grid: Grid, xs: &[&[f32]]) -> Vec<f64> {
    let mut out = Vec::new();
    for p in 0..grid.pixels() { for x in xs { let c = grid.channels(x.len()); out.extend(x[p * c..(p + 1) * c].iter().map(|x| f64::from(*x))); } }
    out
}
/// Forward.
#[allow(clippy::too_many_arguments)]
pub fn forward(_isa: Isa, grid: Grid, xs: &[&[f32]], weight: &[f32], bias: &[f32], relu: bool, y: &mut [f32]) {
    put(y, &reference::conv1x1(grid, &cat(grid, xs), &f64s(weight), &f64s(bias), relu));
}
/// Backward.
#[allow(clippy::too_many_arguments)]
pub fn backward(_isa: Isa, grid: Grid, xs: &[&[f32]], weight: &[f32], y: Option<&[f32]>, dy: &[f32], dxs: &mut [Option<&mut [f32]>], dweight: &mut [f32], dbias: &mut [f32]) {
    let dy = match y { Some(y) => reference::gated(&f64s(dy), &f64s(y)), None => f64s(dy) };
    let g = reference::conv1x1_backward(grid, &cat(grid, xs), &f64s(weight), &dy);
    let total: usize = xs.iter().map(|x| grid.channels(x.len())).sum();
    let mut first = 0;
    for (x, dx) in xs.iter().zip(dxs) {
        let c = grid.channels(x.len());
        if let Some(dx) = dx { for p in 0..grid.pixels() { for i in 0..c { dx[p * c + i] = g.dx[p * total + first + i] as f32; } } }
        first += c;
    }
    put(dweight, &g.dweight);
    put(dbias, &g.dbias);
}
