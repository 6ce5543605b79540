//! The kernels as Burn operations: a backend extension for `flex`, with and without autodiff.
//!
//! The functions here take and return Burn's tensors. Burn calls [`KernelOps`] of the tensor's
//! backend. `flex` runs the kernel on slices (`forward`). `flex` under autodiff also records the
//! backward pass (`backward`). Maps are `[B, H, W, C]` and contiguous; weights have the layout of
//! weight files.

mod backward;
mod forward;

use burn::backend::flex::FlexTensor;
use burn::backend::{Backend, Dispatch, backend_extension, tensor::FloatTensor};
use burn::nn::BatchNorm;
use burn::tensor::{Tensor, TensorData};
use demc_kernels::Grid;

use super::activation::Activation;

#[backend_extension(Flex, Autodiff)]
pub(super) trait KernelOps: Backend {
    /// `[B, C, H, W]` to `[B, H, W, C]`.
    fn nhwc_from_nchw(x: FloatTensor<Self>) -> FloatTensor<Self>;
    /// `[B, H, W, C]` to `[B, C, H, W]`.
    fn nchw_from_nhwc(x: FloatTensor<Self>) -> FloatTensor<Self>;
    /// Weight `[out, in, 3, 3]`.
    fn conv3x3(
        x: FloatTensor<Self>,
        weight: FloatTensor<Self>,
        bias: FloatTensor<Self>,
        relu: bool,
    ) -> FloatTensor<Self>;
    /// Weight `[out, in, 5, 5]`.
    fn conv5x5(
        x: FloatTensor<Self>,
        weight: FloatTensor<Self>,
        bias: FloatTensor<Self>,
        relu: bool,
    ) -> FloatTensor<Self>;
    /// Weight `[in, out, 4, 4]`.
    fn deconv4x4(
        x: FloatTensor<Self>,
        weight: FloatTensor<Self>,
        bias: FloatTensor<Self>,
        relu: bool,
    ) -> FloatTensor<Self>;
    /// Weight `[out, in, 1, 1]`.
    fn fuse_one(
        a: FloatTensor<Self>,
        weight: FloatTensor<Self>,
        bias: FloatTensor<Self>,
        relu: bool,
    ) -> FloatTensor<Self>;
    /// Weight `[out, sum of in, 1, 1]`.
    fn fuse_two(
        a: FloatTensor<Self>,
        b: FloatTensor<Self>,
        weight: FloatTensor<Self>,
        bias: FloatTensor<Self>,
        relu: bool,
    ) -> FloatTensor<Self>;
    /// Weight `[out, sum of in, 1, 1]`.
    fn fuse_three(
        a: FloatTensor<Self>,
        b: FloatTensor<Self>,
        c: FloatTensor<Self>,
        weight: FloatTensor<Self>,
        bias: FloatTensor<Self>,
        relu: bool,
    ) -> FloatTensor<Self>;
    /// 2x2, stride 2.
    fn max_pool(x: FloatTensor<Self>) -> FloatTensor<Self>;
    /// `coarse` doubled by repeating pixels, then the channels of `skip`.
    fn double_and_append(coarse: FloatTensor<Self>, skip: FloatTensor<Self>) -> FloatTensor<Self>;
    /// The mean of each 2x2 window; not differentiable.
    fn halve(x: FloatTensor<Self>) -> FloatTensor<Self>;
    /// An image and 25, 26, or 441 logits per pixel; the image has no gradient.
    fn filter(x: FloatTensor<Self>, logits: FloatTensor<Self>) -> FloatTensor<Self>;
    /// A filtered image with its blend weight, and a coarser image.
    fn blend(filtered: FloatTensor<Self>, coarse: FloatTensor<Self>) -> FloatTensor<Self>;
    /// With the given statistics; not differentiable.
    fn batch_norm(
        x: FloatTensor<Self>,
        gamma: FloatTensor<Self>,
        beta: FloatTensor<Self>,
        mean: FloatTensor<Self>,
        variance: FloatTensor<Self>,
        epsilon: f32,
        relu: bool,
    ) -> FloatTensor<Self>;
    /// With the batch's statistics. Returns the maps, the mean and the variance; the latter two
    /// have no gradient.
    fn batch_norm_train(
        x: FloatTensor<Self>,
        gamma: FloatTensor<Self>,
        beta: FloatTensor<Self>,
        epsilon: f32,
        relu: bool,
    ) -> (FloatTensor<Self>, FloatTensor<Self>, FloatTensor<Self>);
    /// Eq. 5 of each image, `[B]`; the reference has no gradient.
    fn rel_mse_of_gamma(
        out_gamma: FloatTensor<Self>,
        ref_hdr: FloatTensor<Self>,
        gamma: f32,
        epsilon: f32,
    ) -> FloatTensor<Self>;
}

pub(super) fn nhwc_from_nchw(x: Tensor<4>) -> Tensor<4> {
    Tensor::from_dispatch(Dispatch::nhwc_from_nchw(x.into_dispatch()))
}

pub(super) fn nchw_from_nhwc(x: Tensor<4>) -> Tensor<4> {
    Tensor::from_dispatch(Dispatch::nchw_from_nhwc(x.into_dispatch()))
}

pub(super) fn conv3x3(
    x: Tensor<4>,
    weight: Tensor<4>,
    bias: Tensor<1>,
    activation: Activation,
) -> Tensor<4> {
    Tensor::from_dispatch(Dispatch::conv3x3(
        x.into_dispatch(),
        weight.into_dispatch(),
        bias.into_dispatch(),
        activation.is_relu(),
    ))
}

