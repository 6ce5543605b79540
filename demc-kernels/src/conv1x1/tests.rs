//! Compares with plain float64 loops over concatenated maps.

use super::*;
use crate::reference;
use crate::testing::{assert_close, f64s, few, grids_and_wide_ones, pattern};

fn concatenated(grid: Grid, xs: &[&[f32]]) -> Vec<f64> {
    let rows = (0..grid.pixels()).flat_map(|p| {
        xs.iter().flat_map(move |x| {
            let channels = grid.channels(x.len());
            x[p * channels..(p + 1) * channels]
                .iter()
                .map(|x| f64::from(*x))
        })
    });
    rows.collect()
}

#[test]
fn parts_added_one_by_one_are_the_whole() {
    let inputs = [20, 3, 16];
    for isa in Isa::available() {
        for (grid, outputs) in grids_and_wide_ones()
            .into_iter()
            .flat_map(|grid| [(grid, 18), (grid, 32)])
        {
            let maps: Vec<Vec<f32>> = inputs
                .iter()
                .enumerate()
                .map(|(s, c)| pattern(grid.pixels() * c, s as u32))
                .collect();
            let xs: Vec<&[f32]> = maps.iter().map(|x| &x[..]).collect();
            let (weight, bias) = (pattern(outputs * 39, 7), pattern(outputs, 8));
            let mut y = vec![f32::NAN; grid.pixels() * outputs];
            let first = Part {
                weight: &weight,
                first: 20,
                epilogue: Epilogue::default(),
            };
            forward_part(isa, grid, &xs[1..], first, &mut y);
            let last = Part {
                weight: &weight,
                first: 0,
                epilogue: Epilogue {
                    bias: Some(&bias),
                    relu: true,
                    add: true,
                },
            };
            forward_part(isa, grid, &xs[..1], last, &mut y);
            let expected = reference::conv1x1(
                grid,
                &concatenated(grid, &xs),
                &f64s(&weight),
                &f64s(&bias),
                true,
            );
            assert_close(&format!("{isa} {grid:?} to {outputs}"), &y, &expected);
        }
    }
}

#[test]
fn equals_the_reference_of_the_concatenation_on_every_path() {
    for isa in Isa::available() {
        for grid in grids_and_wide_ones() {
            let cases = vec![
                (vec![6, 6, 6], 6),
                (vec![1], 1),
                (vec![33, 17], 40),
                (vec![64, 64, 64], 64),
            ];
            for (inputs, outputs) in few(cases, 2) {
                let maps: Vec<Vec<f32>> = inputs
                    .iter()
                    .enumerate()
                    .map(|(s, c)| pattern(grid.pixels() * c, s as u32))
                    .collect();
                let xs: Vec<&[f32]> = maps.iter().map(|x| &x[..]).collect();
                let total: usize = inputs.iter().sum();
                let (weight, bias) = (pattern(outputs * total, 7), pattern(outputs, 8));
                let dy = pattern(grid.pixels() * outputs, 9);
                let name = format!("{isa} {grid:?} {inputs:?} to {outputs}");
                let cat = concatenated(grid, &xs);
                let mut y = vec![f32::NAN; dy.len()];
                let convolution = Convolution::rectified(&weight, &bias);
                forward(isa, grid, &xs, convolution, &mut y);
                let expected = reference::conv1x1(grid, &cat, &f64s(&weight), &f64s(&bias), true);
                assert_close(&format!("{name} y"), &y, &expected);

                let expected = reference::conv1x1_backward(
                    grid,
                    &cat,
                    &f64s(&weight),
                    &reference::gated(&f64s(&dy), &f64s(&y)),
                );
                let mut dxs: Vec<Vec<f32>> = maps.iter().map(|x| vec![f32::NAN; x.len()]).collect();
                let mut slots: Vec<Option<&mut [f32]>> =
                    dxs.iter_mut().map(|dx| Some(&mut dx[..])).collect();
                let (mut dweight, mut dbias) =
                    (vec![f32::NAN; weight.len()], vec![f32::NAN; outputs]);
                backward(
                    isa,
                    grid,
                    &xs,
                    GradientSource::rectified(&weight, &y, &dy),
                    GradientTarget {
                        dx: &mut slots[..],
                        dweight: &mut dweight,
                        dbias: &mut dbias,
                    },
                );
                let dxs: Vec<&[f32]> = dxs.iter().map(|x| &x[..]).collect();
                let found: Vec<f32> = concatenated(grid, &dxs).iter().map(|x| *x as f32).collect();
                assert_close(&format!("{name} dx"), &found, &expected.dx);
                assert_close(&format!("{name} dweight"), &dweight, &expected.dweight);
                assert_close(&format!("{name} dbias"), &dbias, &expected.dbias);
            }
        }
    }
}
