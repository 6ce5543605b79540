//! Convolutions give the same bits on any number of threads, on every instruction path.

use demc_kernels::{
    Convolution, GradientSource, GradientTarget, Grid, Isa, conv1x1, conv3x3, deconv4x4,
};

fn pattern(len: usize, seed: u32) -> Vec<f32> {
    let mut state = seed.wrapping_mul(2654435769);
    let next = || {
        state = state.wrapping_mul(1664525).wrapping_add(1013904223);
        (state >> 8) as f32 / (1 << 23) as f32 - 1.0
    };
    std::iter::repeat_with(next).take(len).collect()
}

fn on_threads<T: Send>(threads: usize, run: impl FnOnce() -> T + Send) -> T {
    let pool = rayon::ThreadPoolBuilder::new()
        .num_threads(threads)
        .build()
        .expect("threads");
    pool.install(run)
}

/// Asserts that `run` returns the same bits on 1, 2, 3 and 5 threads, on every path.
fn assert_same(name: &str, run: impl Fn(Isa) -> Vec<Vec<f32>> + Sync) {
    for isa in Isa::available() {
        let bits = |threads| -> Vec<u32> {
            let results = on_threads(threads, || run(isa));
            results.iter().flatten().map(|x| x.to_bits()).collect()
        };
        let expected = bits(1);
        for threads in [2, 3, 5] {
            assert!(
                bits(threads) == expected,
                "{name}, {isa}: {threads} threads differ from 1"
            );
        }
    }
}

/// Large enough for several tasks of every kind.
const GRID: Grid = Grid {
    batch: 2,
    height: 37,
    width: 45,
};

macro_rules! convolution_gives_the_same {
    ($kernel:ident, $inputs:expr, $outputs:expr, $taps:expr, $pixels:expr) => {
        let x = pattern(GRID.pixels() * $inputs, 1);
        let (weight, bias) = (pattern($outputs * $inputs * $taps, 2), pattern($outputs, 3));
        let dy = pattern($pixels * $outputs, 4);
        let name = format!("{} {} to {}", stringify!($kernel), $inputs, $outputs);
        assert_same(&name, |isa| {
            let mut y = vec![0.0; dy.len()];
            $kernel::forward(
                isa,
                GRID,
                &x,
                Convolution::rectified(&weight, &bias),
                &mut y,
            );
            let mut dx = vec![0.0; x.len()];
            let (mut dweight, mut dbias) = (vec![0.0; weight.len()], vec![0.0; $outputs]);
            let source = GradientSource::rectified(&weight, &y, &dy);
            let target = GradientTarget {
                dx: Some(&mut dx[..]),
                dweight: &mut dweight,
                dbias: &mut dbias,
            };
            $kernel::backward(isa, GRID, &x, source, target);
            vec![y, dx, dweight, dbias]
        });
    };
}

#[test]
fn conv3x3_of_every_kind() {
    for (inputs, outputs) in [(3, 16), (16, 3), (24, 40)] {
        convolution_gives_the_same!(conv3x3, inputs, outputs, 9, GRID.pixels());
    }
}

#[test]
fn conv1x1_gives_the_same() {
    let (inputs, outputs) = ([16, 17], 20);
    let xs = inputs.map(|channels| pattern(GRID.pixels() * channels, channels as u32));
    let (weight, bias) = (pattern(outputs * 33, 2), pattern(outputs, 3));
    let dy = pattern(GRID.pixels() * outputs, 4);
    assert_same("conv1x1", |isa| {
        let views = [&xs[0][..], &xs[1][..]];
        let mut y = vec![0.0; dy.len()];
        conv1x1::forward(
            isa,
            GRID,
            &views,
            Convolution::rectified(&weight, &bias),
            &mut y,
        );
        let mut dxs = [vec![0.0; xs[0].len()], vec![0.0; xs[1].len()]];
        let (mut dweight, mut dbias) = (vec![0.0; weight.len()], vec![0.0; outputs]);
        let [first, second] = &mut dxs;
        conv1x1::backward(
            isa,
            GRID,
            &views,
            GradientSource::rectified(&weight, &y, &dy),
            GradientTarget {
                dx: &mut [Some(first), Some(second)],
                dweight: &mut dweight,
                dbias: &mut dbias,
            },
        );
        let [first, second] = dxs;
        vec![y, first, second, dweight, dbias]
    });
}

#[test]
fn deconv4x4_gives_the_same() {
    convolution_gives_the_same!(deconv4x4, 20, 17, 16, GRID.doubled().pixels());
}
