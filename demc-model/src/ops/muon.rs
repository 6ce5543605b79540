//! Muon's step on one kernel (Jordan et al. 2024, "Muon: An optimizer for hidden layers in neural
//! networks").
//!
//! The momentum of the gradient forms a matrix with one row per output. A step goes along the
//! nearest matrix with orthogonal rows, so that every direction in the kernel's space moves equally
//! far.
//!
//! A test compares the step with Burn's `Muon`. Two things differ. The momentum is a value of the
//! caller, because Burn's cannot be read back for a checkpoint. The iterations multiply the Gram
//! matrix of the rows, which is small, instead of the matrix, which is much wider.

use burn::tensor::Tensor;

use crate::weights::{Role, WeightSpec};

/// Decay of the momentum per step (Jordan et al.).
const MOMENTUM: f64 = 0.95;

/// Number of Newton-Schulz iterations (Jordan et al.).
const ITERATIONS: usize = 5;

/// The coefficients `a`, `b` and `c` of an iteration (Jordan et al.).
const COEFFICIENTS: [f64; 3] = [3.4445, -4.775, 2.0315];

/// Smallest norm that a matrix is divided by (Burn).
const LEAST_NORM: f64 = 1e-7;

/// Root mean square of a step at learning rate 1 (Liu et al. 2025, "Muon is scalable for LLM
/// training", Eq. 4).
const ROOT_MEAN_SQUARE: f64 = 0.2;

/// The kernel and its momentum after one step at learning rate `lr`. `velocity` is the momentum,
/// flattened; `None` before the first step.
///
/// The root mean square of the step is about `lr / 5`, as for Adam, so that both use the same rates
/// (Liu et al. 2025, Sec. 2.2). A deconvolution counts 4 of
/// its 16 taps, the number that reaches one output.
///
/// # Shapes
/// Kernel and gradient have the shape of `spec`: `[out, in, h, w]`, of a deconvolution
/// `[in, out, h, w]`.
///
/// # Panics
/// If `spec` is not a kernel.
pub fn step<const D: usize>(
    spec: &WeightSpec,
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
    // Nesterov's momentum: the gradient counts as it will after the next decay.
    let ahead = velocity.clone().mul_scalar(MOMENTUM) + grad;
    let layout = MatrixLayout::new(spec);
    let share = spec.fan_in() as f64 / layout.columns as f64;
    let longer = layout.rows.max(layout.columns) as f64;
    let length = lr * ROOT_MEAN_SQUARE * (longer * share).sqrt();
    let change = layout.values(orthogonal(layout.matrix(ahead), length));
    (kernel - change.reshape(shape), velocity)
}

