//! Every operation of `ops` on `flex`: outputs and gradients of the kernels against those of Burn.

mod random;

use self::random::{RandomTensors, device, host};
use burn::module::Param;
use burn::nn::BatchNorm;
use burn::tensor::{Device, Tensor};
use demc_model::LossConfig;
use demc_model::Ops;
use demc_model::ops::update::{AdamConstants, AdamMoments, moving_average, sum_of_squares};
use demc_model::ops::{Activation, Maps};

/// Tolerance as a share of the largest value: sums of a few hundred float32 products in two orders.
const TOLERANCE: f32 = 1e-5;

/// Height and width: odd, even, a single row, a single pixel.
const SIZES: [[usize; 2]; 4] = [[5, 7], [8, 6], [1, 9], [1, 1]];
const BATCHES: [usize; 2] = [1, 3];
const CHANNELS: [usize; 3] = [1, 3, 17];
const ACTIVATIONS: [Activation; 2] = [Activation::None, Activation::Relu];

type NamedTensors = Vec<(String, Vec<f32>)>;

/// Runs `op` on inputs of `shapes` and sums its output with random weights. Returns the output and
/// the inputs' gradients by name, and all gradients.
fn run(
    ops: Ops,
    shapes: &[[usize; 4]],
    random: &mut RandomTensors,
    op: impl Fn(Vec<Maps>) -> Maps,
) -> (NamedTensors, burn::tensor::Gradients) {
    let inputs: Vec<Tensor<4>> = shapes
        .iter()
        .map(|shape| random.tensor(*shape, &device()).require_grad())
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
    let probe = random.tensor(dims, &device());
    let gradients = (output.clone() * probe).sum().backward();
    let mut found = vec![("output".to_string(), host(output))];
    for (i, input) in inputs.iter().enumerate() {
        let gradient = input.grad(&gradients).expect("a gradient of every input");
        found.push((format!("gradient of input {i}"), host(gradient)));
    }
    (found, gradients)
}

fn gradient<const D: usize>(
    name: &str,
    param: &Param<Tensor<D>>,
    gradients: &burn::tensor::Gradients,
) -> (String, Vec<f32>) {
    let gradient = param
        .val()
        .grad(gradients)
        .expect("a gradient of every parameter");
    (format!("gradient of {name}"), host(gradient))
}

fn same(what: &str, run: impl Fn(Ops) -> NamedTensors) {
    let [kernels, burn] = Ops::ALL.map(run);
    assert_eq!(kernels.len(), burn.len());
    for ((name, found), (_, expected)) in kernels.iter().zip(&burn) {
        assert_eq!(found.len(), expected.len(), "{what}: {name}");
        let largest = expected.iter().fold(0.0f32, |m, v| m.max(v.abs()));
        for (i, (f, e)) in found.iter().zip(expected).enumerate() {
            assert!(
                (f - e).abs() <= TOLERANCE * largest.max(1e-3),
                "{what}: {name}[{i}]: kernels {f}, Burn {e}, largest {largest}"
            );
        }
    }
}

