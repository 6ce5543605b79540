//! Every operation checks the length of every slice before it accesses one, and states the expected
//! length.

use std::panic::{AssertUnwindSafe, catch_unwind};

use demc_kernels::adam::Adam;
use demc_kernels::adam::AdamWeight;
use demc_kernels::batch_norm::{BatchNorm, BatchNormSource, Moments};
use demc_kernels::conv3x3::{PreparedConvolution, Tile};
use demc_kernels::rel_mse::RelMse;
use demc_kernels::{
    Convolution, GradientSource, GradientTarget, Grid, Isa, adam, batch_norm, conv1x1, conv3x3,
    deconv4x4, grid, pool, rel_mse,
};

const GRID: Grid = Grid {
    batch: 1,
    height: 4,
    width: 6,
};
const P: usize = 24;

/// Runs an operation on zeroed slices of `lengths`, which match. Then makes each slice one value
/// longer or shorter; the operation must panic with a number in its message.
fn checks<const N: usize>(name: &str, lengths: [usize; N], run: impl Fn(Isa, [&mut [f32]; N])) {
    let panics = |isa, lengths: [usize; N]| {
        let mut slices = lengths.map(|len| vec![0.0f32; len]);
        let slices = slices.each_mut().map(Vec::as_mut_slice);
        let caught = catch_unwind(AssertUnwindSafe(|| run(isa, slices)));
        caught.err().map(|payload| {
            let words = payload.downcast_ref::<String>().cloned();
            words.unwrap_or_else(|| payload.downcast_ref::<&str>().expect("words").to_string())
        })
    };
    for isa in Isa::available() {
        assert_eq!(panics(isa, lengths), None, "{name} on {isa}");
        for index in 0..N {
            for wrong in [lengths[index] + 1, lengths[index] - 1] {
                let mut lengths = lengths;
                lengths[index] = wrong;
                let words = panics(isa, lengths);
                assert!(
                    words
                        .as_ref()
                        .is_some_and(|words| words.chars().any(|c| c.is_ascii_digit())),
                    "{name} on {isa}, slice {index} of {wrong} values: {words:?}"
                );
            }
        }
    }
}

fn norm<'a>(gamma: &'a [f32], beta: &'a [f32]) -> BatchNorm<'a> {
    BatchNorm {
        gamma,
        beta,
        epsilon: 1e-3,
        relu: true,
    }
}

#[test]
fn convolutions() {
    // Wide, few inputs, few outputs: each has its own kernel.
    for [i, o] in [[9, 10], [3, 9], [9, 3]] {
        let weight = 9 * i * o;
        for tile in [Tile::F2, Tile::F4] {
            checks(
                "conv3x3 forward",
                [P * i, weight, o, P * o],
                |isa, [x, w, b, y]| {
                    PreparedConvolution::new(isa, tile, Convolution::rectified(w, b))
                        .forward(GRID, x, 0, y);
                },
            );
        }
        checks(
            "conv3x3 backward",
            [P * i, weight, P * o, P * o, P * i, weight, o],
            |isa, [x, w, y, dy, dx, dw, db]| {
                conv3x3::backward(
                    isa,
                    GRID,
                    x,
                    GradientSource::rectified(w, y, dy),
                    GradientTarget {
                        dx: Some(dx),
                        dweight: dw,
                        dbias: db,
                    },
                );
            },
        );
    }
}

#[test]
fn deconvolution() {
    let (i, o) = (5, 3);
    let weight = 16 * i * o;
    checks(
        "deconv4x4 forward",
        [P * i, weight, o, 4 * P * o],
        |isa, [x, w, b, y]| {
            deconv4x4::forward(isa, GRID, x, Convolution::rectified(w, b), y);
        },
    );
    checks(
        "deconv4x4 backward",
        [P * i, weight, 4 * P * o, 4 * P * o, P * i, weight, o],
        |isa, [x, w, y, dy, dx, dw, db]| {
            deconv4x4::backward(
                isa,
                GRID,
                x,
                GradientSource::rectified(w, y, dy),
                GradientTarget {
                    dx: Some(dx),
                    dweight: dw,
                    dbias: db,
                },
            );
        },
    );
}

#[test]
fn fusion() {
    let (a, b, o) = (5, 2, 4);
    let weight = (a + b) * o;
    checks(
        "conv1x1 forward",
        [P * a, P * b, weight, o, P * o],
        |isa, [x, z, w, bias, y]| {
            conv1x1::forward(isa, GRID, &[x, z], Convolution::rectified(w, bias), y);
        },
    );
    checks(
        "conv1x1 backward",
        [P * a, P * b, weight, P * o, P * o, P * a, P * b, weight, o],
        |isa, [x, z, w, y, dy, dx, dz, dw, db]| {
            let inputs: [&[f32]; 2] = [x, z];
            let mut gradients = [Some(dx), Some(dz)];
            let target = GradientTarget {
                dx: &mut gradients[..],
                dweight: dw,
                dbias: db,
            };
            conv1x1::backward(
                isa,
                GRID,
                &inputs,
                GradientSource::rectified(w, y, dy),
                target,
            );
        },
    );
}

#[test]
fn pooling() {
    let channels = 3;
    let (x, y) = (P * channels, P / 4 * channels);
    checks("pool forward", [x, y], |isa, [x, y]| {
        pool::forward(isa, GRID, x, y)
    });
    checks("pool backward", [x, y, x], |isa, [x, dy, dx]| {
        pool::backward(isa, GRID, x, dy, dx)
    });
}

#[test]
fn batch_normalisation() {
    let (c, n) = (3, 3 * P);
    checks(
        "batch_norm forward_train",
        [n, c, c, n, c, c],
        |isa, [x, gamma, beta, y, mean, variance]| {
            batch_norm::forward_train(isa, x, norm(gamma, beta), y, Moments { mean, variance });
        },
    );
    checks(
        "batch_norm forward_eval",
        [n, c, c, c, c, n],
        |isa, [x, gamma, beta, mean, variance, y]| {
            let moments = Moments {
                mean: &*mean,
                variance: &*variance,
            };
            batch_norm::forward_eval(isa, x, norm(gamma, beta), moments, y);
        },
    );
    checks(
        "batch_norm backward",
        [n, c, c, c, n, n, n, c, c],
        |isa, [x, gamma, mean, variance, y, dy, dx, dgamma, dbeta]| {
            let source = BatchNormSource {
                x,
                gamma,
                moments: Moments { mean, variance },
                epsilon: 1e-3,
                y: Some(y),
                dy,
            };
            batch_norm::backward(isa, source, dx, dgamma, dbeta);
        },
    );
}

#[test]
fn loss_optimizer_and_layouts() {
    let n = 3 * P;
    checks("rel_mse", [n, n, n], |isa, [out, reference, dout]| {
        let scale = RelMse {
            pixels: P,
            gamma: 2.2,
            epsilon: 1e-3,
        };
        rel_mse::loss(isa, out, reference, scale, Some(dout));
    });
    let rule = Adam {
        beta_1: 0.9,
        beta_2: 0.999,
        epsilon: 1e-8,
        lr: 1e-3,
    };
    checks(
        "adam",
        [n, n, n, n],
        |isa, [weight, grad, first, second]| {
            let weight = AdamWeight {
                weight,
                first,
                second,
            };
            adam::step(isa, &rule, 1, weight, grad);
        },
    );
    checks("NHWC from NCHW", [n, n], |_, [x, y]| {
        grid::nhwc_from_nchw(GRID, x, y)
    });
    checks("NCHW from NHWC", [n, n], |_, [x, y]| {
        grid::nchw_from_nhwc(GRID, x, y)
    });
}
