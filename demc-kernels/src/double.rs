//! Doubles a map by repeating pixels, and appends another map's channels, as a U-Net's decoder does.

use crate::{Grid, tasks};

/// `y` has the channels of `coarse`, each pixel repeated 2x2 times, then those of `skip`.
///
/// # Shapes
/// `coarse` on `grid.halved()`, `skip` and `y` on `grid`; `y` has the channels of both.
///
/// # Panics
/// If a side of `grid` is odd, or a length does not match the others.
pub fn forward(grid: Grid, coarse: &[f32], skip: &[f32], y: &mut [f32]) {
    let [below, beside] = check(grid, coarse.len(), skip.len(), y.len());
    let half = grid.width / 2 * below;
    let rows = y
        .chunks_mut(grid.width * (below + beside))
        .zip(skip.chunks(grid.width * beside))
        .enumerate();
    tasks::each(pieces(rows, grid.width * (below + beside)), |rows| {
        for (row, (y, skip)) in rows {
            let coarse = &coarse[row / 2 * half..][..half];
            let pixels = y.chunks_exact_mut(below + beside);
            for (x, (y, skip)) in pixels.zip(skip.chunks_exact(beside)).enumerate() {
                let (doubled, appended) = y.split_at_mut(below);
                doubled.copy_from_slice(&coarse[x / 2 * below..][..below]);
                appended.copy_from_slice(skip);
            }
        }
    });
}

/// Overwrites the gradients with respect to `coarse` and `skip`.
///
/// # Shapes
/// As [`forward`].
///
/// # Panics
/// As [`forward`].
pub fn backward(grid: Grid, dy: &[f32], dcoarse: &mut [f32], dskip: &mut [f32]) {
    let [below, beside] = check(grid, dcoarse.len(), dskip.len(), dy.len());
    let row = grid.width * (below + beside);
    let rows = dy
        .chunks(2 * row)
        .zip(dcoarse.chunks_mut(grid.width / 2 * below))
        .zip(dskip.chunks_mut(2 * grid.width * beside));
    tasks::each(pieces(rows, 2 * row), |rows| {
        for ((dy, dcoarse), dskip) in rows {
            let pixels = dy.chunks_exact(below + beside);
            for (dy, dskip) in pixels.zip(dskip.chunks_exact_mut(beside)) {
                dskip.copy_from_slice(&dy[below..]);
            }
            let (top, bottom) = dy.split_at(row);
            let pairs = top
                .chunks_exact(2 * (below + beside))
                .zip(bottom.chunks_exact(2 * (below + beside)));
            for ((top, bottom), sum) in pairs.zip(dcoarse.chunks_exact_mut(below)) {
                let [a, c] = [top, bottom].map(|row| &row[..below]);
                let [b, d] = [top, bottom].map(|row| &row[below + beside..][..below]);
                for (channel, sum) in sum.iter_mut().enumerate() {
                    *sum = a[channel] + b[channel] + (c[channel] + d[channel]);
                }
            }
        }
    });
}

/// Rows in pieces for the threads, `values` per row.
fn pieces<T>(rows: impl Iterator<Item = T>, values: usize) -> impl Iterator<Item = Vec<T>> {
    let count = tasks::rows_per_task(values);
    let mut rows = rows.peekable();
    std::iter::from_fn(move || {
        rows.peek()?;
        Some(rows.by_ref().take(count).collect())
    })
}

/// Channels of the coarse map and of the appended one.
#[track_caller]
fn check(grid: Grid, coarse: usize, skip: usize, y: usize) -> [usize; 2] {
    let even = grid.height.is_multiple_of(2) && grid.width.is_multiple_of(2);
    assert!(even, "sides of {grid:?} are even");
    let channels = [grid.halved().channels(coarse), grid.channels(skip)];
    let expected = grid.pixels() * (channels[0] + channels[1]);
    assert_eq!(y, expected, "values of {channels:?} channels on {grid:?}");
    channels
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::testing::{assert_close, f64s, pattern, same_on_any_number_of_threads};

    const GRID: Grid = Grid {
        batch: 2,
        height: 6,
        width: 10,
    };

    #[test]
    fn pixels_are_repeated_and_channels_appended() {
        let (coarse, skip) = (pattern(2 * 3 * 5 * 7, 1), pattern(2 * 6 * 10 * 3, 2));
        let run = || {
            let mut y = vec![f32::NAN; 2 * 6 * 10 * 10];
            forward(GRID, &coarse, &skip, &mut y);
            y
        };
        same_on_any_number_of_threads(run);
        let y = run();
        for image in 0..2 {
            for row in 0..6 {
                for column in 0..10 {
                    let pixel = (image * 6 + row) * 10 + column;
                    let from = (image * 3 + row / 2) * 5 + column / 2;
                    assert_eq!(y[pixel * 10..][..7], coarse[from * 7..][..7]);
                    assert_eq!(y[pixel * 10 + 7..][..3], skip[pixel * 3..][..3]);
                }
            }
        }
    }

    /// The sum of `y` times any weights changes by the gradient times the change of the inputs, since
    /// the operation is linear.
    #[test]
    fn gradients_are_those_of_a_linear_function() {
        let weights = pattern(2 * 6 * 10 * 10, 3);
        let run = || {
            let mut gradients = (
                vec![f32::NAN; 2 * 3 * 5 * 7],
                vec![f32::NAN; 2 * 6 * 10 * 3],
            );
            backward(GRID, &weights, &mut gradients.0, &mut gradients.1);
            gradients
        };
        same_on_any_number_of_threads(run);
        let (dcoarse, dskip) = run();
        let mut expected = (vec![0.0; dcoarse.len()], vec![0.0; dskip.len()]);
        let mut y = vec![0.0; weights.len()];
        let mut dot = |coarse: &[f32], skip: &[f32]| {
            forward(GRID, coarse, skip, &mut y);
            let products = f64s(&y).into_iter().zip(f64s(&weights));
            products.map(|(y, weight)| y * weight).sum::<f64>()
        };
        let (mut coarse, mut skip) = (vec![0.0; dcoarse.len()], vec![0.0; dskip.len()]);
        for (i, expected) in expected.0.iter_mut().enumerate() {
            coarse[i] = 1.0;
            *expected = dot(&coarse, &skip);
            coarse[i] = 0.0;
        }
        for (i, expected) in expected.1.iter_mut().enumerate() {
            skip[i] = 1.0;
            *expected = dot(&coarse, &skip);
            skip[i] = 0.0;
        }
        assert_close("coarse", &dcoarse, &expected.0);
        assert_close("skip", &dskip, &expected.1);
    }
}
