//! Parity of single blocks: the parts of a DEMC with the weights of the fixture `demc-READING`,
//! each with its own inputs.
//!
//! The loss is `sum(outputs * probes)` with random probes, so that no gradient is trivial.

use std::collections::BTreeMap;

use burn::optim::GradientsParams;
use burn::tensor::{Device, Tensor};
use demc_model::LossConfig;
use demc_model::dual_encoder::DualEncoder;
use demc_model::ops::{self, Activation, Maps};
use demc_model::{Denoiser, Reading, Variant};

use super::{GRADIENT, OUTPUT};
use crate::fixture::{
    Fixture, config, gradients_by_name, host, is_bias_before_norm, network, network_name,
};
use crate::tensors::{Tolerance, assert_close};

type BlockForward = fn(&Denoiser, Vec<Maps>) -> Vec<Maps>;

#[test]
fn fusion_is_pytorchs() {
    let forward: BlockForward = |model, inputs| {
        let fusion = encoders_of(model)
            .fusion
            .as_ref()
            .expect("a DEMC has a fusion");
        inputs.into_iter().map(|x| fusion.forward(x)).collect()
    };
    in_both_readings("fusion", forward);
}

#[test]
fn encoder_level_is_pytorchs() {
    in_both_readings("encoders.1.levels.1", |model, inputs| {
        encode(model, [1, 1], inputs)
    });
}

#[test]
fn last_level_of_the_feature_encoder_is_pytorchs() {
    in_both_readings("encoders.0.levels.4", |model, inputs| {
        encode(model, [0, 4], inputs)
    });
}

#[test]
fn latent_is_pytorchs() {
    let forward: BlockForward = |model, inputs| {
        inputs
            .into_iter()
            .map(|x| encoders_of(model).latent.forward(x))
            .collect()
    };
    in_both_readings("latent", forward);
}

#[test]
fn decoder_level_is_pytorchs() {
    let forward: BlockForward = |model, mut inputs| {
        let skips = inputs.split_off(1);
        inputs
            .into_iter()
            .map(|x| encoders_of(model).decoder.levels[3].forward(x, skips.clone()))
            .collect()
    };
    in_both_readings("decoder.levels.3", forward);
}

#[test]
fn head_is_pytorchs() {
    // The ReLU belongs to the decoder.
    let forward: BlockForward = |model, inputs| {
        inputs
            .into_iter()
            .map(|x| {
                let head = encoders_of(model)
                    .decoder
                    .head
                    .as_ref()
                    .expect("a convolution");
                match head.kernel_size {
                    [1, 1] => x.conv1x1(head),
                    _ => x.conv3x3(head, Activation::None),
                }
            })
            .collect()
    };
    in_both_readings("decoder.head", forward);
}

#[test]
fn loss_and_its_gradient_are_pytorchs_at_black_pixels_too() {
    let fixture = Fixture::read("blocks");
    let device = super::device().autodiff();
    let output = fixture.tensor("loss/output_gamma", &device).require_grad();
    let reference = fixture.tensor("loss/reference_hdr", &device);
    let ops = ops::process_default();
    let losses = LossConfig::default().per_image(ops, output.clone(), reference, 2.2);
    let loss = losses.mean();
    assert_close(
        "loss",
        &host(loss.clone()),
        fixture.values("loss/loss"),
        OUTPUT,
    );
    let gradient = output
        .grad(&loss.backward())
        .expect("the loss depends on the output");
    assert_close(
        "gradient",
        &host(gradient),
        fixture.values("loss/grad"),
        GRADIENT,
    );
}

fn encoders_of(model: &Denoiser) -> &DualEncoder {
    model.dual_encoder().expect("a variant with encoders")
}

fn encode(model: &Denoiser, [encoder, level]: [usize; 2], inputs: Vec<Maps>) -> Vec<Maps> {
    let level = &encoders_of(model).encoders[encoder].levels[level];
    let outputs = inputs.into_iter().map(|x| level.forward(x));
    outputs
        .flat_map(|(skip, below)| std::iter::once(skip).chain(below))
        .collect()
}

fn run(model: &Denoiser, forward: BlockForward, inputs: Vec<Tensor<4>>) -> Vec<Tensor<4>> {
    let inputs = inputs.into_iter().map(|x| Maps::from_nchw(x, model.ops()));
    let outputs = forward(model, inputs.collect());
    outputs.into_iter().map(Maps::into_nchw).collect()
}

fn in_both_readings(path: &str, forward: BlockForward) {
    let fixture = Fixture::read("blocks");
    for reading in Reading::ALL {
        let share = check(&fixture, reading, path, forward);
        println!(
            "{} {path}: shares of the tolerances: {share}",
            reading.spec().name
        );
    }
}

