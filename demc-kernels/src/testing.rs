//! Test helpers for all kernels.

use crate::Grid;

/// Odd sizes, a single pixel, single rows and columns, a batch.
pub(crate) fn grids() -> Vec<Grid> {
    let sizes = if cfg!(miri) {
        vec![(1, 1, 1), (2, 3, 5)]
    } else {
        vec![
            (1, 1, 1),
            (1, 1, 7),
            (3, 5, 1),
            (2, 7, 9),
            (1, 32, 32),
            (3, 2, 2),
        ]
    };
    all(sizes)
}

/// [`grids`], and grids whose lines are longer than a block of pixels.
pub(crate) fn grids_and_wide_ones() -> Vec<Grid> {
    let mut grids = grids();
    if !cfg!(miri) {
        grids.extend(all(vec![(1, 2, 192), (2, 2, 200)]));
    }
    grids
}

fn all(sizes: Vec<(usize, usize, usize)>) -> Vec<Grid> {
    let grids = sizes.into_iter().map(|(batch, height, width)| Grid {
        batch,
        height,
        width,
    });
    grids.collect()
}

/// All cases; only the first ones under Miri, where a millisecond becomes a minute.
pub(crate) fn few<T>(mut cases: Vec<T>, under_miri: usize) -> Vec<T> {
    if cfg!(miri) {
        cases.truncate(under_miri);
    }
    cases
}

pub(crate) fn pattern(len: usize, seed: u32) -> Vec<f32> {
    let mut state = seed.wrapping_mul(2654435769);
    let next = || {
        state = state.wrapping_mul(1664525).wrapping_add(1013904223);
        (state >> 8) as f32 / (1 << 23) as f32 - 1.0
    };
    std::iter::repeat_with(next).take(len).collect()
}

pub(crate) fn f64s(x: &[f32]) -> Vec<f64> {
    x.iter().map(|x| f64::from(*x)).collect()
}

/// Asserts that differences are at most `bound` times the largest expected value (at least 1).
pub(crate) fn assert_within(name: &str, found: &[f32], expected: &[f64], bound: f64) {
    assert_eq!(found.len(), expected.len(), "{name}");
    let scale = expected.iter().fold(1.0, |m: f64, x| m.max(x.abs()));
    for (i, (f, e)) in found.iter().zip(expected).enumerate() {
        let error = (f64::from(*f) - e).abs() / scale;
        assert!(
            error <= bound,
            "{name}[{i}]: {f} instead of {e}, off by {error:e} of {scale}"
        );
    }
}

/// Asserts agreement to 2e-6: a few roundings of float32 (6e-8 each) in sums that are ten times
/// their result.
pub(crate) fn assert_close(name: &str, found: &[f32], expected: &[f64]) {
    assert_within(name, found, expected, 2e-6);
}

/// Asserts that `work` returns the same on one, two and three threads.
pub(crate) fn same_on_any_number_of_threads<R: PartialEq + Send>(work: impl Fn() -> R + Sync) {
    let on = |threads| {
        let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build();
        pool.expect("threads").install(&work)
    };
    let one = on(1);
    assert!(
        one == on(2) && one == on(3),
        "results differ with the threads"
    );
}

pub(crate) fn bits(x: &[f32]) -> Vec<u32> {
    x.iter().map(|x| x.to_bits()).collect()
}

/// Compares `forward` and `backward` of the calling module with the loops of `reference`, with and
/// without a ReLU.
macro_rules! assert_equals_reference {
    ($forward:ident, $backward:ident, $name:expr, $isa:expr, $grid:expr, $x:expr, $weight:expr, $dy:expr, $outputs:expr) => {
        let (x, weight, dy, bias) = ($x, $weight, $dy, pattern($outputs, 3));
        for relu in [false, true] {
            let mut y = vec![f32::NAN; dy.len()];
            let convolution = $crate::Convolution {
                weight: &weight,
                bias: &bias,
                relu,
            };
            forward($isa, $grid, &x, convolution, &mut y);
            let expected =
                reference::$forward($grid, &f64s(&x), &f64s(&weight), &f64s(&bias), relu);
            assert_close(&format!("{} y", $name), &y, &expected);

            let gate = relu.then_some(&y[..]);
            let gated = match gate {
                Some(y) => reference::gated(&f64s(&dy), &f64s(y)),
                None => f64s(&dy),
            };
            let expected = reference::$backward($grid, &f64s(&x), &f64s(&weight), &gated);
            let (mut dx, mut dweight) = (vec![f32::NAN; x.len()], vec![f32::NAN; weight.len()]);
            let mut dbias = vec![f32::NAN; $outputs];
            let source = $crate::GradientSource {
                weight: &weight,
                y: gate,
                dy: &dy,
            };
            let target = $crate::GradientTarget {
                dx: Some(&mut dx[..]),
                dweight: &mut dweight,
                dbias: &mut dbias,
            };
            backward($isa, $grid, &x, source, target);
            assert_close(&format!("{} dx", $name), &dx, &expected.dx);
            assert_close(&format!("{} dweight", $name), &dweight, &expected.dweight);
            assert_close(&format!("{} dbias", $name), &dbias, &expected.dbias);
        }
    };
}
pub(crate) use assert_equals_reference;
