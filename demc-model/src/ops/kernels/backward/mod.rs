//! The kernels on `flex` under autodiff: the state that each operation keeps, and the backward
//! pass.
//!
//! An operation keeps tensors, not copies: `flex` shares memory by reference count. One operation's
//! output and the next one's input are one buffer. Gradients with respect to the network's inputs
//! are not computed.

mod convolution;

use burn::backend::autodiff::checkpoint::{base::Checkpointer, strategy::CheckpointStrategy};
use burn::backend::autodiff::grads::Gradients;
use burn::backend::autodiff::ops::{Backward, NodeGuard, Ops, OpsKind};
use burn::backend::flex::FlexTensor;
use burn::backend::tensor::FloatTensor;
use burn::backend::{Autodiff, AutodiffBackend, Flex};
use demc_kernels::batch_norm::{BatchNormSource, Moments};
use demc_kernels::blend::Scales;
use demc_kernels::filter::Filter;
use demc_kernels::{Isa, batch_norm, blend, double, filter, pool};

use super::forward::{fuse, rel_mse_into};
use super::{KernelOps, buffer, contiguous, dims, grid, maps, tensor, values};
use convolution::{Conv3x3, Conv5x5, ConvState, Deconv4x4, Fuse};

type Tracked = FloatTensor<Autodiff<Flex>>;

impl<C: CheckpointStrategy> KernelOps for Autodiff<Flex, C> {
    fn nhwc_from_nchw(x: Tracked) -> Tracked {
        let (x, x_node) = x.into_parts();
        record::<_, C, _>(Relayout::ToNhwc, [x_node], Flex::nhwc_from_nchw(x), |_| ())
    }

    fn nchw_from_nhwc(x: Tracked) -> Tracked {
        let (x, x_node) = x.into_parts();
        record::<_, C, _>(Relayout::ToNchw, [x_node], Flex::nchw_from_nhwc(x), |_| ())
    }

    fn conv3x3(x: Tracked, weight: Tracked, bias: Tracked, relu: bool) -> Tracked {
        convolution::<C>(Conv3x3, Flex::conv3x3, [x, weight, bias], relu)
    }

    fn conv5x5(x: Tracked, weight: Tracked, bias: Tracked, relu: bool) -> Tracked {
        convolution::<C>(Conv5x5, Flex::conv5x5, [x, weight, bias], relu)
    }

    fn deconv4x4(x: Tracked, weight: Tracked, bias: Tracked, relu: bool) -> Tracked {
        convolution::<C>(Deconv4x4, Flex::deconv4x4, [x, weight, bias], relu)
    }

    fn fuse_one(a: Tracked, weight: Tracked, bias: Tracked, relu: bool) -> Tracked {
        let ([a, weight, bias], nodes) = parts([a, weight, bias]);
        fuse_recorded::<C, 1, 3>([a], weight, bias, nodes, relu)
    }

    fn fuse_two(a: Tracked, b: Tracked, weight: Tracked, bias: Tracked, relu: bool) -> Tracked {
        let ([a, b, weight, bias], nodes) = parts([a, b, weight, bias]);
        fuse_recorded::<C, 2, 4>([a, b], weight, bias, nodes, relu)
    }

    fn fuse_three(
        a: Tracked,
        b: Tracked,
        c: Tracked,
        weight: Tracked,
        bias: Tracked,
        relu: bool,
    ) -> Tracked {
        let ([a, b, c, weight, bias], nodes) = parts([a, b, c, weight, bias]);
        fuse_recorded::<C, 3, 5>([a, b, c], weight, bias, nodes, relu)
    }

    fn max_pool(x: Tracked) -> Tracked {
        let ([x], nodes) = parts([x]);
        record::<_, C, _>(MaxPool, nodes, Flex::max_pool(x.clone()), |_| x)
    }

