//! A moving average of weights: in place where the kernels run, by Burn's arithmetic elsewhere.

use burn::backend::flex::FlexTensor;
use burn::backend::{Backend, Dispatch, Flex, backend_extension, tensor::FloatTensor};
use burn::tensor::Tensor;
use demc_kernels::Isa;

use super::Ops;
use super::kernels::slices::{contiguous, values};

/// `average + share * (live - average)`; in place where nobody else holds the average.
///
/// # Shapes
/// Two of any one shape.
pub fn towards<const D: usize>(
    ops: Ops,
    average: Tensor<D>,
    live: Tensor<D>,
    share: f32,
) -> Tensor<D> {
    match ops.on(&average.device()) {
        Ops::Kernels => {
            let (average, live) = (average.into_dispatch(), live.into_dispatch());
            Tensor::from_dispatch(Dispatch::towards(average, live, share))
        }
        Ops::Burn => average.clone() + (live - average).mul_scalar(share),
    }
}

/// What a backend must have to average by the kernels.
#[backend_extension(Flex)]
trait AverageOps: Backend {
    /// The average, moved by `share` of the way.
    fn towards(
        average: FloatTensor<Self>,
        live: FloatTensor<Self>,
        share: f32,
    ) -> FloatTensor<Self>;
}

impl AverageOps for Flex {
    fn towards(average: FlexTensor, live: FlexTensor, share: f32) -> FlexTensor {
        let [mut average, live] = [average, live].map(contiguous);
        let slice = average.storage_mut();
        demc_kernels::average::towards(Isa::current(), slice, values(&live), share);
        average
    }
}
