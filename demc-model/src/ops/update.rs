//! Updates of one weight: Adam's step (Kingma and Ba 2014), the squared norm of its gradient, and
//! the moving average.
//!
//! The kernels update weights and moments in place, in one pass; Burn's operations return new
//! tensors.

use burn::backend::flex::FlexTensor;
use burn::backend::{Backend, Dispatch, Flex, backend_extension, tensor::FloatTensor};
use burn::optim::{AdamConfig, AdamState, AdaptiveMomentumState, Optimizer};
use burn::tensor::Tensor;
use demc_kernels::Isa;
use rayon::prelude::*;

use super::Ops;
use super::kernels::{contiguous, values};

/// Number of values whose squares one thread sums at a time. It is fixed, so that the sum does not
/// depend on the number of threads.
const CHUNK: usize = 1 << 16;

/// The constants of Adam.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct AdamConstants {
    /// Decay of the first moment.
    pub beta_1: f32,
    /// Decay of the second moment.
    pub beta_2: f32,
    /// Constant added to the root of the second moment.
    pub epsilon: f32,
}

/// Adam's moments of one weight, flattened.
#[derive(Clone, Debug)]
pub struct AdamMoments {
    /// Decaying mean of the gradient.
    pub first: Tensor<1>,
    /// Decaying mean of the gradient's square.
    pub second: Tensor<1>,
}

impl AdamConstants {
    /// A weight and its moments after one step at learning rate `lr`.
    ///
    /// `steps` is the number of steps taken before; without `moments` it is 0. The kernels work in
    /// place if nothing else holds the weight or the moments.
    ///
    /// # Shapes
    /// Weight and gradient of one shape `[...]`, moments flattened.
    pub fn step<const D: usize>(
        &self,
        ops: Ops,
        lr: f64,
        steps: u64,
        weight: Tensor<D>,
        grad: Tensor<D>,
        moments: Option<AdamMoments>,
    ) -> (Tensor<D>, AdamMoments) {
        match ops.on(&weight.device()) {
            Ops::Kernels => self.step_by_kernel(lr, steps, weight, grad, moments),
            Ops::Burn => self.step_by_burn(lr, steps, weight, grad, moments),
        }
    }

    fn step_by_kernel<const D: usize>(
        &self,
        lr: f64,
        steps: u64,
        weight: Tensor<D>,
        grad: Tensor<D>,
        moments: Option<AdamMoments>,
    ) -> (Tensor<D>, AdamMoments) {
        let AdamMoments { first, second } = moments.unwrap_or_else(|| {
            let zeros = || Tensor::zeros([weight.shape().num_elements()], &weight.device());
            AdamMoments {
                first: zeros(),
                second: zeros(),
            }
        });
        let constants = demc_kernels::adam::Adam {
            lr: lr as f32,
            beta_1: self.beta_1,
            beta_2: self.beta_2,
            epsilon: self.epsilon,
        };
        let (weight, first, second) = Dispatch::adam_step(
            weight.into_dispatch(),
            grad.into_dispatch(),
            first.into_dispatch(),
            second.into_dispatch(),
            constants,
            steps + 1,
        );
        let [first, second] = [first, second].map(Tensor::from_dispatch);
        (Tensor::from_dispatch(weight), AdamMoments { first, second })
    }

    fn step_by_burn<const D: usize>(
        &self,
        lr: f64,
        steps: u64,
        weight: Tensor<D>,
        grad: Tensor<D>,
        moments: Option<AdamMoments>,
    ) -> (Tensor<D>, AdamMoments) {
        let adam = AdamConfig::new()
            .with_beta_1(self.beta_1)
            .with_beta_2(self.beta_2)
            .with_epsilon(self.epsilon)
            .build();
        let state = moments.map(|AdamMoments { first, second }| {
            let time = usize::try_from(steps).expect("the number of steps fits into usize");
            AdamState::new(AdaptiveMomentumState::new(time, first, second))
        });
        let shape = weight.dims();
        let (stepped, state) = adam.step::<1>(lr, weight.reshape([-1]), grad.reshape([-1]), state);
        let momentum = state.expect("Adam returns a state").momentum;
        let moments = AdamMoments {
            first: momentum.moment_1,
            second: momentum.moment_2,
        };
        (stepped.reshape(shape), moments)
    }
}