    fn double_and_append(coarse: Tracked, skip: Tracked) -> Tracked {
        let ([coarse, skip], nodes) = parts([coarse, skip]);
        let channels = [&coarse, &skip].map(|maps| grid(maps).1);
        let y = Flex::double_and_append(coarse, skip);
        record::<_, C, _>(DoubleAndAppend, nodes, y, |_| channels)
    }

    fn halve(x: Tracked) -> Tracked {
        <Self as AutodiffBackend>::from_inner(Flex::halve(x.into_primitive()))
    }

    fn filter(x: Tracked, logits: Tracked) -> Tracked {
        let x = contiguous(x.into_primitive());
        let ([logits], nodes) = parts([logits]);
        let y = Flex::filter(x.clone(), logits.clone());
        record::<_, C, _>(FilterPixels, nodes, y, |_| [x, logits])
    }

    fn blend(filtered: Tracked, coarse: Tracked) -> Tracked {
        let (inputs, nodes) = parts([filtered, coarse]);
        let [filtered, coarse] = inputs.clone();
        record::<_, C, _>(Blend, nodes, Flex::blend(filtered, coarse), |_| inputs)
    }

    fn batch_norm(
        _x: Tracked,
        _gamma: Tracked,
        _beta: Tracked,
        _mean: Tracked,
        _variance: Tracked,
        _epsilon: f32,
        _relu: bool,
    ) -> Tracked {
        unreachable!("maps with autodiff are normalised by batch_norm_train or by Burn")
    }

    fn batch_norm_train(
        x: Tracked,
        gamma: Tracked,
        beta: Tracked,
        epsilon: f32,
        relu: bool,
    ) -> (Tracked, Tracked, Tracked) {
        let ([x, gamma, beta], nodes) = parts([x, gamma, beta]);
        let (y, mean, variance) =
            Flex::batch_norm_train(x.clone(), gamma.clone(), beta, epsilon, relu);
        let statistics = [mean.clone(), variance.clone()];
        let y = record::<_, C, _>(BatchNorm, nodes, y, |y| NormState {
            x,
            gamma,
            statistics,
            epsilon,
            y: relu.then(|| y.clone()),
        });
        let untracked = <Self as AutodiffBackend>::from_inner;
        (y, untracked(mean), untracked(variance))
    }

    fn rel_mse_of_gamma(out_gamma: Tracked, ref_hdr: Tracked, gamma: f32, epsilon: f32) -> Tracked {
        let ([out_gamma], nodes) = parts([out_gamma]);
        let ref_hdr = contiguous(ref_hdr.into_primitive());
        // The gradient is computed with the loss: both need the same powers.
        let mut dout = buffer(values(&out_gamma).len());
        let loss = rel_mse_into(&out_gamma, &ref_hdr, gamma, epsilon, Some(&mut dout));
        let dout = tensor(dout, dims::<4>(&out_gamma));
        record::<_, C, _>(RelMse, nodes, loss, |_| dout)
    }
}

/// The tensors, [`contiguous`], and their nodes.
fn parts<const N: usize>(tensors: [Tracked; N]) -> ([FlexTensor; N], [NodeGuard; N]) {
    let mut nodes = Vec::with_capacity(N);
    let tensors = tensors.map(|tensor| {
        let (tensor, node) = tensor.into_parts();
        nodes.push(node);
        contiguous(tensor)
    });
    let nodes = nodes.try_into().expect("one node per tensor");
    (tensors, nodes)
}

/// Records `operation` with its state if any of its inputs has a gradient.
fn record<O, C, const N: usize>(
    operation: O,
    nodes: [NodeGuard; N],
    output: FlexTensor,
    state: impl FnOnce(&FlexTensor) -> O::State,
) -> Tracked
where
    O: Backward<Flex, N>,
    C: CheckpointStrategy,
{
    match operation.prepare::<C>(nodes).compute_bound().stateful() {
        OpsKind::Tracked(prep) => {
            let state = state(&output);
            prep.finish(state, output)
        }
        OpsKind::UnTracked(prep) => prep.finish(output),
    }
}

