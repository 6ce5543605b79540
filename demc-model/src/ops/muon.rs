//! Muon's step on one kernel (Jordan et al. 2024, "Muon: An optimizer for hidden layers in neural networks").
//!
//! The gradient's running sum, as a matrix with a row for each output, gives way to the nearest matrix with orthogonal rows: every direction in
//! which the kernel can move is gone as far as any other, not only those few that own the gradient. The arithmetic is Burn's on every
//! device (five Newton-Schulz iterations); momentum is kept here, because Burn's cannot be read back for a checkpoint.

use burn::optim::momentum::MomentumConfig;
use burn::optim::{AdjustLrFn, MuonConfig, Optimizer};
use burn::tensor::Tensor;

use crate::weights::{fan_in, is_deconvolution, outputs};

/// What a step keeps of the sum of gradients (Jordan et al.'s).
const MOMENTUM: f64 = 0.95;

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
    let rule = MuonConfig::new()
        .with_momentum(MomentumConfig {
            momentum: 0.0,
            dampening: 0.0,
            nesterov: false,
        })
        .with_adjust_lr_fn(AdjustLrFn::MatchRmsAdamW)
        .build();
    let (matrix, ahead) = (layout.matrix(kernel.reshape([-1])), layout.matrix(ahead));
    let (stepped, _) = rule.step::<2>(lr * share.sqrt(), matrix, ahead, None);
    (layout.values(stepped).reshape(shape), velocity)
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
    use burn::tensor::{Device, TensorData};

    fn tensor<const D: usize>(shape: [usize; D], values: &[f32]) -> Tensor<D> {
        Tensor::from_data(TensorData::new(values.to_vec(), shape), &Device::flex())
    }

    fn host<const D: usize>(tensor: &Tensor<D>) -> Vec<f32> {
        tensor.to_data().try_to_vec().unwrap()
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
