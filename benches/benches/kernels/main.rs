//! Speed of every kernel of `demc-kernels` at the sizes of a training step (batch 4 of 128 x 128).
//!
//! The bench reports GFLOP/s relative to a matrix product, or GB/s relative to a copy, each pair
//! measured in turns.
//!
//! ```sh
//! cargo bench -p demc-bench --bench kernels              # base width 32, all kernels
//! cargo bench -p demc-bench --bench kernels -- 64 conv3x3
//! ```
//!
//! Arguments: a number is the base width, another word a part of kernel names, `rounds=N` the
//! number of rounds. `DEMC_ISA` selects the instructions, `RAYON_NUM_THREADS` the threads.
//!
//! The matrix product is that of the `gemm` crate through Burn, at the fastest of three sizes. The
//! copy moves 64 MiB on all threads. Winograd convolutions count the multiplications of the plain
//! sum, so their share can exceed 100 %.

mod peak;

use demc_bench::stopwatch::{Spread, interleaved};
use demc_kernels::batch_norm::{BatchNorm, BatchNormSource, Moments};
use demc_kernels::rel_mse::RelMse;
use demc_kernels::{Convolution, GradientSource, GradientTarget};
use demc_kernels::{Grid, Isa, adam, batch_norm, conv1x1, conv3x3, deconv4x4, grid, pool, rel_mse};
use peak::Peak;
use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;

#[global_allocator]
static ALLOCATOR: demc_model::ops::Recycler = demc_model::ops::Recycler;

const BATCH: usize = 4;
const PATCH: usize = 128;
const ROUNDS: usize = 7;
const EPSILON: f32 = 1e-3;
/// Channels of the encoder's levels, in base widths (Fig. 3).
const FACTORS: [usize; 5] = [1, 2, 4, 8, 8];

fn main() {
    let options = Options::read();
    let isa = Isa::current();
    let mut bench = Bench {
        peak: Peak::measure(),
        isa,
        options,
    };
    println!(
        "{isa}, {} threads; matrix product {:.0} GFLOP/s ({}^3), copy {:.1} GB/s\n",
        rayon::current_num_threads(),
        bench.peak.flops / 1e9,
        bench.peak.side,
        bench.peak.bytes / 1e9
    );
    println!(
        "{:<44} {:>9} {:>16} {:>26}",
        "kernel", "ms", "rate", "share of the peak (range)"
    );
    bench.convolutions();
    bench.fusions();
    bench.deconvolutions();
    bench.pools();
    bench.norms();
    bench.losses();
    bench.adam();
    bench.layouts();
}

struct Options {
    width: usize,
    rounds: usize,
    words: Vec<String>,
}

impl Options {
    fn read() -> Self {
        let mut options = Options {
            width: 32,
            rounds: ROUNDS,
            words: Vec::new(),
        };
        // `cargo bench` adds `--bench`.
        for word in std::env::args().skip(1).filter(|word| word != "--bench") {
            match (word.parse(), word.strip_prefix("rounds=").map(str::parse)) {
                (Ok(width), _) => options.width = width,
                (_, Some(Ok(rounds))) => options.rounds = rounds,
                _ => options.words.push(word),
            }
        }
        options
    }
}

/// The work of a kernel, which determines its rate.
#[derive(Clone, Copy)]
enum Work {
    /// Floating point operations; a multiplication and an addition count as two.
    Flops(f64),
    /// Bytes read and written.
    Bytes(f64),
}

struct Bench {
    peak: Peak,
    isa: Isa,
    options: Options,
}

impl Bench {
    /// Measures one kernel in turns with the peak, and prints a line.
    fn run(&mut self, name: &str, work: Work, mut kernel: impl FnMut(Isa)) {
        if !self.options.words.is_empty() && !self.options.words.iter().any(|w| name.contains(w)) {
            return;
        }
        let (isa, rounds) = (self.isa, self.options.rounds);
        let mut kernel = || kernel(isa);
        let peak = &mut self.peak;
        let [own, other] = match work {
            Work::Flops(_) => interleaved(rounds, [&mut kernel, &mut || peak.product()]),
            Work::Bytes(_) => interleaved(rounds, [&mut kernel, &mut || peak.copy()]),
        };
        let (done, done_by_peak, unit) = match work {
            Work::Flops(flops) => (flops, peak.operations(), "GFLOP/s"),
            Work::Bytes(bytes) => (bytes, peak.copied(), "GB/s"),
        };
        let Spread { min, median, max } = other.ratio(&own);
        let share = |ratio: f64| 100.0 * ratio * done / done_by_peak;
        let best = own.spread().min;
        println!(
            "{name:<44} {:>9.3} {:>8.1} {unit:<7} {:>12.0} % ({:.0}-{:.0})",
            1e3 * best,
            done / best / 1e9,
            share(median),
            share(min),
            share(max)
        );
    }

