//! Compares with plain float64 loops, for whole maps and for bands.

use super::*;
use crate::reference;
use crate::testing::{assert_close, assert_equals_reference, f64s, few, grids, pattern};

#[test]
fn bands_of_rows_are_the_whole() {
    let grid = Grid {
        batch: 1,
        height: 11,
        width: 9,
    };
    let (inputs, outputs) = (18, 7);
    for isa in Isa::available() {
        let (x, weight) = (
            pattern(grid.pixels() * inputs, 1),
            pattern(outputs * inputs * 16, 2),
        );
        let bias = pattern(outputs, 3);
        let mut whole = vec![f32::NAN; grid.doubled().pixels() * outputs];
        let convolution = Convolution::rectified(&weight, &bias);
        forward(isa, grid, &x, convolution, &mut whole);
        let ready = PreparedDeconvolution::new(isa, convolution);
        let mut bands = vec![f32::NAN; whole.len()];
        for (first, end) in [(0, 1), (1, 7), (7, 11)] {
            let (from, target) = (usize::saturating_sub(first, 1), (end + 1).min(grid.height));
            let (row, y_row) = (grid.width * inputs, 4 * grid.width * outputs);
            let band = Grid {
                height: target - from,
                ..grid
            };
            ready.forward(
                band,
                &x[from * row..target * row],
                first - from,
                &mut bands[first * y_row..end * y_row],
            );
        }
        assert!(bands == whole, "{isa}");
    }
}

#[test]
fn equals_the_reference_on_every_path_at_odd_sizes() {
    for isa in Isa::available() {
        for grid in grids() {
            for (inputs, outputs) in few(vec![(1, 1), (6, 5), (17, 8), (33, 20)], 2) {
                let x = pattern(grid.pixels() * inputs, 1);
                let weight = pattern(inputs * outputs * 16, 2);
                let dy = pattern(grid.doubled().pixels() * outputs, 4);
                let name = format!("{isa} {grid:?} {inputs} to {outputs}");
                assert_equals_reference!(
                    deconv4x4,
                    deconv4x4_backward,
                    name,
                    isa,
                    grid,
                    x,
                    weight,
                    dy,
                    outputs
                );
            }
        }
    }
}