/// All combinations of sizes, batches, channels in and out, and activations.
fn every_case(check: impl Fn(&str, [usize; 4], usize, Activation)) {
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
fn convolutions_agree_with_burn() {
    every_case(|what, shape, output, activation| {
        for side in [3, 5] {
            same(&format!("{side}x{side}, {what}"), |ops| {
                let mut random = RandomTensors::new();
                let conv = random.conv([shape[1], output], side);
                let op = |mut x: Vec<Maps>| match side {
                    3 => x.remove(0).conv3x3(&conv, activation),
                    _ => x.remove(0).conv5x5(&conv, activation),
                };
                let (mut found, gradients) = run(ops, &[shape], &mut random, op);
                found.push(gradient("weight", &conv.weight, &gradients));
                let bias = conv.bias.as_ref().expect("a bias");
                found.push(gradient("bias", bias, &gradients));
                found
            });
        }
    });
}

#[test]
fn filters_agree_with_burn() {
    for size in SIZES {
        for batch in BATCHES {
            for logits in [25, 26, 441] {
                let shape = [batch, logits, size[0], size[1]];
                same(&format!("{shape:?}"), |ops| {
                    let mut random = RandomTensors::new();
                    let image = random.tensor([batch, 3, size[0], size[1]], &device());
                    let op = |mut logits: Vec<Maps>| {
                        Maps::from_nchw(image.clone(), ops).filter(logits.remove(0))
                    };
                    run(ops, &[shape], &mut random, op).0
                });
            }
        }
    }
}

#[test]
fn deconvolution_agrees_with_burn() {
    every_case(|what, shape, output, activation| {
        same(what, |ops| {
            let mut random = RandomTensors::new();
            let deconv = random.deconv([shape[1], output]);
            let op = |mut x: Vec<Maps>| x.remove(0).deconv4x4(&deconv, activation);
            let (mut found, gradients) = run(ops, &[shape], &mut random, op);
            found.push(gradient("weight", &deconv.weight, &gradients));
            let bias = deconv.bias.as_ref().expect("a bias");
            found.push(gradient("bias", bias, &gradients));
            found
        });
    });
}

#[test]
fn fusion_of_two_and_three_parts_agrees_with_burn() {
    for parts in [2, 3] {
        every_case(|what, shape, output, activation| {
            // Parts of different widths.
            let shapes: Vec<_> = (0..parts)
                .map(|i| [shape[0], shape[1] + i, shape[2], shape[3]])
                .collect();
            let input = shapes.iter().map(|shape| shape[1]).sum();
            same(&format!("{parts} parts, {what}"), |ops| {
                let mut random = RandomTensors::new();
                let conv = random.conv([input, output], 1);
                let op = |parts| Maps::fuse(parts, &conv, activation);
                let (mut found, gradients) = run(ops, &shapes, &mut random, op);
                found.push(gradient("weight", &conv.weight, &gradients));
                let bias = conv.bias.as_ref().expect("a bias");
                found.push(gradient("bias", bias, &gradients));
                found
            });
        });
    }
}

#[test]
fn max_pooling_agrees_with_burn() {
    for [height, width] in [[4, 6], [5, 7], [2, 2], [16, 8]] {
        for batch in BATCHES {
            for channels in CHANNELS {
                let shape = [batch, channels, height, width];
                same(&format!("{shape:?}"), |ops| {
                    let op = |mut x: Vec<Maps>| x.remove(0).max_pool();
                    run(ops, &[shape], &mut RandomTensors::new(), op).0
                });
            }
        }
    }
}

#[test]
fn concatenation_agrees_with_burn() {
    let shapes = [[3, 3, 5, 7], [3, 1, 5, 7]];
    same("3 and 1 channels", |ops| {
        run(ops, &shapes, &mut RandomTensors::new(), Maps::cat).0
    });
}

/// Output, gradients and running statistics after two training passes.
#[test]
fn batch_normalisation_agrees_with_burn() {
    for [height, width] in [[5, 7], [8, 6], [1, 9]] {
        for batch in BATCHES {
            for channels in CHANNELS {
                for activation in ACTIVATIONS {
                    let shape = [batch, channels, height, width];
                    same(&format!("{shape:?}, {activation:?}"), |ops| {
                        let mut random = RandomTensors::new();
                        let norm = random.norm(channels);
                        let op = |mut x: Vec<Maps>| x.remove(0).batch_norm(&norm, activation);
                        run(ops, &[shape], &mut random, op);
                        let (mut found, gradients) = run(ops, &[shape], &mut random, op);
                        found.push(gradient("gamma", &norm.gamma, &gradients));
                        found.push(gradient("beta", &norm.beta, &gradients));
                        // The second pass merges one update, `value_sync` the other.
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

/// A frozen normalisation under autodiff and one without autodiff use the running statistics
/// unchanged.
#[test]
fn batch_normalisation_outside_training_agrees_with_burn() {
    use burn::module::Module;
    for activation in ACTIVATIONS {
        same("frozen", |ops| {
            let mut random = RandomTensors::new();
            let norm = BatchNorm {
                training: Param::from_bool(false),
                ..random.norm(3)
            };
            let op = |mut x: Vec<Maps>| x.remove(0).batch_norm(&norm, activation);
            let (mut found, gradients) = run(ops, &[[2, 3, 5, 7]], &mut random, op);
            found.push(gradient("gamma", &norm.gamma, &gradients));
            found.push(("mean".into(), host(norm.running_mean.value_sync())));
            found
        });
        same("without autodiff", |ops| {
            let mut random = RandomTensors::new();
            let norm = random.norm(17).valid();
            let x = random.tensor([2, 17, 5, 7], &Device::flex());
            let y = Maps::from_nchw(x, ops).batch_norm(&norm, activation);
            vec![("output".into(), host(y.into_nchw()))]
        });
    }
}

/// The images have black and white pixels: a power has no gradient at 0.
#[test]
fn loss_agrees_with_burn() {
    for shape in [[1, 3, 5, 7], [3, 3, 32, 32]] {
        same(&format!("{shape:?}"), |ops| {
            let mut random = RandomTensors::new();
            let output = random
                .tensor(shape, &device())
                .clamp_min(0.0)
                .require_grad();
            let reference = random.tensor(shape, &device()).clamp_min(0.0) * 3.0;
            // Half of the loss, as with gradient accumulation.
            let config = LossConfig::default();
            let loss = config.per_image(ops, output.clone(), reference, 2.2).mean() / 2.0;
            let gradients = loss.backward();
            let gradient = output.grad(&gradients).expect("a gradient of the output");
            vec![
                ("loss".into(), host(loss)),
                ("gradient".into(), host(gradient)),
            ]
        });
    }
}

/// An input that needs no gradient gets none; the weights of the same operation get theirs.
#[test]
fn an_input_without_gradient_gets_none() {
    let mut random = RandomTensors::new();
    let conv = random.conv([3, 2], 3);
    let x = random.tensor([1, 3, 4, 4], &device());
    let y = Maps::from_nchw(x.clone(), Ops::Kernels).conv3x3(&conv, Activation::Relu);
    let gradients = y.into_nchw().sum().backward();
    assert!(x.grad(&gradients).is_none());
    assert!(conv.weight.val().grad(&gradients).is_some());
}

#[test]
fn adam_steps_agree_with_burn() {
    let adam = AdamConstants {
        beta_1: 0.9,
        beta_2: 0.999,
        epsilon: 1e-8,
    };
    same("Adam", |ops| {
        let mut random = RandomTensors::new();
        let device = Device::flex();
        let mut weight = random.tensor([17, 3, 3, 3], &device);
        let mut moments: Option<AdamMoments> = None;
        for steps in 0..5 {
            let grad = random.tensor([17, 3, 3, 3], &device);
            let (stepped, after) = adam.step(ops, 1e-2, steps, weight, grad, moments);
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

/// The step works in place, so it copies a tensor that is also held elsewhere.
#[test]
fn a_step_of_adam_does_not_change_other_copies() {
    let mut random = RandomTensors::new();
    let adam = AdamConstants {
        beta_1: 0.9,
        beta_2: 0.999,
        epsilon: 1e-8,
    };
    let weight = random.tensor([100], &Device::flex());
    let before = host(weight.clone());
    let held = weight.clone();
    let grad = Tensor::<1>::ones([100], &Device::flex());
    let (stepped, _) = adam.step(Ops::Kernels, 0.1, 0, weight, grad, None);
    assert_ne!(host(stepped), before);
    assert_eq!(host(held), before);
}

#[test]
fn sum_of_squares_agrees_with_float64() {
    let mut random = RandomTensors::new();
    let tensors = [
        random.tensor([100_000], &Device::flex()),
        random.tensor([3], &Device::flex()),
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
    // Burn sums in float32.
    let burn = sum_of_squares(Ops::Burn, tensors.to_vec());
    assert!((burn / expected - 1.0).abs() < 1e-5, "{burn} {expected}");
}

#[test]
fn moving_average_agrees_with_burn() {
    same("moving average", |ops| {
        let mut random = RandomTensors::new();
        let [average, live] = [(); 2].map(|()| random.tensor([17, 3], &Device::flex()));
        let moved = moving_average(ops, average, live, 0.1);
        vec![("average".into(), host(moved))]
    });
}
