//! Every operation of `ops`, kernels against Burn's own on `flex`: outputs and every gradient.

mod draw;

use burn::module::Param;
use burn::nn::BatchNorm;
use burn::tensor::{Device, Tensor};
use demc_model::Loss;
use demc_model::Ops;
use demc_model::ops::adam::{Moments, Rule, sum_of_squares};
use demc_model::ops::{Activation, Maps};
use draw::{Draw, device, host};

/// Sums of some hundred float32 products in two orders.
const OF_LARGEST: f32 = 1e-5;

/// `[height, width]`: odd, even, a single row, a single pixel.
const SIZES: [[usize; 2]; 4] = [[5, 7], [8, 6], [1, 9], [1, 1]];
const BATCHES: [usize; 2] = [1, 3];
const CHANNELS: [usize; 3] = [1, 3, 17];
const ACTIVATIONS: [Activation; 2] = [Activation::None, Activation::Relu];

/// What a run of one operation found: a name and the values of each tensor.
type Found = Vec<(String, Vec<f32>)>;

/// Runs `op` on inputs of `shapes` and sums its output with random weights. Returns output and gradients of the inputs,
/// and the gradients for the parameters' own.
fn run(
    ops: Ops,
    shapes: &[[usize; 4]],
    draw: &mut Draw,
    op: impl Fn(Vec<Maps>) -> Maps,
) -> (Found, burn::tensor::Gradients) {
    let inputs: Vec<Tensor<4>> = shapes
        .iter()
        .map(|shape| draw.tensor(*shape, &device()).require_grad())
        .collect();
    let maps = inputs
        .iter()
        .map(|x| Maps::from_nchw(x.clone(), ops))
        .collect();
    let maps = op(maps);
    assert_eq!(maps.ops(), ops);
    let dims = maps.dims();
    let output = maps.into_nchw();
    assert_eq!(output.dims(), dims);
    let probe = draw.tensor(dims, &device());
    let gradients = (output.clone() * probe).sum().backward();
    let mut found = vec![("output".to_string(), host(output))];
    for (i, input) in inputs.iter().enumerate() {
        let gradient = input.grad(&gradients).expect("by every input");
        found.push((format!("gradient by input {i}"), host(gradient)));
    }
    (found, gradients)
}

fn gradient<const D: usize>(
    name: &str,
    param: &Param<Tensor<D>>,
    gradients: &burn::tensor::Gradients,
) -> (String, Vec<f32>) {
    let gradient = param.val().grad(gradients).expect("by every parameter");
    (format!("gradient by {name}"), host(gradient))
}

/// Asserts that both kinds of operations find the same.
fn same(what: &str, find: impl Fn(Ops) -> Found) {
    let [kernels, burn] = Ops::ALL.map(find);
    assert_eq!(kernels.len(), burn.len());
    for ((name, found), (_, expected)) in kernels.iter().zip(&burn) {
        assert_eq!(found.len(), expected.len(), "{what}: {name}");
        let largest = expected.iter().fold(0.0f32, |m, v| m.max(v.abs()));
        for (i, (f, e)) in found.iter().zip(expected).enumerate() {
            assert!(
                (f - e).abs() <= OF_LARGEST * largest.max(1e-3),
                "{what}: {name}[{i}]: {f} by the kernels, {e} by Burn, largest {largest}"
            );
        }
    }
}

/// All sizes, batches, channels in and out, and activations.
fn everywhere(check: impl Fn(&str, [usize; 4], usize, Activation)) {
    for size in SIZES {
        for batch in BATCHES {
            for input in CHANNELS {
                for output in CHANNELS {
                    for activation in ACTIVATIONS {
                        let shape = [batch, input, size[0], size[1]];
                        let what = format!("{shape:?} to {output}, {activation:?}");
                        check(&what, shape, output, activation);
                    }
                }
            }
        }
    }
}

#[test]
fn convolution_is_burns() {
    everywhere(|what, shape, output, activation| {
        same(what, |ops| {
            let mut draw = Draw::new();
            let conv = draw.conv([shape[1], output], 3);
            let op = |mut x: Vec<Maps>| x.remove(0).conv3x3(&conv, activation);
            let (mut found, gradients) = run(ops, &[shape], &mut draw, op);
            found.push(gradient("weight", &conv.weight, &gradients));
            let bias = conv.bias.as_ref().expect("a bias");
            found.push(gradient("bias", bias, &gradients));
            found
        });
    });
}

