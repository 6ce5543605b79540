//! Whole networks: outputs in both modes, loss, gradients, Adam.

use std::collections::BTreeMap;

use burn::optim::{AdamConfig, GradientsParams};
use burn::tensor::{Device, Tensor};
use demc_model::Loss;
use demc_model::metrics::LOSS_EPSILON;
use demc_model::{Denoiser, Ops, Reading, Variant, ops};

use crate::fixture::{
    Fixture, gradients_by_name, host, is_bias_before_norm, network, network_name,
};
use crate::tensors::{Tolerance, assert_close};
use crate::{GRADIENT, OUTPUT};

const STEPS: usize = 5;
const LEARNING_RATE: f64 = 1e-3;

/// A weight whose gradient keeps its sign moves by a learning rate a step; 2 % of that. Adam divides by the
/// gradient's own size, so the smallest gradients bring their rounding error along in full.
const ADAM: Tolerance = Tolerance {
    absolute: 1e-4,
    of_largest: 0.0,
    of_value: 0.0,
};

/// Where the gradient is exactly 0, as it is for some weights on the deepest maps of 2x2 pixels, the kernels' weight gradient
/// (Winograd's, a sum that cancels) leaves 1e-9, of which Adam's epsilon of 1e-8 makes a step: measured 6e-4, and 1e-3 where
/// that turned a pixel on or off. So this is loose, and Burn's operations take the same steps within [`ADAM`].
const ADAM_ON_KERNELS: Tolerance = Tolerance {
    absolute: 3e-3,
    ..ADAM
};

/// A bias before a batch normalisation has no gradient but noise, which Adam blows up to a step of up to one learning rate.
const WANDERING_BIAS: Tolerance = Tolerance {
    absolute: 5e-3,
    of_largest: 0.0,
    of_value: 0.0,
};

/// The running mean contains that bias: 0.01 of 0 + 1 + 2 + 3 + 4 learning rates, and what other weights may do.
const RUNNING_MEAN: Tolerance = Tolerance {
    absolute: 1e-4 + 1e-4,
    of_largest: 0.0,
    of_value: 0.0,
};

/// The inputs and the reference, on one device.
struct Batch {
    color_gamma: Tensor<4>,
    features_z: Tensor<4>,
    reference_hdr: Tensor<4>,
}

impl Batch {
    fn read(device: &Device) -> Self {
        let inputs = Fixture::read("inputs");
        Batch {
            color_gamma: inputs.tensor("color_gamma", device),
            features_z: inputs.tensor("features_z", device),
            reference_hdr: inputs.tensor("reference_hdr", device),
        }
    }

    fn output(&self, model: &Denoiser) -> Tensor<4> {
        model.forward(self.color_gamma.clone(), self.features_z.clone())
    }

    fn loss(&self, ops: Ops, output: Tensor<4>) -> Tensor<1> {
        let reference_hdr = self.reference_hdr.clone();
        let losses = Loss::RelMse.per_image(ops, output, reference_hdr, 2.2, LOSS_EPSILON);
        losses.mean()
    }
}

#[test]
fn demc_in_the_papers_reading_is_pytorchs() {
    check(Variant::Demc, Reading::Paper);
}

#[test]
fn demc_in_the_released_reading_is_pytorchs() {
    check(Variant::Demc, Reading::Released);
}

#[test]
fn demc_nosn_in_the_papers_reading_is_pytorchs() {
    check(Variant::DemcNosn, Reading::Paper);
}

#[test]
fn demc_nosn_in_the_released_reading_is_pytorchs() {
    check(Variant::DemcNosn, Reading::Released);
}

#[test]
fn semc_in_the_papers_reading_is_pytorchs() {
    check(Variant::Semc, Reading::Paper);
}

#[test]
fn semc_in_the_released_reading_is_pytorchs() {
    check(Variant::Semc, Reading::Released);
}

#[test]
fn color_only_in_the_papers_reading_is_pytorchs() {
    check(Variant::ColorOnly, Reading::Paper);
}

#[test]
fn color_only_in_the_released_reading_is_pytorchs() {
    check(Variant::ColorOnly, Reading::Released);
}