/// Runs a convolution on maps, weight, and bias, and records `backward`.
fn convolution<C: CheckpointStrategy>(
    backward: impl Backward<Flex, 3, State = ConvState<1>>,
    forward: fn(FlexTensor, FlexTensor, FlexTensor, bool) -> FlexTensor,
    operands: [Tracked; 3],
    relu: bool,
) -> Tracked {
    let ([x, weight, bias], nodes) = parts(operands);
    let y = forward(x.clone(), weight.clone(), bias, relu);
    record::<_, C, _>(backward, nodes, y, |y| ConvState {
        inputs: [x],
        weight,
        y: relu.then(|| y.clone()),
    })
}

fn fuse_recorded<C: CheckpointStrategy, const P: usize, const N: usize>(
    inputs: [FlexTensor; P],
    weight: FlexTensor,
    bias: FlexTensor,
    nodes: [NodeGuard; N],
    relu: bool,
) -> Tracked {
    let y = fuse(inputs.clone(), weight.clone(), bias, relu);
    record::<_, C, N>(Fuse::<P>, nodes, y, |y| ConvState {
        inputs,
        weight,
        y: relu.then(|| y.clone()),
    })
}

#[derive(Debug)]
struct MaxPool;

impl Backward<Flex, 1> for MaxPool {
    type State = FlexTensor;

    fn backward(self, ops: Ops<Self::State, 1>, grads: &mut Gradients, _: &mut Checkpointer) {
        let dy = contiguous(grads.consume::<Flex>(&ops.node));
        let ([node], x) = (ops.parents, ops.state);
        if let Some(node) = node {
            let (grid, _) = grid(&x);
            let mut dx = buffer(values(&x).len());
            pool::backward(Isa::current(), grid, values(&x), values(&dy), &mut dx);
            grads.register::<Flex>(node.id, maps(grid, dx));
        }
    }
}

#[derive(Debug)]
struct FilterPixels;

impl Backward<Flex, 1> for FilterPixels {
    /// The image and the logits.
    type State = [FlexTensor; 2];

    fn backward(self, ops: Ops<Self::State, 1>, grads: &mut Gradients, _: &mut Checkpointer) {
        let dy = contiguous(grads.consume::<Flex>(&ops.node));
        let ([node], [x, logits]) = (ops.parents, ops.state);
        if let Some(node) = node {
            let (grid, _) = grid(&x);
            let mut dlogits = buffer(values(&logits).len());
            let filter = Filter {
                x: values(&x),
                logits: values(&logits),
            };
            filter::backward(Isa::current(), grid, filter, values(&dy), &mut dlogits);
            grads.register::<Flex>(node.id, maps(grid, dlogits));
        }
    }
}

#[derive(Debug)]
struct Blend;

impl Backward<Flex, 2> for Blend {
    /// The filtered image with its blend weight, and the coarser image.
    type State = [FlexTensor; 2];

    fn backward(self, ops: Ops<Self::State, 2>, grads: &mut Gradients, _: &mut Checkpointer) {
        let dout = contiguous(grads.consume::<Flex>(&ops.node));
        let [filtered, coarse] = ops.state.each_ref().map(values);
        let (grid, _) = grid(&ops.state[0]);
        let mut gradients = [buffer(filtered.len()), buffer(coarse.len())];
        let [dfiltered, dcoarse] = &mut gradients;
        let scales = Scales { filtered, coarse };
        blend::backward(grid, scales, values(&dout), dfiltered, dcoarse);
        let grids = [grid, grid.halved()];
        for ((node, gradient), grid) in ops.parents.into_iter().zip(gradients).zip(grids) {
            if let Some(node) = node {
                grads.register::<Flex>(node.id, maps(grid, gradient));
            }
        }
    }
}

#[derive(Debug)]
struct DoubleAndAppend;

impl Backward<Flex, 2> for DoubleAndAppend {
    /// Channels of both inputs.
    type State = [usize; 2];

