//! Muon's step on one kernel (Jordan et al. 2024, "Muon: An optimizer for hidden layers in neural networks").
//!
//! The gradient's running sum, as a matrix with a row for each output, gives way to the nearest matrix with orthogonal rows: every direction in
//! which the kernel can move is gone as far as any other, not only those few that own the gradient. It is Burn's `Muon`, which a test holds
//! it against, but for two things: momentum is kept here, because Burn's cannot be read back for a checkpoint, and the iterations are on
//! the products of rows, which are small, in place of the matrix, which is many times as wide.

use burn::tensor::Tensor;

use crate::weights::{fan_in, is_deconvolution, outputs};

/// What a step keeps of the sum of gradients (Jordan et al.'s).
const MOMENTUM: f64 = 0.95;

/// Newton-Schulz iterations (Jordan et al.'s).
const ITERATIONS: usize = 5;

/// The coefficients `a`, `b` and `c` of one (Jordan et al.'s).
const COEFFICIENTS: [f64; 3] = [3.4445, -4.775, 2.0315];

/// Least norm that a matrix is divided by (Burn's).
const LEAST_NORM: f64 = 1e-7;

/// Root mean square of a step at a rate of one (Liu et al. 2025, Eq. 4).
const ROOT_MEAN_SQUARE: f64 = 0.2;

/// The kernel `name` after a step, with the sum of its gradients so far, flattened; `None` before the first step.
///
/// The root mean square of the step is about a fifth of `lr`, as Adam's is (Liu et al. 2025, "Muon is scalable for LLM training",
/// Sec. 2.2), so that both learn at the same rates; a deconvolution counts the 4 taps of 16 that reach an output.
///
/// # Shapes
/// Kernel and gradient `[out, in, h, w]`, of a deconvolution `[in, out, h, w]`.
///
/// # Panics
/// Where they have not four axes.
pub fn step<const D: usize>(
    name: &str,
    lr: f64,
    kernel: Tensor<D>,
    grad: Tensor<D>,
    velocity: Option<Tensor<1>>,
) -> (Tensor<D>, Tensor<1>) {
    let shape = kernel.dims();
    let grad = grad.reshape([-1]);
    let velocity = match velocity {
        Some(velocity) => velocity.mul_scalar(MOMENTUM) + grad.clone(),
        None => grad.clone(),
    };
    // Nesterov's: the gradient as it will count in the sum after this one.
    let ahead = velocity.clone().mul_scalar(MOMENTUM) + grad;
    let layout = Layout::of(name, &shape);
    let share = fan_in(name, &shape) as f64 / layout.columns as f64;
    let longer = layout.rows.max(layout.columns) as f64;
    let length = lr * ROOT_MEAN_SQUARE * (longer * share).sqrt();
    let moved = layout.values(orthogonal(layout.matrix(ahead), length));
    (kernel - moved.reshape(shape), velocity)
}

/// The nearest matrix with orthogonal rows, or columns where they are fewer, times `length`.
///
/// An iteration (Jordan et al.) takes `X` to `Q X` with `Q = a + b A + c A^2` and `A = X X^T`. So `X` after all of them is a product of the
/// `Q`s times `X`, and `A` after one is `Q A Q`: all there is to do with `X` itself, which has some ten times as many columns as rows,
/// is `A` before the first and the product after the last.
fn orthogonal(x: Tensor<2>, length: f64) -> Tensor<2> {
    let [rows, columns] = x.dims();
    if rows > columns {
        return orthogonal(x.transpose(), length).transpose();
    }
    let norm = (x.clone() * x.clone()).sum().sqrt();
    let norm = norm.clamp_min(LEAST_NORM).unsqueeze::<2>();
    let x = x / norm;
    let identity = Tensor::<2>::eye(rows, &x.device());
    let [a, b, c] = COEFFICIENTS;
    let mut gram = x.clone().matmul(x.clone().transpose());
    let mut product = identity.clone().mul_scalar(length);
    for iteration in 1..=ITERATIONS {
        let square = gram.clone().matmul(gram.clone());
        let q = identity.clone().mul_scalar(a) + gram.clone().mul_scalar(b) + square.mul_scalar(c);
        product = q.clone().matmul(product);
        if iteration < ITERATIONS {
            gram = q.clone().matmul(gram).matmul(q);
        }
    }
    product.matmul(x)
}

