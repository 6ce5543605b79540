//! Comparison with the plain sum, on every path.

use super::*;
use crate::reference;
use crate::testing::{
    assert_close, assert_within, bits, f64s, few, grids, pattern, same_on_any_number_of_threads,
};

/// Logits of a kernel of 5x5.
const TAPS: usize = 25;
/// Numbers of logits that a kernel may have.
const LOGITS: [usize; 4] = [TAPS, TAPS + 1, 441, 442];

fn logits(grid: Grid, channels: usize) -> Vec<f32> {
    pattern(grid.pixels() * channels, 5)
        .iter()
        .map(|x| 4.0 * x)
        .collect()
}

#[test]
fn it_is_the_plain_sum_on_every_path() {
    for grid in grids() {
        let x = pattern(grid.pixels() * COLORS, 1);
        for channels in LOGITS {
            let logits = logits(grid, channels);
            let expected = reference::filter(grid, &f64s(&x), &f64s(&logits));
            for isa in Isa::available() {
                let mut y = vec![f32::NAN; expected.len()];
                let filter = Filter {
                    x: &x,
                    logits: &logits,
                };
                forward(isa, grid, filter, &mut y);
                assert_close(&format!("{isa} {grid:?}"), &y, &expected);
            }
        }
    }
}

/// Two batches of three images each, on every path: the bits of each image alone.
#[test]
fn images_that_share_kernels_are_filtered_as_each_alone() {
    for grid in few(grids(), 2) {
        let (pixels, sharing) = (grid.height * grid.width, 3);
        let x = pattern(sharing * grid.pixels() * COLORS, 1);
        for channels in LOGITS {
            let (logits, outputs) = (logits(grid, channels), outputs(channels));
            for isa in Isa::available() {
                let mut y = vec![f32::NAN; sharing * grid.pixels() * outputs];
                let filter = Filter {
                    x: &x,
                    logits: &logits,
                };
                forward(isa, grid, filter, &mut y);
                let mut alone = y.clone();
                let single = Grid { batch: 1, ..grid };
                let images = x.chunks(pixels * COLORS);
                let targets = alone.chunks_mut(pixels * outputs);
                for (image, (x, alone)) in images.zip(targets).enumerate() {
                    alone.fill(f32::NAN);
                    let first = image / sharing * pixels * channels;
                    let logits = &logits[first..first + pixels * channels];
                    forward(isa, single, Filter { x, logits }, alone);
                }
                assert_eq!(bits(&y), bits(&alone), "{isa} {grid:?} {channels}");
            }
        }
    }
}

/// Central differences of the float64 loops.
#[test]
fn the_gradient_is_that_of_differences() {
    let cases = few(grids(), 1)
        .into_iter()
        .flat_map(|grid| [TAPS + 1, 441].map(|n| (grid, n)));
    for (grid, channels) in cases {
        let x = pattern(grid.pixels() * COLORS, 1);
        let logits = logits(grid, channels);
        let dy = pattern(grid.pixels() * outputs(channels), 3);
        let sum = |logits: &[f64]| -> f64 {
            let y = reference::filter(grid, &f64s(&x), logits);
            y.iter().zip(&dy).map(|(y, dy)| y * f64::from(*dy)).sum()
        };
        let mut found = vec![f32::NAN; logits.len()];
        let filter = Filter {
            x: &x,
            logits: &logits,
        };
        backward(Isa::current(), grid, filter, &dy, &mut found);
        let step = (logits.len() / 300).max(1);
        for i in (0..logits.len()).step_by(step) {
            let mut moved = f64s(&logits);
            moved[i] += 1e-4;
            let above = sum(&moved);
            moved[i] -= 2e-4;
            let expected = (above - sum(&moved)) / 2e-4;
            assert_within(&format!("{grid:?} {i}"), &[found[i]], &[expected], 1e-6);
        }
    }
}

#[test]
#[cfg_attr(miri, ignore = "takes minutes")]
fn bits_depend_neither_on_the_path_nor_on_the_threads_nor_on_bands() {
    let grid = Grid {
        batch: 2,
        height: 50,
        width: 37,
    };
    let x = pattern(grid.pixels() * COLORS, 1);
    let logits = logits(grid, TAPS + 1);
    let dy = pattern(grid.pixels() * (COLORS + 1), 3);
    let filter = Filter {
        x: &x,
        logits: &logits,
    };
    let work = |isa| {
        let (mut y, mut d) = (vec![0.0; dy.len()], vec![0.0; logits.len()]);
        forward(isa, grid, filter, &mut y);
        backward(isa, grid, filter, &dy, &mut d);
        (bits(&y), bits(&d))
    };
    for isa in Isa::available() {
        assert!(work(isa) == work(Isa::Portable), "{isa}");
        same_on_any_number_of_threads(|| work(isa));
    }
    let image = grid.height * grid.width;
    let (mut whole, mut band) = (vec![0.0; dy.len()], vec![0.0; 20 * grid.width * 4]);
    forward(Isa::current(), grid, filter, &mut whole);
    let rows = 7 * grid.width..27 * grid.width;
    forward_rows(
        Isa::current(),
        Grid { batch: 1, ..grid },
        Filter {
            x: &x[..image * COLORS],
            logits: &logits[rows.start * (TAPS + 1)..rows.end * (TAPS + 1)],
        },
        7..27,
        vec![&mut band],
    );
    assert_eq!(bits(&band), bits(&whole[rows.start * 4..rows.end * 4]));
}

#[test]
fn a_flat_image_stays_flat_and_extreme_logits_select_one_pixel() {
    let grid = Grid {
        batch: 1,
        height: 4,
        width: 6,
    };
    let mut y = vec![0.0; grid.pixels() * COLORS];
    forward(
        Isa::current(),
        grid,
        Filter {
            x: &[0.7; 72],
            logits: &logits(grid, TAPS),
        },
        &mut y,
    );
    assert!(y.iter().all(|y| (y - 0.7).abs() < 1e-6));
    let x = pattern(grid.pixels() * COLORS, 1);
    let mut centre = vec![-1000.0; grid.pixels() * TAPS];
    centre
        .iter_mut()
        .skip(TAPS / 2)
        .step_by(TAPS)
        .for_each(|logit| *logit = 1000.0);
    let filter = Filter {
        x: &x,
        logits: &centre,
    };
    forward(Isa::current(), grid, filter, &mut y);
    assert_eq!(y, x);
    centre[0] = f32::NAN;
    let filter = Filter {
        x: &x,
        logits: &centre,
    };
    forward(Isa::current(), grid, filter, &mut y);
    assert!(y[..COLORS].iter().all(|y| y.is_nan()) && y[COLORS..].iter().all(|y| y.is_finite()));
}