    /// The 3x3 convolutions of every level, of the first and last layers, and of the fusion.
    fn convolutions(&mut self) {
        let c = self.options.width;
        let mut sizes = vec![(3, c, 1), (12, c, 1), (c, 3, 1)];
        for (level, factor) in FACTORS.into_iter().enumerate() {
            sizes.push((factor * c, factor * c, 1 << level));
        }
        sizes.push((c, 2 * c, 2));
        sizes.push((8 * c, 8 * c, 32));
        for (inputs, outputs, down) in sizes {
            let grid = grid_at(down);
            let pixels = grid.pixels();
            let (x, weight) = (draw(pixels * inputs), draw(outputs * inputs * 9));
            let (bias, mut y) = (draw(outputs), draw(pixels * outputs));
            let flops = 18.0 * (pixels * inputs * outputs) as f64;
            let size = format!("{inputs} -> {outputs} at {0} x {0}", PATCH / down);
            let convolution = Convolution::rectified(&weight, &bias);
            self.run(
                &format!("conv3x3 forward {size}"),
                Work::Flops(flops),
                |isa| conv3x3::forward(isa, grid, &x, convolution, &mut y),
            );
            let dy = draw(pixels * outputs);
            let (mut dx, mut dw, mut db) = (x.clone(), weight.clone(), bias.clone());
            let source = GradientSource::rectified(&weight, &y, &dy);
            self.run(
                &format!("conv3x3 backward {size}"),
                Work::Flops(2.0 * flops),
                |isa| {
                    let target = GradientTarget {
                        dx: Some(&mut dx[..]),
                        dweight: &mut dw,
                        dbias: &mut db,
                    };
                    conv3x3::backward(isa, grid, &x, source, target);
                },
            );
        }
    }

    /// The 1x1 fusions of three inputs.
    fn fusions(&mut self) {
        for (level, factor) in FACTORS.into_iter().enumerate() {
            let (k, grid) = (factor * self.options.width, grid_at(1 << level));
            let pixels = grid.pixels();
            let inputs = [(); 3].map(|()| draw(pixels * k));
            let xs = [&inputs[0][..], &inputs[1], &inputs[2]];
            let (weight, bias, mut y) = (draw(k * 3 * k), draw(k), draw(pixels * k));
            let flops = 6.0 * (pixels * k * k) as f64;
            let size = format!("3 x {k} -> {k} at {0} x {0}", PATCH >> level);
            let convolution = Convolution::rectified(&weight, &bias);
            self.run(
                &format!("conv1x1 forward {size}"),
                Work::Flops(flops),
                |isa| conv1x1::forward(isa, grid, &xs, convolution, &mut y),
            );
            let dy = draw(pixels * k);
            let [mut a, mut b, mut c] = inputs.clone();
            let (mut dw, mut db) = (weight.clone(), bias.clone());
            let source = GradientSource::rectified(&weight, &y, &dy);
            self.run(
                &format!("conv1x1 backward {size}"),
                Work::Flops(2.0 * flops),
                |isa| {
                    let mut dxs = [Some(&mut a[..]), Some(&mut b[..]), Some(&mut c[..])];
                    let target = GradientTarget {
                        dx: &mut dxs[..],
                        dweight: &mut dw,
                        dbias: &mut db,
                    };
                    conv1x1::backward(isa, grid, &xs, source, target);
                },
            );
        }
    }

    /// The five deconvolutions, the deepest first.
    fn deconvolutions(&mut self) {
        let c = self.options.width;
        for (level, [inputs, outputs]) in [[8, 8], [8, 8], [8, 4], [4, 2], [2, 1]]
            .into_iter()
            .enumerate()
        {
            let (inputs, outputs, grid) = (inputs * c, outputs * c, grid_at(32 >> level));
            let (small, large) = (grid.pixels(), grid.doubled().pixels());
            let (x, weight) = (draw(small * inputs), draw(inputs * outputs * 16));
            let (bias, mut y) = (draw(outputs), draw(large * outputs));
            let flops = 32.0 * (small * inputs * outputs) as f64;
            let size = format!("{inputs} -> {outputs} from {0} x {0}", grid.height);
            let convolution = Convolution::rectified(&weight, &bias);
            self.run(
                &format!("deconv4x4 forward {size}"),
                Work::Flops(flops),
                |isa| deconv4x4::forward(isa, grid, &x, convolution, &mut y),
            );
            let dy = draw(large * outputs);
            let (mut dx, mut dw, mut db) = (x.clone(), weight.clone(), bias.clone());
            let source = GradientSource::rectified(&weight, &y, &dy);
            self.run(
                &format!("deconv4x4 backward {size}"),
                Work::Flops(2.0 * flops),
                |isa| {
                    let target = GradientTarget {
                        dx: Some(&mut dx[..]),
                        dweight: &mut dw,
                        dbias: &mut db,
                    };
                    deconv4x4::backward(isa, grid, &x, source, target);
                },
            );
        }
    }