pub(super) fn conv5x5(
    x: Tensor<4>,
    weight: Tensor<4>,
    bias: Tensor<1>,
    activation: Activation,
) -> Tensor<4> {
    Tensor::from_dispatch(Dispatch::conv5x5(
        x.into_dispatch(),
        weight.into_dispatch(),
        bias.into_dispatch(),
        activation.is_relu(),
    ))
}

pub(super) fn deconv4x4(
    x: Tensor<4>,
    weight: Tensor<4>,
    bias: Tensor<1>,
    activation: Activation,
) -> Tensor<4> {
    Tensor::from_dispatch(Dispatch::deconv4x4(
        x.into_dispatch(),
        weight.into_dispatch(),
        bias.into_dispatch(),
        activation.is_relu(),
    ))
}

pub(super) fn fuse(
    parts: Vec<Tensor<4>>,
    weight: Tensor<4>,
    bias: Tensor<1>,
    activation: Activation,
) -> Tensor<4> {
    let (weight, bias) = (weight.into_dispatch(), bias.into_dispatch());
    let relu = activation.is_relu();
    let mut parts = parts.into_iter().map(Tensor::into_dispatch);
    let fused = match [parts.next(), parts.next(), parts.next(), parts.next()] {
        [Some(a), None, None, None] => Dispatch::fuse_one(a, weight, bias, relu),
        [Some(a), Some(b), None, None] => Dispatch::fuse_two(a, b, weight, bias, relu),
        [Some(a), Some(b), Some(c), None] => Dispatch::fuse_three(a, b, c, weight, bias, relu),
        _ => panic!("a fusion has one to three parts"),
    };
    Tensor::from_dispatch(fused)
}

pub(super) fn max_pool(x: Tensor<4>) -> Tensor<4> {
    Tensor::from_dispatch(Dispatch::max_pool(x.into_dispatch()))
}

pub(super) fn double_and_append(coarse: Tensor<4>, skip: Tensor<4>) -> Tensor<4> {
    Tensor::from_dispatch(Dispatch::double_and_append(
        coarse.into_dispatch(),
        skip.into_dispatch(),
    ))
}

pub(super) fn halve(x: Tensor<4>) -> Tensor<4> {
    Tensor::from_dispatch(Dispatch::halve(x.into_dispatch()))
}

pub(super) fn filter(x: Tensor<4>, logits: Tensor<4>) -> Tensor<4> {
    Tensor::from_dispatch(Dispatch::filter(x.into_dispatch(), logits.into_dispatch()))
}

pub(super) fn blend(filtered: Tensor<4>, coarse: Tensor<4>) -> Tensor<4> {
    Tensor::from_dispatch(Dispatch::blend(
        filtered.into_dispatch(),
        coarse.into_dispatch(),
    ))
}

pub(super) fn batch_norm(x: Tensor<4>, norm: &BatchNorm, activation: Activation) -> Tensor<4> {
    Tensor::from_dispatch(Dispatch::batch_norm(
        x.into_dispatch(),
        norm.gamma.val().into_dispatch(),
        norm.beta.val().into_dispatch(),
        norm.running_mean.value().into_dispatch(),
        norm.running_var.value().into_dispatch(),
        norm.epsilon as f32,
        activation.is_relu(),
    ))
}

pub(super) fn batch_norm_train(
    x: Tensor<4>,
    norm: &BatchNorm,
    activation: Activation,
) -> (Tensor<4>, [Tensor<1>; 2]) {
    let (y, mean, variance) = Dispatch::batch_norm_train(
        x.into_dispatch(),
        norm.gamma.val().into_dispatch(),
        norm.beta.val().into_dispatch(),
        norm.epsilon as f32,
        activation.is_relu(),
    );
    let statistics = [mean, variance].map(Tensor::from_dispatch);
    (Tensor::from_dispatch(y), statistics)
}

pub(super) fn rel_mse_of_gamma(
    out_gamma: Tensor<4>,
    ref_hdr: Tensor<4>,
    gamma: f32,
    epsilon: f32,
) -> Tensor<1> {
    Tensor::from_dispatch(Dispatch::rel_mse_of_gamma(
        out_gamma.into_dispatch(),
        ref_hdr.into_dispatch(),
        gamma,
        epsilon,
    ))
}

/// The tensor with its values row by row in a buffer of exactly their size. Maps and weights have
/// this layout already and are not copied.
pub(super) fn contiguous(tensor: FlexTensor) -> FlexTensor {
    // This clones only a reference, which is dropped on return.
    tensor.to_contiguous()
}

pub(super) fn values(tensor: &FlexTensor) -> &[f32] {
    tensor.storage::<f32>()
}

/// A buffer of `len` values to write; its initial values are arbitrary.
fn buffer(len: usize) -> Vec<f32> {
    demc_kernels::memory::buffer(len)
}

fn tensor<const D: usize>(values: Vec<f32>, shape: [usize; D]) -> FlexTensor {
    FlexTensor::from_data(TensorData::new(values, shape))
}

fn dims<const D: usize>(tensor: &FlexTensor) -> [usize; D] {
    tensor.layout().shape().dims()
}

fn grid(maps: &FlexTensor) -> (Grid, usize) {
    let [batch, height, width, channels] = dims(maps);
    let grid = Grid {
        batch,
        height,
        width,
    };
    (grid, channels)
}

fn maps(grid: Grid, values: Vec<f32>) -> FlexTensor {
    let channels = grid.channels(values.len());
    tensor(values, [grid.batch, grid.height, grid.width, channels])
}