#[test]
fn deconvolution_is_burns() {
    everywhere(|what, shape, output, activation| {
        same(what, |ops| {
            let mut draw = Draw::new();
            let deconv = draw.deconv([shape[1], output]);
            let op = |mut x: Vec<Maps>| x.remove(0).deconv4x4(&deconv, activation);
            let (mut found, gradients) = run(ops, &[shape], &mut draw, op);
            found.push(gradient("weight", &deconv.weight, &gradients));
            let bias = deconv.bias.as_ref().expect("a bias");
            found.push(gradient("bias", bias, &gradients));
            found
        });
    });
}

#[test]
fn fusion_of_two_and_three_parts_is_burns() {
    for parts in [2, 3] {
        everywhere(|what, shape, output, activation| {
            // Parts of different widths.
            let shapes: Vec<_> = (0..parts)
                .map(|i| [shape[0], shape[1] + i, shape[2], shape[3]])
                .collect();
            let input = shapes.iter().map(|shape| shape[1]).sum();
            same(&format!("{parts} parts, {what}"), |ops| {
                let mut draw = Draw::new();
                let conv = draw.conv([input, output], 1);
                let op = |parts| Maps::fuse(parts, &conv, activation);
                let (mut found, gradients) = run(ops, &shapes, &mut draw, op);
                found.push(gradient("weight", &conv.weight, &gradients));
                let bias = conv.bias.as_ref().expect("a bias");
                found.push(gradient("bias", bias, &gradients));
                found
            });
        });
    }
}

#[test]
fn max_pooling_is_burns() {
    for [height, width] in [[4, 6], [5, 7], [2, 2], [16, 8]] {
        for batch in BATCHES {
            for channels in CHANNELS {
                let shape = [batch, channels, height, width];
                same(&format!("{shape:?}"), |ops| {
                    let op = |mut x: Vec<Maps>| x.remove(0).max_pool();
                    run(ops, &[shape], &mut Draw::new(), op).0
                });
            }
        }
    }
}

#[test]
fn concatenation_is_burns() {
    let shapes = [[3, 3, 5, 7], [3, 1, 5, 7]];
    same("3 and 1 channels", |ops| {
        run(ops, &shapes, &mut Draw::new(), Maps::cat).0
    });
}

/// Statistics of the batch, their gradients, and the running ones after two passes.
#[test]
fn batch_normalisation_is_burns() {
    for [height, width] in [[5, 7], [8, 6], [1, 9]] {
        for batch in BATCHES {
            for channels in CHANNELS {
                for activation in ACTIVATIONS {
                    let shape = [batch, channels, height, width];
                    same(&format!("{shape:?}, {activation:?}"), |ops| {
                        let mut draw = Draw::new();
                        let norm = draw.norm(channels);
                        let op = |mut x: Vec<Maps>| x.remove(0).batch_norm(&norm, activation);
                        run(ops, &[shape], &mut draw, op);
                        let (mut found, gradients) = run(ops, &[shape], &mut draw, op);
                        found.push(gradient("gamma", &norm.gamma, &gradients));
                        found.push(gradient("beta", &norm.beta, &gradients));
                        // Twice: merged by the second pass, and by the question.
                        for (name, state) in [
                            ("mean", &norm.running_mean),
                            ("variance", &norm.running_var),
                        ] {
                            found.push((format!("late {name}"), host(state.value())));
                            found.push((format!("running {name}"), host(state.value_sync())));
                        }
                        found
                    });
                }
            }
        }
    }
}

/// Frozen under autodiff and plain: the running statistics, which stay as they are.
#[test]
fn batch_normalisation_outside_training_is_burns() {
    use burn::module::Module;
    for activation in ACTIVATIONS {
        same("frozen", |ops| {
            let mut draw = Draw::new();
            let norm = BatchNorm {
                training: Param::from_bool(false),
                ..draw.norm(3)
            };
            let op = |mut x: Vec<Maps>| x.remove(0).batch_norm(&norm, activation);
            let (mut found, gradients) = run(ops, &[[2, 3, 5, 7]], &mut draw, op);
            found.push(gradient("gamma", &norm.gamma, &gradients));
            found.push(("mean".into(), host(norm.running_mean.value_sync())));
            found
        });
        same("plain", |ops| {
            let mut draw = Draw::new();
            let norm = draw.norm(17).valid();
            let x = draw.tensor([2, 17, 5, 7], &Device::flex());
            let y = Maps::from_nchw(x, ops).batch_norm(&norm, activation);
            vec![("output".into(), host(y.into_nchw()))]
        });
    }
}

