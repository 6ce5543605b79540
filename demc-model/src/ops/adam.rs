//! Adam's step on one weight (Kingma and Ba 2014), and the norm of a gradient.
//!
//! The kernels update weight and moments where they lie, in one pass; Burn's arithmetic makes new tensors.

use burn::backend::flex::FlexTensor;
use burn::backend::{Backend, Dispatch, Flex, backend_extension, tensor::FloatTensor};
use burn::optim::{AdamConfig, AdamState, AdaptiveMomentumState, Optimizer};
use burn::tensor::Tensor;
use demc_kernels::Isa;
use rayon::prelude::*;

use super::Ops;
use super::kernels::slices::{contiguous, values};

/// Values whose squares one thread adds up at a time; fixed, so that the sum is the same on any number of threads.
const CHUNK: usize = 1 << 16;

/// The constants of Adam.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Rule {
    /// Decay of the first moment.
    pub beta_1: f32,
    /// Decay of the second moment.
    pub beta_2: f32,
    /// Added to the root of the second moment.
    pub epsilon: f32,
}

/// The moments of one weight, flattened.
#[derive(Clone, Debug)]
pub struct Moments {
    /// Decaying mean of the gradient.
    pub first: Tensor<1>,
    /// Decaying mean of its square.
    pub second: Tensor<1>,
}

impl Rule {
    /// One weight after a step at learning rate `lr`, with its moments; `steps` were taken before, 0 with no moments.
    ///
    /// In place where the kernels run and nobody else holds weight or moments.
    ///
    /// # Shapes
    /// Weight and gradient of any one shape, moments of as many values.
    pub fn step<const D: usize>(
        &self,
        ops: Ops,
        lr: f64,
        steps: u64,
        weight: Tensor<D>,
        grad: Tensor<D>,
        moments: Option<Moments>,
    ) -> (Tensor<D>, Moments) {
        match ops.on(&weight.device()) {
            Ops::Kernels => self.step_in_place(lr, steps, weight, grad, moments),
            Ops::Burn => self.step_of_burn(lr, steps, weight, grad, moments),
        }
    }

    fn step_in_place<const D: usize>(
        &self,
        lr: f64,
        steps: u64,
        weight: Tensor<D>,
        grad: Tensor<D>,
        moments: Option<Moments>,
    ) -> (Tensor<D>, Moments) {
        let Moments { first, second } = moments.unwrap_or_else(|| {
            let zeros = || Tensor::zeros([weight.shape().num_elements()], &weight.device());
            Moments {
                first: zeros(),
                second: zeros(),
            }
        });
        let rule = demc_kernels::adam::Adam {
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
            rule,
            steps + 1,
        );
        let [first, second] = [first, second].map(Tensor::from_dispatch);
        (Tensor::from_dispatch(weight), Moments { first, second })
    }

    fn step_of_burn<const D: usize>(
        &self,
        lr: f64,
        steps: u64,
        weight: Tensor<D>,
        grad: Tensor<D>,
        moments: Option<Moments>,
    ) -> (Tensor<D>, Moments) {
        let rule = AdamConfig::new()
            .with_beta_1(self.beta_1)
            .with_beta_2(self.beta_2)
            .with_epsilon(self.epsilon)
            .build();
        let state = moments.map(|Moments { first, second }| {
            let time = usize::try_from(steps).expect("fewer steps than addresses");
            AdamState::new(AdaptiveMomentumState::new(time, first, second))
        });
        let shape = weight.dims();
        let (stepped, state) = rule.step::<1>(lr, weight.reshape([-1]), grad.reshape([-1]), state);
        let momentum = state.expect("Adam always has a state").momentum;
        let moments = Moments {
            first: momentum.moment_1,
            second: momentum.moment_2,
        };
        (stepped.reshape(shape), moments)
    }
}

/// The sum of all squares, each tensor's in float64 where the kernels run and in float32 elsewhere.
///
/// # Shapes
/// Any number of tensors of any lengths, flattened.
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
            // One transfer for all tensors; the sum of the sums in float64, on the host.
            let sums = tensors.into_iter().map(|tensor| tensor.square().sum());
            let sums = Tensor::cat(sums.collect(), 0).into_data();
            let sums = sums.try_to_vec::<f32>().expect("gradients are float32");
            sums.into_iter().map(f64::from).sum()
        }
    }
}

/// What a backend must have to take steps by the kernels.
#[backend_extension(Flex)]
trait StepOps: Backend {
    /// Weight and moments after step `step`, from 1.
    fn adam_step(
        weight: FloatTensor<Self>,
        grad: FloatTensor<Self>,
        first: FloatTensor<Self>,
        second: FloatTensor<Self>,
        rule: demc_kernels::adam::Adam,
        step: u64,
    ) -> (FloatTensor<Self>, FloatTensor<Self>, FloatTensor<Self>);
    /// In float64.
    fn sum_of_squares(x: FloatTensor<Self>) -> f64;
}

impl StepOps for Flex {
    fn adam_step(
        weight: FlexTensor,
        grad: FlexTensor,
        first: FlexTensor,
        second: FlexTensor,
        rule: demc_kernels::adam::Adam,
        step: u64,
    ) -> (FlexTensor, FlexTensor, FlexTensor) {
        let grad = contiguous(grad);
        let [mut weight, mut first, mut second] = [weight, first, second].map(contiguous);
        // Each is copied first where somebody else holds it, too: a checkpoint in the making, the caller's model.
        demc_kernels::adam::step(
            Isa::current(),
            &rule,
            step,
            weight.storage_mut(),
            values(&grad),
            first.storage_mut(),
            second.storage_mut(),
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
}
