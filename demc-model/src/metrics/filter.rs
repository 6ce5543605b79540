//! Separable filters of a plane, with loops that the compiler vectorises.

use std::ops::{AddAssign, Mul};

use multiversion::multiversion;
use rayon::prelude::*;

/// Correlates the columns of `plane` with `down`, then its rows with `across`, both of odd length.
/// Pixels at the edge repeat outside of the plane.
///
/// # Shapes
/// `[H, W]` to itself.
pub(super) fn separable(plane: &[f32], width: usize, across: &[f32], down: &[f32]) -> Vec<f32> {
    let height = plane.len() / width;
    let (beside, above) = (across.len() / 2, down.len() / 2);
    let mut out = vec![0.0; plane.len()];
    let rows = out.par_chunks_mut(width).enumerate();
    // Between the two passes each thread stores one row, not a plane.
    rows.for_each_init(
        || vec![0.0; width + 2 * beside],
        |padded, (y, out)| {
            let (left, rest) = padded.split_at_mut(beside);
            let (middle, right) = rest.split_at_mut(width);
            middle.fill(0.0);
            for (k, &tap) in down.iter().enumerate() {
                let y = (y + k).saturating_sub(above).min(height - 1);
                add(middle, &plane[y * width..(y + 1) * width], tap);
            }
            left.fill(middle[0]);
            right.fill(middle[width - 1]);
            for (k, &tap) in across.iter().enumerate() {
                add(out, &padded[k..k + width], tap);
            }
        },
    );
    out
}

/// `out += tap * values`. Products and sums are rounded one by one, so all instruction sets give
/// the same bits.
#[multiversion(targets("x86_64+avx512f", "x86_64+avx2"))]
pub(super) fn add<T: Copy + AddAssign + Mul<Output = T>>(out: &mut [T], values: &[T], tap: T) {
    for (out, &value) in out.iter_mut().zip(values) {
        *out += tap * value;
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn edges_repeat_as_in_a_hand_computed_case() {
        // 2 rows of 3: 1 2 3 / 4 5 6, with taps 1 0 2 across and 1 down.
        let plane = [1.0, 2.0, 3.0, 4.0, 5.0, 6.0];
        let across = [1.0, 0.0, 2.0];
        let all = separable(&plane, 3, &across, &[1.0]);
        assert_eq!(all, [5.0, 7.0, 8.0, 14.0, 16.0, 17.0]);
        let down = separable(&plane, 3, &[1.0], &across);
        assert_eq!(down, [9.0, 12.0, 15.0, 9.0, 12.0, 15.0]);
    }
}