/// How the values of a kernel lie in its matrix.
#[derive(Clone, Copy)]
struct Layout {
    rows: usize,
    columns: usize,
    /// Inputs and taps, where outputs are the second axis.
    turned: Option<[usize; 2]>,
}

impl Layout {
    fn of(name: &str, shape: &[usize]) -> Self {
        let Some(rows) = outputs(name, shape) else {
            panic!("{name} has {} axes, a kernel has four", shape.len())
        };
        Layout {
            rows,
            columns: shape.iter().product::<usize>() / rows,
            turned: is_deconvolution(name).then(|| [shape[0], shape[2] * shape[3]]),
        }
    }

    fn matrix(self, values: Tensor<1>) -> Tensor<2> {
        let Layout { rows, columns, .. } = self;
        match self.turned {
            Some([inputs, taps]) => values
                .reshape([inputs, rows, taps])
                .swap_dims(0, 1)
                .reshape([rows, columns]),
            None => values.reshape([rows, columns]),
        }
    }

    fn values(self, matrix: Tensor<2>) -> Tensor<1> {
        match self.turned {
            Some([inputs, taps]) => matrix
                .reshape([self.rows, inputs, taps])
                .swap_dims(0, 1)
                .reshape([-1]),
            None => matrix.reshape([-1]),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use burn::optim::momentum::MomentumConfig;
    use burn::optim::{AdjustLrFn, MuonConfig, Optimizer};
    use burn::tensor::{Device, TensorData};

    fn tensor<const D: usize>(shape: [usize; D], values: &[f32]) -> Tensor<D> {
        Tensor::from_data(TensorData::new(values.to_vec(), shape), &Device::flex())
    }

    fn host<const D: usize>(tensor: &Tensor<D>) -> Vec<f32> {
        tensor.to_data().try_to_vec().unwrap()
    }

    /// Wide and tall matrices, of rows that are alike but for a tenth: within a thousandth of the longest value.
    #[test]
    fn steps_are_those_of_burns_muon() {
        let none = MomentumConfig {
            momentum: 0.0,
            dampening: 0.0,
            nesterov: false,
        };
        let burns = MuonConfig::new()
            .with_momentum(none)
            .with_adjust_lr_fn(AdjustLrFn::MatchRmsAdamW)
            .build();
        for [outputs, inputs] in [[32, 32], [64, 3], [3, 32]] {
            let shape = [outputs, inputs, 3, 3];
            let columns = inputs * 9;
            let values: Vec<f32> = (0..outputs * columns)
                .map(|i| {
                    let own = (i as f32 * 12.9898).sin() * 43758.547;
                    ((i % columns) as f32 * 0.31).sin() + 0.1 * own.fract()
                })
                .collect();
            let zero = || Tensor::zeros([outputs, columns], &Device::flex());
            let grad = tensor([outputs, columns], &values);
            // Of its first step, Nesterov's 1.95 gradients.
            let (expected, _) = burns.step::<2>(1.0, zero(), grad.mul_scalar(1.95), None);
            let (stepped, _) = step(
                "a.conv.weight",
                1.0,
                zero().reshape(shape),
                tensor(shape, &values),
                None,
            );
            let expected = host(&expected);
            let longest = expected.iter().fold(0.0f32, |m, v| m.max(v.abs()));
            for (a, b) in host(&stepped).iter().zip(&expected) {
                assert!((a - b).abs() < 1e-3 * longest, "{shape:?}: {a} {b}");
            }
        }
    }

    /// Rows that share no column are orthogonal already: the nearest orthogonal matrix has each divided by its own length, be it a
    /// hundredth of another's. Five iterations take a length to between 0.68 and 1.13.
    fn rows_of_any_length_move_alike(
        name: &str,
        shape: [usize; 4],
        place: fn(usize, usize) -> usize,
    ) {
        let (rows, taps, lr) = (3, shape[2] * shape[3], 0.01);
        let count = shape.iter().product();
        let mut grad = vec![0.0; count];
        let lengths = [1.0, -0.1, 0.01];
        for (row, length) in lengths.into_iter().enumerate() {
            grad[place(row, taps)] = length;
        }
        let zero = Tensor::zeros(shape, &Device::flex());
        let (stepped, _) = step(name, lr, zero, tensor(shape, &grad), None);
        let stepped = host(&stepped);
        let columns = (count / rows).max(rows) as f64;
        let share = fan_in(name, &shape) as f64 / (count / rows) as f64;
        let whole = 0.2 * (columns * share).sqrt() * lr;
        for (i, (moved, grad)) in stepped.iter().zip(&grad).enumerate() {
            let moved = -f64::from(*moved) / whole;
            match *grad == 0.0 {
                true => assert!(moved.abs() < 1e-5, "{name} {i}: {moved}"),
                false => {
                    let moved = moved * f64::from(grad.signum());
                    assert!((0.6..1.2).contains(&moved), "{name} {i}: {moved}");
                }
            }
        }
    }

    #[test]
    fn outputs_of_a_convolution_move_alike() {
        rows_of_any_length_move_alike("a.conv.weight", [3, 4, 3, 3], |row, taps| {
            (row * 4 + row) * taps + 2 * row
        });
    }

    #[test]
    fn outputs_of_a_deconvolution_move_alike() {
        rows_of_any_length_move_alike("a.deconv.weight", [4, 3, 4, 4], |row, taps| {
            ((row + 1) * 3 + row) * taps + 5 * row
        });
    }

    /// Inputs of an output that are proportional in all rows are one direction: it is gone once, not by every output for itself.
    #[test]
    fn a_direction_that_all_outputs_share_is_gone_once() {
        let shape = [4, 1, 3, 3];
        let grad: Vec<f32> = (0..36).map(|i| 1.0 + (i % 9) as f32).collect();
        let zero = Tensor::zeros(shape, &Device::flex());
        let (stepped, _) = step("a.conv.weight", 1.0, zero, tensor(shape, &grad), None);
        let square: f32 = host(&stepped).iter().map(|v| v * v).sum();
        let whole = 0.2 * 9f32.sqrt();
        assert!((0.6..1.2).contains(&(square.sqrt() / whole)), "{square}");
    }

    #[test]
    fn steps_go_on_along_earlier_gradients() {
        let shape = [2, 1, 3, 3];
        let values: Vec<f32> = (0..18).map(|i| (i as f32 * 0.7).sin()).collect();
        let zero = || Tensor::<4>::zeros(shape, &Device::flex());
        let (first, velocity) = step("a.conv.weight", 1.0, zero(), tensor(shape, &values), None);
        assert_eq!(host(&velocity), values);
        let (second, velocity) = step("a.conv.weight", 1.0, zero(), zero(), Some(velocity));
        for (a, b) in host(&velocity).iter().zip(&values) {
            assert!((a - 0.95 * b).abs() < 1e-6);
        }
        for (a, b) in host(&first).iter().zip(host(&second)) {
            assert!((a - b).abs() < 1e-4, "{a} {b}");
        }
    }

    #[test]
    fn kernels_have_outputs() {
        assert_eq!(outputs("a.conv.weight", &[3, 4, 3, 3]), Some(3));
        assert_eq!(outputs("a.deconv.weight", &[3, 4, 4, 4]), Some(4));
        assert_eq!(outputs("a.conv.bias", &[3]), None);
    }
}