    fn backward(self, ops: Ops<Self::State, 2>, grads: &mut Gradients, _: &mut Checkpointer) {
        let dy = contiguous(grads.consume::<Flex>(&ops.node));
        let (fine, _) = grid(&dy);
        let grids = [fine.halved(), fine];
        let mut gradients = [0, 1].map(|part| buffer(grids[part].pixels() * ops.state[part]));
        let [dcoarse, dskip] = &mut gradients;
        double::backward(fine, values(&dy), dcoarse, dskip);
        for ((node, gradient), grid) in ops.parents.into_iter().zip(gradients).zip(grids) {
            if let Some(node) = node {
                grads.register::<Flex>(node.id, maps(grid, gradient));
            }
        }
    }
}

#[derive(Debug)]
struct BatchNorm;

#[derive(Clone, Debug)]
struct NormState {
    x: FlexTensor,
    gamma: FlexTensor,
    /// Mean and variance of the batch.
    statistics: [FlexTensor; 2],
    epsilon: f32,
    /// The output, where a ReLU follows.
    y: Option<FlexTensor>,
}

impl Backward<Flex, 3> for BatchNorm {
    type State = NormState;

    fn backward(self, ops: Ops<Self::State, 3>, grads: &mut Gradients, _: &mut Checkpointer) {
        let dy = contiguous(grads.consume::<Flex>(&ops.node));
        let NormState {
            x,
            gamma,
            statistics,
            epsilon,
            y,
        } = ops.state;
        let (grid, channels) = grid(&x);
        let mut dx = buffer(values(&x).len());
        let [mut dgamma, mut dbeta] = [buffer(channels), buffer(channels)];
        let source = BatchNormSource {
            x: values(&x),
            gamma: values(&gamma),
            moments: Moments {
                mean: values(&statistics[0]),
                variance: values(&statistics[1]),
            },
            epsilon,
            y: y.as_ref().map(values),
            dy: values(&dy),
        };
        batch_norm::backward(Isa::current(), source, &mut dx, &mut dgamma, &mut dbeta);
        let gradients = [
            maps(grid, dx),
            tensor(dgamma, [channels]),
            tensor(dbeta, [channels]),
        ];
        for (node, gradient) in ops.parents.into_iter().zip(gradients) {
            if let Some(node) = node {
                grads.register::<Flex>(node.id, gradient);
            }
        }
    }
}

/// The conversion between channels first and channels last. The backward pass is the inverse.
#[derive(Debug)]
enum Relayout {
    ToNhwc,
    ToNchw,
}

impl Backward<Flex, 1> for Relayout {
    type State = ();

    fn backward(self, ops: Ops<(), 1>, grads: &mut Gradients, _: &mut Checkpointer) {
        let dy = grads.consume::<Flex>(&ops.node);
        let [node] = ops.parents;
        if let Some(node) = node {
            let dx = match self {
                Relayout::ToNhwc => Flex::nchw_from_nhwc(dy),
                Relayout::ToNchw => Flex::nhwc_from_nchw(dy),
            };
            grads.register::<Flex>(node.id, dx);
        }
    }
}

#[derive(Debug)]
struct RelMse;

impl Backward<Flex, 1> for RelMse {
    /// The gradient of each image's loss with respect to the output, `[B, C, H, W]`.
    type State = FlexTensor;

    fn backward(self, ops: Ops<Self::State, 1>, grads: &mut Gradients, _: &mut Checkpointer) {
        let dloss = contiguous(grads.consume::<Flex>(&ops.node));
        let ([node], dout) = (ops.parents, ops.state);
        if let Some(node) = node {
            let mut dout = dout;
            let factors = values(&dloss);
            let image = values(&dout).len() / factors.len();
            let images = dout.storage_mut::<f32>().chunks_mut(image);
            for (dout, factor) in images.zip(factors) {
                dout.iter_mut().for_each(|value| *value *= factor);
            }
            grads.register::<Flex>(node.id, dout);
        }
    }
}