/// The nearest matrix with orthogonal rows (or columns, if there are fewer of them), times
/// `length`.
///
/// An iteration (Jordan et al.) replaces `X` by `Q X` with `Q = a + b A + c A^2` and `A = X X^T`.
/// The result is the product of all `Q` times the first `X`, and each iteration replaces `A` by
/// `Q A Q`. `X` has about ten times as many columns as rows; it is multiplied only before the first
/// and after the last iteration.
fn orthogonal(x: Tensor<2>, length: f64) -> Tensor<2> {
    let [rows, columns] = x.dims();
    if rows > columns {
        return orthogonal(x.transpose(), length).transpose();
    }
    let norm = (x.clone() * x.clone())
        .sum()
        .sqrt()
        .clamp_min(LEAST_NORM)
        .unsqueeze::<2>();
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

#[derive(Clone, Copy)]
struct MatrixLayout {
    rows: usize,
    columns: usize,
    /// Inputs and taps of a deconvolution, whose outputs are the second axis.
    deconvolution: Option<[usize; 2]>,
}

impl MatrixLayout {
    fn new(spec: &WeightSpec) -> Self {
        let shape = &spec.shape;
        let Some(rows) = spec.rows() else {
            panic!("{} is not a kernel", spec.name)
        };
        MatrixLayout {
            rows,
            columns: spec.len() / rows,
            deconvolution: (spec.role == Role::Deconvolution)
                .then(|| [shape[0], shape[2] * shape[3]]),
        }
    }

    fn matrix(self, values: Tensor<1>) -> Tensor<2> {
        let MatrixLayout { rows, columns, .. } = self;
        match self.deconvolution {
            Some([inputs, taps]) => values
                .reshape([inputs, rows, taps])
                .swap_dims(0, 1)
                .reshape([rows, columns]),
            None => values.reshape([rows, columns]),
        }
    }

    fn values(self, matrix: Tensor<2>) -> Tensor<1> {
        match self.deconvolution {
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
    use crate::weights::Stage;
    use burn::optim::momentum::MomentumConfig;
    use burn::optim::{AdjustLrFn, MuonConfig, Optimizer};
    use burn::tensor::{Device, TensorData};

    fn tensor<const D: usize>(shape: [usize; D], values: &[f32]) -> Tensor<D> {
        Tensor::from_data(TensorData::new(values.to_vec(), shape), &Device::flex())
    }

    fn spec(role: Role, shape: [usize; 4]) -> WeightSpec {
        WeightSpec {
            name: "layer.weight".into(),
            shape: shape.to_vec(),
            role,
            stage: Stage::Latent,
        }
    }

    fn host<const D: usize>(tensor: &Tensor<D>) -> Vec<f32> {
        tensor.to_data().try_to_vec().unwrap()
    }

    /// Wide and tall matrices whose rows differ by a tenth. The tolerance is a thousandth of the
    /// largest value.
    #[test]
    fn steps_agree_with_burns_muon() {
        let none = MomentumConfig {
            momentum: 0.0,
            dampening: 0.0,
            nesterov: false,
        };
        let muon_of_burn = MuonConfig::new()
            .with_momentum(none)
            .with_adjust_lr_fn(AdjustLrFn::MatchRmsAdamW)
            .build();
        for [outputs, inputs] in [[32, 32], [64, 3], [3, 32]] {
            let shape = [outputs, inputs, 3, 3];
            let columns = inputs * 9;
            let values: Vec<f32> = (0..outputs * columns)
                .map(|i| {
                    let noise = (i as f32 * 12.9898).sin() * 43758.547;
                    ((i % columns) as f32 * 0.31).sin() + 0.1 * noise.fract()
                })
                .collect();
            let zero = || Tensor::zeros([outputs, columns], &Device::flex());
            let grad = tensor([outputs, columns], &values);
            // Nesterov's momentum is 1.95 gradients at the first step.
            let (expected, _) = muon_of_burn.step::<2>(1.0, zero(), grad.mul_scalar(1.95), None);
            let (stepped, _) = step(
                &spec(Role::Convolution, shape),
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

    /// Rows without a common column are orthogonal. The nearest orthogonal matrix divides each row
    /// by its length, here 1, 0.1 and 0.01. Five iterations give lengths from 0.68 to 1.13.
    fn rows_of_any_length_move_equally_far(
        role: Role,
        shape: [usize; 4],
        place: fn(usize, usize) -> usize,
    ) {
        let spec = spec(role, shape);
        let (rows, taps, lr) = (3, shape[2] * shape[3], 0.01);
        let count = shape.iter().product();
        let mut grad = vec![0.0; count];
        let lengths = [1.0, -0.1, 0.01];
        for (row, length) in lengths.into_iter().enumerate() {
            grad[place(row, taps)] = length;
        }
        let zero = Tensor::zeros(shape, &Device::flex());
        let (stepped, _) = step(&spec, lr, zero, tensor(shape, &grad), None);
        let stepped = host(&stepped);
        let columns = (count / rows).max(rows) as f64;
        let share = spec.fan_in() as f64 / (count / rows) as f64;
        let whole = 0.2 * (columns * share).sqrt() * lr;
        for (i, (moved, grad)) in stepped.iter().zip(&grad).enumerate() {
            let moved = -f64::from(*moved) / whole;
            if *grad == 0.0 {
                assert!(moved.abs() < 1e-5, "{role:?} {i}: {moved}")
            } else {
                let moved = moved * f64::from(grad.signum());
                assert!((0.6..1.2).contains(&moved), "{role:?} {i}: {moved}");
            }
        }
    }

    #[test]
    fn outputs_of_a_convolution_move_equally_far() {
        rows_of_any_length_move_equally_far(Role::Convolution, [3, 4, 3, 3], |row, taps| {
            (row * 4 + row) * taps + 2 * row
        });
    }

    #[test]
    fn outputs_of_a_deconvolution_move_equally_far() {
        rows_of_any_length_move_equally_far(Role::Deconvolution, [4, 3, 4, 4], |row, taps| {
            ((row + 1) * 3 + row) * taps + 5 * row
        });
    }

    /// A gradient with equal rows is one direction. The step along it has the length of one row,
    /// whatever the number of outputs.
    #[test]
    fn a_direction_that_all_outputs_share_counts_once() {
        let shape = [4, 1, 3, 3];
        let grad: Vec<f32> = (0..36).map(|i| 1.0 + (i % 9) as f32).collect();
        let zero = Tensor::zeros(shape, &Device::flex());
        let (stepped, _) = step(
            &spec(Role::Convolution, shape),
            1.0,
            zero,
            tensor(shape, &grad),
            None,
        );
        let square: f32 = host(&stepped).iter().map(|v| v * v).sum();
        let whole = 0.2 * 9f32.sqrt();
        assert!((0.6..1.2).contains(&(square.sqrt() / whole)), "{square}");
    }

    #[test]
    fn momentum_continues_along_earlier_gradients() {
        let shape = [2, 1, 3, 3];
        let values: Vec<f32> = (0..18).map(|i| (i as f32 * 0.7).sin()).collect();
        let zero = || Tensor::<4>::zeros(shape, &Device::flex());
        let (first, velocity) = step(
            &spec(Role::Convolution, shape),
            1.0,
            zero(),
            tensor(shape, &values),
            None,
        );
        assert_eq!(host(&velocity), values);
        let (second, velocity) = step(
            &spec(Role::Convolution, shape),
            1.0,
            zero(),
            zero(),
            Some(velocity),
        );
        for (a, b) in host(&velocity).iter().zip(&values) {
            assert!((a - 0.95 * b).abs() < 1e-6);
        }
        for (a, b) in host(&first).iter().zip(host(&second)) {
            assert!((a - b).abs() < 1e-4, "{a} {b}");
        }
    }
}