fn check(variant: Variant, reading: Reading) {
    let name = network_name(variant, reading);
    let fixture = Fixture::read(&name);
    let eval = check_eval(variant, reading, &fixture);

    let device = crate::device().autodiff();
    let batch = Batch::read(&device);
    let model = network(variant, reading, &fixture, &device);
    let train = check_first_step(&model, &batch, reading, &fixture);

    // Models of their own: the forward pass above has moved the running statistics of the first.
    let stepped = |ops| {
        let model = network(variant, reading, &fixture, &device).with_ops(ops);
        check_adam(model, &batch, reading, &fixture)
    };
    let adam = match ops::process_default().on(&device) {
        Ops::Kernels => format!(
            "{}, on kernels: {}",
            stepped(Ops::Burn),
            stepped(Ops::Kernels)
        ),
        Ops::Burn => stepped(Ops::Burn),
    };
    println!("{name}: shares of the tolerances: eval {eval:.3}, {train}, {adam}");
}

fn check_eval(variant: Variant, reading: Reading, fixture: &Fixture) -> f32 {
    let device = crate::device();
    let model = network(variant, reading, fixture, &device);
    let output = host(Batch::read(&device).output(&model));
    assert_close(
        "output in eval mode",
        &output,
        fixture.values("output_eval"),
        OUTPUT,
    )
}

fn check_first_step(
    model: &Denoiser,
    batch: &Batch,
    reading: Reading,
    fixture: &Fixture,
) -> String {
    let output = batch.output(model);
    let loss = batch.loss(model.ops(), output.clone());
    let output_share = assert_close(
        "output",
        &host(output),
        fixture.values("output_train"),
        OUTPUT,
    );
    let loss_share = assert_close("loss", &host(loss.clone()), fixture.values("loss"), OUTPUT);

    let found = gradients_by_name(model, &GradientsParams::from_grads(loss.backward(), model));
    let expected: BTreeMap<_, _> = fixture
        .group("grad/")
        .into_iter()
        .map(|w| (w.name, w.data))
        .collect();
    assert!(
        found.keys().eq(expected.keys()),
        "every parameter has a gradient, and nothing else"
    );
    let mut worst = 0.0f32;
    for (name, expected_values) in &expected {
        let tolerance = match is_bias_before_norm(name, reading) {
            // Zero by construction: the same share, of the largest gradient of the convolution's weights.
            true => Tolerance {
                absolute: GRADIENT.of_largest * largest(&expected[&name.replace("bias", "weight")]),
                ..GRADIENT
            },
            false => GRADIENT,
        };
        worst = worst.max(assert_close(
            &format!("gradient of {name}"),
            &found[name],
            expected_values,
            tolerance,
        ));
    }
    format!("train {output_share:.3}, loss {loss_share:.3}, gradients {worst:.3}")
}

fn check_adam(mut model: Denoiser, batch: &Batch, reading: Reading, fixture: &Fixture) -> String {
    // As `demc-train` has it (Sec. 4.2; Burn's epsilon would be 1e-5).
    let mut adam = AdamConfig::new()
        .with_beta_1(0.9)
        .with_beta_2(0.999)
        .with_epsilon(1e-8)
        .init();
    for _ in 0..STEPS {
        let gradients = batch.loss(model.ops(), batch.output(&model)).backward();
        let gradients = GradientsParams::from_grads(gradients, &model);
        model = adam.step(LEARNING_RATE, model, gradients);
    }
    let found: BTreeMap<_, _> = model
        .weights()
        .into_iter()
        .map(|w| (w.name, w.data))
        .collect();
    let expected = fixture.group("adam/");
    assert_eq!(found.len(), expected.len(), "number of weights");
    let adam_tolerance = match model.ops().on(&crate::device()) {
        Ops::Kernels => ADAM_ON_KERNELS,
        Ops::Burn => ADAM,
    };
    let [mut worst, mut worst_mean] = [0.0f32; 2];
    for weight in expected {
        let what = format!("{} after {STEPS} steps", weight.name);
        let close = |tolerance| assert_close(&what, &found[&weight.name], &weight.data, tolerance);
        if is_bias_before_norm(&weight.name, reading) {
            close(WANDERING_BIAS);
        } else if weight.name.ends_with("running_mean") {
            worst_mean = worst_mean.max(close(RUNNING_MEAN));
        } else {
            worst = worst.max(close(adam_tolerance));
        }
    }
    format!("Adam {worst:.3}, running means {worst_mean:.3}")
}

fn largest(values: &[f32]) -> f32 {
    values.iter().fold(0.0, |m, v| m.max(v.abs()))
}