/// The sum of squares over all tensors. The kernels sum each tensor in float64, Burn in float32.
///
/// # Shapes
/// Any number of flattened tensors of any length.
pub fn sum_of_squares(ops: Ops, tensors: Vec<Tensor<1>>) -> f64 {
    let Some(first) = tensors.first() else {
        return 0.0;
    };
    match ops.on(&first.device()) {
        Ops::Kernels => tensors
            .into_iter()
            .map(|tensor| Dispatch::sum_of_squares(tensor.into_dispatch()))
            .sum(),
        Ops::Burn => {
            // One transfer to the host for all tensors, where their sums are added in float64.
            let sums = tensors.into_iter().map(|tensor| tensor.square().sum());
            let sums = Tensor::cat(sums.collect(), 0)
                .into_data()
                .try_to_vec::<f32>()
                .expect("gradients are float32");
            sums.into_iter().map(f64::from).sum()
        }
    }
}

/// The moving average after an update: `average + share * (live - average)`. The kernels work in
/// place if nothing else holds the average.
///
/// # Shapes
/// Two tensors of one shape.
pub fn moving_average<const D: usize>(
    ops: Ops,
    average: Tensor<D>,
    live: Tensor<D>,
    share: f32,
) -> Tensor<D> {
    match ops.on(&average.device()) {
        Ops::Kernels => {
            let (average, live) = (average.into_dispatch(), live.into_dispatch());
            Tensor::from_dispatch(Dispatch::moving_average(average, live, share))
        }
        Ops::Burn => average.clone() + (live - average).mul_scalar(share),
    }
}

#[backend_extension(Flex)]
trait UpdateOps: Backend {
    /// Weight and moments after step number `step`, counted from 1.
    fn adam_step(
        weight: FloatTensor<Self>,
        grad: FloatTensor<Self>,
        first: FloatTensor<Self>,
        second: FloatTensor<Self>,
        constants: demc_kernels::adam::Adam,
        step: u64,
    ) -> (FloatTensor<Self>, FloatTensor<Self>, FloatTensor<Self>);
    fn sum_of_squares(x: FloatTensor<Self>) -> f64;
    /// The average, moved by `share` of its distance from `live`.
    fn moving_average(
        average: FloatTensor<Self>,
        live: FloatTensor<Self>,
        share: f32,
    ) -> FloatTensor<Self>;
}

impl UpdateOps for Flex {
    fn adam_step(
        weight: FlexTensor,
        grad: FlexTensor,
        first: FlexTensor,
        second: FlexTensor,
        constants: demc_kernels::adam::Adam,
        step: u64,
    ) -> (FlexTensor, FlexTensor, FlexTensor) {
        let grad = contiguous(grad);
        let [mut weight, mut first, mut second] = [weight, first, second].map(contiguous);
        // `storage_mut` copies a tensor that is also held elsewhere: by a checkpoint or the
        // caller's model.
        demc_kernels::adam::step(
            Isa::current(),
            &constants,
            step,
            demc_kernels::adam::AdamWeight {
                weight: weight.storage_mut(),
                first: first.storage_mut(),
                second: second.storage_mut(),
            },
            values(&grad),
        );
        (weight, first, second)
    }

    fn sum_of_squares(x: FlexTensor) -> f64 {
        let x = contiguous(x);
        let square = |v: &f32| f64::from(*v) * f64::from(*v);
        let chunks = values(&x).par_chunks(CHUNK);
        let sums: Vec<f64> = chunks.map(|c| c.iter().map(square).sum()).collect();
        sums.iter().sum()
    }

    fn moving_average(average: FlexTensor, live: FlexTensor, share: f32) -> FlexTensor {
        let [mut average, live] = [average, live].map(contiguous);
        let slice = average.storage_mut();
        demc_kernels::average::update(Isa::current(), slice, values(&live), share);
        average
    }
}