    fn pools(&mut self) {
        let (c, grid) = (self.options.width, grid_at(1));
        let values = grid.pixels() * c;
        let x = draw(values);
        let (mut y, dy, mut dx) = (draw(values / 4), draw(values / 4), draw(values));
        let (forward, backward) = (bytes(values + values / 4), bytes(2 * values + values / 4));
        self.run(&format!("pool forward {c} at full size"), forward, |isa| {
            pool::forward(isa, grid, &x, &mut y);
        });
        self.run(
            &format!("pool backward {c} at full size"),
            backward,
            |isa| {
                pool::backward(isa, grid, &x, &dy, &mut dx);
            },
        );
    }

    fn norms(&mut self) {
        let c = self.options.width;
        let values = grid_at(1).pixels() * c;
        let (x, gamma, beta) = (draw(values), draw(c), draw(c));
        let (mut y, mut mean, mut variance) = (draw(values), draw(c), draw(c));
        // The map is read once for the statistics and once for normalisation.
        self.run(
            &format!("batch norm forward {c} at full size"),
            bytes(3 * values),
            |isa| {
                batch_norm::forward_train(
                    isa,
                    &x,
                    BatchNorm {
                        gamma: &gamma,
                        beta: &beta,
                        epsilon: EPSILON,
                        relu: true,
                    },
                    &mut y,
                    Moments {
                        mean: &mut mean,
                        variance: &mut variance,
                    },
                );
            },
        );
        let (dy, mut dx, mut dgamma, mut dbeta) = (draw(values), draw(values), draw(c), draw(c));
        // Twice x, y and dy, then dx.
        self.run(
            &format!("batch norm backward {c} at full size"),
            bytes(7 * values),
            |isa| {
                let source = BatchNormSource {
                    x: &x,
                    gamma: &gamma,
                    moments: Moments {
                        mean: &mean,
                        variance: &variance,
                    },
                    epsilon: EPSILON,
                    y: Some(&y),
                    dy: &dy,
                };
                batch_norm::backward(isa, source, &mut dx, &mut dgamma, &mut dbeta);
            },
        );
    }

    fn losses(&mut self) {
        let pixels = grid_at(1).pixels();
        let (out, reference) = (draw(3 * pixels), draw(3 * pixels));
        let mut dout = out.clone();
        self.run("rel_mse with gradient", bytes(9 * pixels), |isa| {
            let scale = RelMse {
                pixels,
                gamma: 2.2,
                epsilon: EPSILON,
            };
            rel_mse::loss(isa, &out, &reference, scale, Some(&mut dout[..]));
        });
    }

    fn adam(&mut self) {
        // About the size of the whole network: 42.9 million at width 64.
        let values = 10_463 * self.options.width.pow(2);
        let rule = adam::Adam {
            lr: 1e-4,
            beta_1: 0.9,
            beta_2: 0.999,
            epsilon: 1e-8,
        };
        let (mut weight, grad) = (draw(values), draw(values));
        let (mut first, mut second) = (draw(values), draw(values));
        // Reads four, writes three.
        self.run(
            &format!("adam step of {values} weights"),
            bytes(7 * values),
            |isa| {
                let weight = adam::AdamWeight {
                    weight: &mut weight,
                    first: &mut first,
                    second: &mut second,
                };
                adam::step(isa, &rule, 1, weight, &grad);
            },
        );
    }

    fn layouts(&mut self) {
        let (c, grid) = (self.options.width, grid_at(1));
        let values = grid.pixels() * c;
        let (x, mut y) = (draw(values), draw(values));
        let name = format!("NHWC from NCHW {c} at full size");
        self.run(&name, bytes(2 * values), |_| {
            grid::nhwc_from_nchw(grid, &x, &mut y);
        });
        let name = format!("NCHW from NHWC {c} at full size");
        self.run(&name, bytes(2 * values), |_| {
            grid::nchw_from_nhwc(grid, &x, &mut y);
        });
    }
}

/// The grid of the batch, `down` times smaller than a patch.
fn grid_at(down: usize) -> Grid {
    Grid {
        batch: BATCH,
        height: PATCH / down,
        width: PATCH / down,
    }
}

fn draw(len: usize) -> Vec<f32> {
    let mut rng = ChaCha8Rng::seed_from_u64(len as u64);
    (0..len).map(|_| rng.random_range(1e-3..1.0)).collect()
}

fn bytes(values: usize) -> Work {
    Work::Bytes(4.0 * values as f64)
}