/// Black and white pixels among them: a power has no gradient at 0.
#[test]
fn loss_is_burns() {
    for shape in [[1, 3, 5, 7], [3, 3, 32, 32]] {
        same(&format!("{shape:?}"), |ops| {
            let mut draw = Draw::new();
            let output = draw.tensor(shape, &device()).clamp_min(0.0).require_grad();
            let reference = draw.tensor(shape, &device()).clamp_min(0.0) * 3.0;
            // Half of it, as with gradient accumulation.
            let loss = Loss::RelMse.per_image(ops, output.clone(), reference, 2.2, 1e-3);
            let loss = loss.mean() / 2.0;
            let gradients = loss.backward();
            let gradient = output.grad(&gradients).expect("by the output");
            vec![
                ("loss".into(), host(loss)),
                ("gradient".into(), host(gradient)),
            ]
        });
    }
}

/// An input that nobody asks about gets no gradient, and its neighbours still get theirs.
#[test]
fn an_input_without_gradient_gets_none() {
    let mut draw = Draw::new();
    let conv = draw.conv([3, 2], 3);
    let x = draw.tensor([1, 3, 4, 4], &device());
    let y = Maps::from_nchw(x.clone(), Ops::Kernels).conv3x3(&conv, Activation::Relu);
    let gradients = y.into_nchw().sum().backward();
    assert!(x.grad(&gradients).is_none());
    assert!(conv.weight.val().grad(&gradients).is_some());
}

#[test]
fn steps_of_adam_are_burns() {
    let rule = Rule {
        beta_1: 0.9,
        beta_2: 0.999,
        epsilon: 1e-8,
    };
    same("Adam", |ops| {
        let mut draw = Draw::new();
        let plain = Device::flex();
        let mut weight = draw.tensor([17, 3, 3, 3], &plain);
        let mut moments: Option<Moments> = None;
        for steps in 0..5 {
            let grad = draw.tensor([17, 3, 3, 3], &plain);
            let (stepped, after) = rule.step(ops, 1e-2, steps, weight, grad, moments);
            weight = stepped;
            moments = Some(after);
        }
        let moments = moments.expect("five steps were taken");
        vec![
            ("weight".into(), host(weight)),
            ("first moment".into(), host(moments.first)),
            ("second moment".into(), host(moments.second)),
        ]
    });
}

/// The step is in place, so whoever else holds the weight must have been left alone.
#[test]
fn a_step_of_adam_leaves_other_holders_alone() {
    let mut draw = Draw::new();
    let rule = Rule {
        beta_1: 0.9,
        beta_2: 0.999,
        epsilon: 1e-8,
    };
    let weight = draw.tensor([100], &Device::flex());
    let before = host(weight.clone());
    let held = weight.clone();
    let grad = Tensor::<1>::ones([100], &Device::flex());
    let (stepped, _) = rule.step(Ops::Kernels, 0.1, 0, weight, grad, None);
    assert_ne!(host(stepped), before);
    assert_eq!(host(held), before);
}

#[test]
fn sum_of_squares_is_that_of_float64() {
    let mut draw = Draw::new();
    let tensors = [
        draw.tensor([100_000], &Device::flex()),
        draw.tensor([3], &Device::flex()),
    ];
    let expected: f64 = tensors
        .iter()
        .flat_map(|tensor| host(tensor.clone()))
        .map(|v| f64::from(v) * f64::from(v))
        .sum();
    let kernels = sum_of_squares(Ops::Kernels, tensors.to_vec());
    assert!(
        (kernels / expected - 1.0).abs() < 1e-12,
        "{kernels} {expected}"
    );
    // One of float32 sums.
    let burn = sum_of_squares(Ops::Burn, tensors.to_vec());
    assert!((burn / expected - 1.0).abs() < 1e-5, "{burn} {expected}");
}
