//! The kernels on `flex`: the forward pass.

use burn::backend::Flex;
use burn::backend::flex::FlexTensor;
use demc_kernels::batch_norm::{BatchNorm, Moments};
use demc_kernels::blend::Scales;
use demc_kernels::filter::Filter;
use demc_kernels::rel_mse::RelMse;
use demc_kernels::{
    Convolution, Grid, Isa, batch_norm, blend, conv1x1, conv3x3, conv5x5, deconv4x4, double,
    filter, grid, pool, rel_mse,
};

use super::{KernelOps, buffer, contiguous, dims, grid, maps, tensor, values};

impl KernelOps for Flex {
    fn nhwc_from_nchw(x: FlexTensor) -> FlexTensor {
        let x = contiguous(x);
        let [batch, channels, height, width] = dims(&x);
        let grid = Grid {
            batch,
            height,
            width,
        };
        let mut y = buffer(grid.pixels() * channels);
        grid::nhwc_from_nchw(grid, values(&x), &mut y);
        maps(grid, y)
    }

    fn nchw_from_nhwc(x: FlexTensor) -> FlexTensor {
        let x = contiguous(x);
        let (grid, channels) = grid(&x);
        let mut y = buffer(grid.pixels() * channels);
        grid::nchw_from_nhwc(grid, values(&x), &mut y);
        tensor(y, [grid.batch, channels, grid.height, grid.width])
    }

    fn conv3x3(x: FlexTensor, weight: FlexTensor, bias: FlexTensor, relu: bool) -> FlexTensor {
        convolution(conv3x3::forward, [x, weight, bias], relu)
    }

    fn conv5x5(x: FlexTensor, weight: FlexTensor, bias: FlexTensor, relu: bool) -> FlexTensor {
        convolution(conv5x5::forward, [x, weight, bias], relu)
    }

    fn deconv4x4(x: FlexTensor, weight: FlexTensor, bias: FlexTensor, relu: bool) -> FlexTensor {
        let [x, weight, bias] = [x, weight, bias].map(contiguous);
        let (grid, _) = grid(&x);
        let [_, outputs, ..] = dims::<4>(&weight);
        let mut y = buffer(grid.doubled().pixels() * outputs);
        deconv4x4::forward(
            Isa::current(),
            grid,
            values(&x),
            Convolution {
                weight: values(&weight),
                bias: values(&bias),
                relu,
            },
            &mut y,
        );
        maps(grid.doubled(), y)
    }

    fn fuse_one(a: FlexTensor, weight: FlexTensor, bias: FlexTensor, relu: bool) -> FlexTensor {
        fuse([a], weight, bias, relu)
    }

    fn fuse_two(
        a: FlexTensor,
        b: FlexTensor,
        weight: FlexTensor,
        bias: FlexTensor,
        relu: bool,
    ) -> FlexTensor {
        fuse([a, b], weight, bias, relu)
    }

    fn fuse_three(
        a: FlexTensor,
        b: FlexTensor,
        c: FlexTensor,
        weight: FlexTensor,
        bias: FlexTensor,
        relu: bool,
    ) -> FlexTensor {
        fuse([a, b, c], weight, bias, relu)
    }

    fn max_pool(x: FlexTensor) -> FlexTensor {
        let x = contiguous(x);
        let (grid, channels) = grid(&x);
        let mut y = buffer(grid.halved().pixels() * channels);
        pool::forward(Isa::current(), grid, values(&x), &mut y);
        maps(grid.halved(), y)
    }

    fn double_and_append(coarse: FlexTensor, skip: FlexTensor) -> FlexTensor {
        let [coarse, skip] = [coarse, skip].map(contiguous);
        let ((_, below), (grid, beside)) = (grid(&coarse), grid(&skip));
        let mut y = buffer(grid.pixels() * (below + beside));
        double::forward(grid, values(&coarse), values(&skip), &mut y);
        maps(grid, y)
    }

    fn halve(x: FlexTensor) -> FlexTensor {
        let x = contiguous(x);
        let (grid, channels) = grid(&x);
        let mut y = buffer(grid.halved().pixels() * channels);
        blend::halve(grid, values(&x), &mut y);
        maps(grid.halved(), y)
    }

    fn filter(x: FlexTensor, logits: FlexTensor) -> FlexTensor {
        let [x, logits] = [x, logits].map(contiguous);
        let ((images, _), (grid, channels)) = (grid(&x), grid(&logits));
        let mut y = buffer(images.pixels() * (filter::outputs(channels)));
        let filter = Filter {
            x: values(&x),
            logits: values(&logits),
        };
        filter::forward(Isa::current(), grid, filter, &mut y);
        maps(images, y)
    }

    fn blend(filtered: FlexTensor, coarse: FlexTensor) -> FlexTensor {
        let [filtered, coarse] = [filtered, coarse].map(contiguous);
        let (grid, _) = grid(&filtered);
        let mut out = buffer(grid.pixels() * filter::COLORS);
        let scales = Scales {
            filtered: values(&filtered),
            coarse: values(&coarse),
        };
        blend::forward(grid, scales, &mut out);
        maps(grid, out)
    }

