//! Compares with plain float64 loops.

use super::*;
use crate::reference;
use crate::testing::{
    assert_close, assert_equals_reference, bits, f64s, few, grids_and_wide_ones, pattern,
    same_on_any_number_of_threads,
};

#[test]
fn equals_the_reference_on_every_path_at_odd_sizes() {
    for isa in Isa::available() {
        for (case, grid) in grids_and_wide_ones().into_iter().enumerate() {
            let cases = vec![(3, 8), (8, 8), (9, 3), (1, 1), (17, 33), (34, 20)];
            for (inputs, outputs) in few(cases, 2) {
                let x = pattern(grid.pixels() * inputs, 1 + case as u32);
                let weight = pattern(outputs * inputs * TAPS, 2);
                let dy = pattern(grid.pixels() * outputs, 4);
                let name = format!("{isa} {grid:?} {inputs} to {outputs}");
                assert_equals_reference!(
                    conv5x5,
                    conv5x5_backward,
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
#[cfg_attr(miri, ignore = "takes minutes")]
fn bits_do_not_depend_on_the_threads() {
    let grid = Grid {
        batch: 2,
        height: 20,
        width: 130,
    };
    let (inputs, outputs) = (10, 20);
    let x = pattern(grid.pixels() * inputs, 1);
    let weight = pattern(outputs * inputs * TAPS, 2);
    let (bias, dy) = (pattern(outputs, 3), pattern(grid.pixels() * outputs, 4));
    same_on_any_number_of_threads(|| {
        let isa = Isa::current();
        let mut y = vec![0.0; dy.len()];
        forward(
            isa,
            grid,
            &x,
            Convolution::rectified(&weight, &bias),
            &mut y,
        );
        let (mut dx, mut dweight, mut dbias) = (x.clone(), weight.clone(), vec![0.0; outputs]);
        let target = GradientTarget {
            dx: Some(&mut dx[..]),
            dweight: &mut dweight,
            dbias: &mut dbias,
        };
        let source = GradientSource::rectified(&weight, &y, &dy);
        backward(isa, grid, &x, source, target);
        [&y, &dx, &dweight, &dbias].map(|values| bits(values))
    });
}