fn check(fixture: &Fixture, reading: Reading, path: &str, forward: BlockForward) -> String {
    let weights = Fixture::read(&network_name(&config(Variant::Demc, reading)));
    let block = Block {
        fixture,
        reading,
        path,
        prefix: format!("{}/{path}", reading.spec().name),
    };
    let network = |device: &Device| network(&config(Variant::Demc, reading), &weights, device);

    let device = super::device();
    let inputs = fixture.list(&format!("{}/input", block.prefix), &device);
    let eval = block.outputs("eval", &run(&network(&device), forward, inputs));

    let device = device.autodiff();
    let model = network(&device);
    let inputs: Vec<_> = fixture
        .list(&format!("{}/input", block.prefix), &device)
        .into_iter()
        .map(Tensor::require_grad)
        .collect();
    let outputs = run(&model, forward, inputs.clone());
    let train = block.outputs("train", &outputs);

    let probes = fixture.list(&format!("{}/probe", block.prefix), &device);
    let parts = outputs
        .into_iter()
        .zip(probes)
        .map(|(output, probe)| (output * probe).sum());
    let mut gradients = parts
        .reduce(|a, b| a + b)
        .expect("a block has an output")
        .backward();
    let input_grads: Vec<_> = inputs
        .iter()
        .map(|input| {
            let gradient = input.grad(&gradients);
            host(gradient.expect("the outputs depend on each input"))
        })
        .collect();
    let weight_grads = gradients_by_name(
        &model,
        &GradientsParams::from_module(&mut gradients, &model),
    );
    let worst = block
        .input_gradients(&input_grads)
        .max(block.weight_gradients(&weight_grads));
    block.running_statistics(&model);
    format!("eval {eval:.3}, train {train:.3}, gradients {worst:.3}")
}

/// A block of a network, and what PyTorch computes for it.
struct Block<'a> {
    fixture: &'a Fixture,
    reading: Reading,
    path: &'a str,
    /// Of its names in the fixture.
    prefix: String,
}

/// Each comparison returns the largest share of its tolerance.
impl Block<'_> {
    fn outputs(&self, mode: &str, outputs: &[Tensor<4>]) -> f32 {
        let prefix = &self.prefix;
        let expected = self
            .fixture
            .list(&format!("{prefix}/{mode}"), &super::device());
        assert_eq!(outputs.len(), expected.len(), "{prefix}: number of outputs");
        let pairs = outputs.iter().zip(expected).map(|(found, expected)| {
            assert_eq!(found.dims(), expected.dims(), "{prefix}");
            assert_close(
                &format!("{prefix} {mode}"),
                &host(found.clone()),
                &host(expected),
                OUTPUT,
            )
        });
        pairs.fold(0.0, f32::max)
    }

    fn input_gradients(&self, found: &[Vec<f32>]) -> f32 {
        let shares = found.iter().enumerate().map(|(i, found)| {
            let name = format!("{}/input_grad.{i}", self.prefix);
            assert_close(&name, found, self.fixture.values(&name), GRADIENT)
        });
        shares.fold(0.0, f32::max)
    }

    fn weight_gradients(&self, found: &BTreeMap<String, Vec<f32>>) -> f32 {
        let prefix = &self.prefix;
        let expected: BTreeMap<_, _> = self
            .fixture
            .group(&format!("{prefix}/grad."))
            .into_iter()
            .map(|w| (format!("{}.{}", self.path, w.name), w.data))
            .collect();
        assert!(
            found.keys().eq(expected.keys()),
            "{prefix}: every parameter has a gradient, and nothing else"
        );
        let shares = expected.iter().map(|(name, expected)| {
            let tolerance = if is_bias_before_norm(name, self.reading) {
                // Zero by construction: gradients of the other parameters are of order 1 to 1000.
                Tolerance {
                    absolute: 1e-3,
                    ..GRADIENT
                }
            } else {
                GRADIENT
            };
            let what = format!("{prefix} gradient of {name}");
            assert_close(&what, &found[name], expected, tolerance)
        });
        shares.fold(0.0, f32::max)
    }

    fn running_statistics(&self, model: &Denoiser) {
        let after: BTreeMap<_, _> = model
            .weights()
            .into_iter()
            .map(|w| (w.name, w.data))
            .collect();
        for running in self.fixture.group(&format!("{}/after.", self.prefix)) {
            let name = format!("{}.{}", self.path, running.name);
            assert_close(
                &format!("{name} after one pass"),
                &after[&name],
                &running.data,
                OUTPUT,
            );
        }
    }
}