    fn batch_norm(
        x: FlexTensor,
        gamma: FlexTensor,
        beta: FlexTensor,
        mean: FlexTensor,
        variance: FlexTensor,
        epsilon: f32,
        relu: bool,
    ) -> FlexTensor {
        let [x, gamma, beta, mean, variance] = [x, gamma, beta, mean, variance].map(contiguous);
        let mut y = buffer(values(&x).len());
        batch_norm::forward_eval(
            Isa::current(),
            values(&x),
            BatchNorm {
                gamma: values(&gamma),
                beta: values(&beta),
                epsilon,
                relu,
            },
            Moments {
                mean: values(&mean),
                variance: values(&variance),
            },
            &mut y,
        );
        tensor(y, dims::<4>(&x))
    }

    fn batch_norm_train(
        x: FlexTensor,
        gamma: FlexTensor,
        beta: FlexTensor,
        epsilon: f32,
        relu: bool,
    ) -> (FlexTensor, FlexTensor, FlexTensor) {
        let [x, gamma, beta] = [x, gamma, beta].map(contiguous);
        let [channels] = dims(&gamma);
        let mut y = buffer(values(&x).len());
        let [mut mean, mut variance] = [buffer(channels), buffer(channels)];
        batch_norm::forward_train(
            Isa::current(),
            values(&x),
            BatchNorm {
                gamma: values(&gamma),
                beta: values(&beta),
                epsilon,
                relu,
            },
            &mut y,
            Moments {
                mean: &mut mean,
                variance: &mut variance,
            },
        );
        (
            tensor(y, dims::<4>(&x)),
            tensor(mean, [channels]),
            tensor(variance, [channels]),
        )
    }

    fn rel_mse_of_gamma(
        out_gamma: FlexTensor,
        ref_hdr: FlexTensor,
        gamma: f32,
        epsilon: f32,
    ) -> FlexTensor {
        let [out_gamma, ref_hdr] = [out_gamma, ref_hdr].map(contiguous);
        rel_mse_into(&out_gamma, &ref_hdr, gamma, epsilon, None)
    }
}

/// A convolution that keeps the size.
///
/// # Shapes
/// Maps `[B, H, W, in]`, weight `[out, in, side, side]`, and bias `[out]` to `[B, H, W, out]`.
fn convolution(
    kernel: fn(Isa, Grid, &[f32], Convolution, &mut [f32]),
    operands: [FlexTensor; 3],
    relu: bool,
) -> FlexTensor {
    let [x, weight, bias] = operands.map(contiguous);
    let (grid, _) = grid(&x);
    let [outputs, ..] = dims::<4>(&weight);
    let mut y = buffer(grid.pixels() * outputs);
    let convolution = Convolution {
        weight: values(&weight),
        bias: values(&bias),
        relu,
    };
    kernel(Isa::current(), grid, values(&x), convolution, &mut y);
    maps(grid, y)
}

/// The loss of each image. Writes the gradient with respect to the output into `dout` where given.
///
/// # Shapes
/// Two [`contiguous`] `[B, C, H, W]` to `[B]`; `dout` has the values of `[B, C, H, W]`.
pub(super) fn rel_mse_into(
    out_gamma: &FlexTensor,
    ref_hdr: &FlexTensor,
    gamma: f32,
    epsilon: f32,
    dout: Option<&mut [f32]>,
) -> FlexTensor {
    let [batch, channels, height, width] = dims(out_gamma);
    let image = channels * height * width;
    let images = values(out_gamma)
        .chunks(image)
        .zip(values(ref_hdr).chunks(image));
    let scale = RelMse {
        pixels: height * width,
        gamma,
        epsilon,
    };
    let loss = |out: &[f32], reference: &[f32], dout: Option<&mut [f32]>| {
        rel_mse::loss(Isa::current(), out, reference, scale, dout) as f32
    };
    let losses: Vec<f32> = match dout {
        Some(dout) => images
            .zip(dout.chunks_mut(image))
            .map(|((out, reference), dout)| loss(out, reference, Some(dout)))
            .collect(),
        None => images
            .map(|(out, reference)| loss(out, reference, None))
            .collect(),
    };
    tensor(losses, [batch])
}

pub(super) fn fuse<const P: usize>(
    parts: [FlexTensor; P],
    weight: FlexTensor,
    bias: FlexTensor,
    relu: bool,
) -> FlexTensor {
    let parts = parts.map(contiguous);
    let [weight, bias] = [weight, bias].map(contiguous);
    let (grid, _) = grid(&parts[0]);
    let [outputs, ..] = dims::<4>(&weight);
    let mut y = buffer(grid.pixels() * outputs);
    conv1x1::forward(
        Isa::current(),
        grid,
        &parts.each_ref().map(values),
        Convolution {
            weight: values(&weight),
            bias: values(&bias),
            relu,
        },
        &mut y,
    );
    maps(grid, y)
}
