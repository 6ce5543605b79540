//! Separable filters of a plane, in the order that lets the compiler use vectors.

use std::ops::{AddAssign, Mul};

use rayon::prelude::*;

/// A float of either width.
pub(super) trait Real:
    Copy + Default + Send + Sync + AddAssign + Mul<Output = Self>
{
}
impl Real for f32 {}
impl Real for f64 {}

/// What lies outside of a plane.
#[derive(Clone, Copy, PartialEq, Eq)]
pub(super) enum Edge {
    /// Nothing: the output has only the pixels whose window lies inside.
    Valid,
    /// The pixel at the edge, again and again: the output has the plane's size.
    Replicate,
}

/// Correlates the rows of `plane` with `across`, then its columns with `down`, both of odd length.
///
/// # Shapes
/// `[H, W]` to itself, or with [`Edge::Valid`] less `taps - 1` in each direction.
pub(super) fn separable<T: Real>(
    plane: &[T],
    width: usize,
    across: &[T],
    down: &[T],
    edge: Edge,
) -> Vec<T> {
    let height = plane.len() / width;
    let margin = |taps: &[T]| match edge {
        Edge::Valid => 0,
        Edge::Replicate => taps.len() / 2,
    };
    let (beside, above) = (margin(across), margin(down));
    let inner = width + 2 * beside + 1 - across.len();
    let mut rows = vec![T::default(); height * inner];
    rows.par_chunks_mut(inner)
        .zip(plane.par_chunks(width))
        .for_each_init(
            || Vec::with_capacity(width + 2 * beside),
            |padded, (out, row)| {
                padded.clear();
                padded.resize(beside, row[0]);
                padded.extend_from_slice(row);
                padded.resize(width + 2 * beside, row[width - 1]);
                for (k, &tap) in across.iter().enumerate() {
                    add(out, &padded[k..k + inner], tap);
                }
            },
        );
    let mut out = vec![T::default(); (height + 2 * above + 1 - down.len()) * inner];
    out.par_chunks_mut(inner).enumerate().for_each(|(y, out)| {
        for (k, &tap) in down.iter().enumerate() {
            let y = (y + k).saturating_sub(above).min(height - 1);
            add(out, &rows[y * inner..(y + 1) * inner], tap);
        }
    });
    out
}

fn add<T: Real>(out: &mut [T], values: &[T], tap: T) {
    for (out, &value) in out.iter_mut().zip(values) {
        *out += tap * value;
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn valid_and_replicated_edges_by_hand() {
        // 2 rows of 3: 1 2 3 / 4 5 6, taps 1 0 2 across and 1 alone down.
        let plane = [1.0, 2.0, 3.0, 4.0, 5.0, 6.0];
        let across = [1.0, 0.0, 2.0];
        let valid = separable(&plane, 3, &across, &[1.0], Edge::Valid);
        assert_eq!(valid, [7.0, 16.0]);
        let all = separable(&plane, 3, &across, &[1.0], Edge::Replicate);
        assert_eq!(all, [5.0, 7.0, 8.0, 14.0, 16.0, 17.0]);
        let down = separable(&plane, 3, &[1.0], &across, Edge::Replicate);
        assert_eq!(down, [9.0, 12.0, 15.0, 9.0, 12.0, 15.0]);
    }
}
