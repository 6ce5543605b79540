//! Compares with plain float64 loops, for whole maps and for bands.

use super::*;
use crate::reference;
use crate::testing::{
    assert_close, assert_equals_reference, f64s, few, grids, grids_and_wide_ones, pattern,
};

#[test]
fn equals_the_reference_on_every_path_at_odd_sizes() {
    for isa in Isa::available() {
        for (case, grid) in grids_and_wide_ones().into_iter().enumerate() {
            let cases = vec![
                (3, 8),
                (8, 8),
                (9, 3),
                (12, 5),
                (12, 16),
                (1, 1),
                (17, 33),
                (20, 8),
                (66, 16),
            ];
            for (inputs, outputs) in few(cases, 2) {
                let x = pattern(grid.pixels() * inputs, 1 + case as u32);
                let weight = pattern(outputs * inputs * 9, 2);
                let dy = pattern(grid.pixels() * outputs, 4);
                let name = format!("{isa} {grid:?} {inputs} to {outputs}");
                assert_equals_reference!(
                    conv3x3,
                    conv3x3_backward,
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

#[test]
fn bands_of_rows_are_the_whole() {
    let grid = Grid {
        batch: 1,
        height: 23,
        width: 9,
    };
    for isa in Isa::available() {
        for (inputs, outputs) in [(3, 20), (12, 16), (20, 3), (18, 33)] {
            let (x, weight) = (
                pattern(grid.pixels() * inputs, 1),
                pattern(outputs * inputs * 9, 2),
            );
            let bias = pattern(outputs, 3);
            for tile in [Tile::F2, Tile::F4] {
                let mut whole = vec![f32::NAN; grid.pixels() * outputs];
                let convolution = Convolution::rectified(&weight, &bias);
                let ready = PreparedConvolution::new(isa, tile, convolution);
                ready.forward(grid, &x, 0, &mut whole);
                let mut bands = vec![f32::NAN; whole.len()];
                for (first, end) in [(0, 4), (4, 16), (16, 23)] {
                    let (from, target) =
                        (usize::saturating_sub(first, 1), (end + 1).min(grid.height));
                    let row = grid.width * inputs;
                    let y = &mut bands[first * grid.width * outputs..end * grid.width * outputs];
                    let band = Grid {
                        height: target - from,
                        ..grid
                    };
                    ready.forward(band, &x[from * row..target * row], first - from, y);
                }
                let differs = |i: &usize| bands[*i].to_bits() != whole[*i].to_bits();
                let offset = (0..whole.len())
                    .find(differs)
                    .map(|i| (i / outputs, bands[i], whole[i]));
                assert!(
                    offset.is_none(),
                    "{isa} {inputs} to {outputs} {tile:?}: pixel, found, expected: {offset:?}"
                );
            }
        }
    }
}

#[test]
fn larger_tiles_keep_1e_4() {
    for isa in Isa::available() {
        for grid in grids() {
            let (inputs, outputs) = if cfg!(miri) { (9, 8) } else { (64, 17) };
            let x = pattern(grid.pixels() * inputs, 1);
            let weight = pattern(outputs * inputs * 9, 2);
            let bias = pattern(outputs, 3);
            let weights = winograd::WinogradWeights::new::<6>(isa, &weight, outputs, inputs, false);
            let mut y = vec![f32::NAN; grid.pixels() * outputs];
            winograd::convolve::<6>(
                grid,
                GatedMap::open(&x, inputs),
                &weights,
                BiasRelu {
                    bias: Some(&bias),
                    relu: true,
                },
                &mut y,
            );
            let expected = reference::conv3x3(grid, &f64s(&x), &f64s(&weight), &f64s(&bias), true);
            crate::testing::assert_within(&format!("{isa} {grid:?}"), &y, &expected, 2e-5);
        }
    }
}
