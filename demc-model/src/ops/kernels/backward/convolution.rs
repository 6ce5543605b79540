//! The backward pass of the operations with weights: convolutions, deconvolutions, skip fusions.

use burn::backend::Flex;
use burn::backend::autodiff::checkpoint::base::Checkpointer;
use burn::backend::autodiff::grads::Gradients;
use burn::backend::autodiff::ops::{Backward, Ops};
use burn::backend::flex::FlexTensor;
use demc_kernels::{
    GradientSource, GradientTarget, Grid, Isa, conv1x1, conv3x3, conv5x5, deconv4x4,
};

use super::super::{buffer, contiguous, dims, grid, maps, tensor, values};

#[derive(Clone, Debug)]
pub(super) struct ConvState<const P: usize> {
    pub(super) inputs: [FlexTensor; P],
    pub(super) weight: FlexTensor,
    /// The output, where a ReLU follows.
    pub(super) y: Option<FlexTensor>,
}

/// The backward pass of a convolution. `kernel` gets grid, inputs, and source, and fills the target;
/// gradients with a node are registered.
///
/// The nodes belong to the inputs, the weight and the bias, in this order. The weight's axis
/// `output_axis` has the output channels.
fn backward_convolution<const P: usize, const N: usize>(
    ops: Ops<ConvState<P>, N>,
    grads: &mut Gradients,
    output_axis: usize,
    kernel: impl FnOnce(Grid, [&[f32]; P], GradientSource, GradientTarget<[Option<&mut [f32]>; P]>),
) {
    let dy = contiguous(grads.consume::<Flex>(&ops.node));
    let ConvState { inputs, weight, y } = ops.state;
    let mut nodes = ops.parents.into_iter();
    let input_nodes: [_; P] = std::array::from_fn(|_| nodes.next().flatten());
    let [weight_node, bias_node] = std::array::from_fn(|_| nodes.next().flatten());

    let (grid, _) = grid(&inputs[0]);
    let shape = dims::<4>(&weight);
    let mut dinputs: [_; P] = std::array::from_fn(|i| {
        let node = input_nodes[i].as_ref();
        node.map(|_| buffer(values(&inputs[i]).len()))
    });
    let mut dweight = buffer(values(&weight).len());
    let mut dbias = buffer(shape[output_axis]);
    kernel(
        grid,
        inputs.each_ref().map(values),
        GradientSource {
            weight: values(&weight),
            y: y.as_ref().map(values),
            dy: values(&dy),
        },
        GradientTarget {
            dx: dinputs.each_mut().map(Option::as_deref_mut),
            dweight: &mut dweight,
            dbias: &mut dbias,
        },
    );
    for (node, dinput) in input_nodes.into_iter().zip(dinputs) {
        if let (Some(node), Some(dinput)) = (node, dinput) {
            grads.register::<Flex>(node.id, maps(grid, dinput));
        }
    }
    if let Some(node) = weight_node {
        grads.register::<Flex>(node.id, tensor(dweight, shape));
    }
    if let Some(node) = bias_node {
        grads.register::<Flex>(node.id, tensor(dbias, [shape[output_axis]]));
    }
}

/// Declares the backward pass of a kernel whose weight has the output channels on axis `$axis`.
macro_rules! backward {
    ($name:ident, $kernel:ident, $axis:literal) => {
        #[derive(Debug)]
        pub(super) struct $name;

        impl Backward<Flex, 3> for $name {
            type State = ConvState<1>;

            fn backward(
                self,
                ops: Ops<Self::State, 3>,
                grads: &mut Gradients,
                _: &mut Checkpointer,
            ) {
                backward_convolution(ops, grads, $axis, |grid, [x], source, target| {
                    let GradientTarget {
                        dx: [dx],
                        dweight,
                        dbias,
                    } = target;
                    let target = GradientTarget { dx, dweight, dbias };
                    $kernel::backward(Isa::current(), grid, x, source, target);
                });
            }
        }
    };
}

backward!(Conv3x3, conv3x3, 0);
backward!(Conv5x5, conv5x5, 0);
backward!(Deconv4x4, deconv4x4, 1);

/// A fusion of `P` parts. Its `N` nodes belong to the parts, the weight and the bias.
#[derive(Debug)]
pub(super) struct Fuse<const P: usize>;

impl<const P: usize, const N: usize> Backward<Flex, N> for Fuse<P> {
    type State = ConvState<P>;

    fn backward(self, ops: Ops<Self::State, N>, grads: &mut Gradients, _: &mut Checkpointer) {
        backward_convolution(ops, grads, 0, |grid, inputs, source, mut target| {
            let target = GradientTarget {
                dx: &mut target.dx[..],
                dweight: target.dweight,
                dbias: target.dbias,
            };
            conv1x1::backward(Isa::current(), grid, &inputs, source, target);
        });
    }
}
