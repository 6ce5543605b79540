//! Agreement of all backends of this build and machine. Outputs, loss and every gradient match
//! those of `flex` with Burn's operations.
//!
//! The backends are `flex` with our kernels on each instruction path, `flex` with Burn's
//! operations, and `ndarray`, `wgpu` and `cuda` if built and found. Weights and images are the
//! fixtures of `parity`, which tests the correct values.

use std::collections::BTreeMap;

use burn::module::Module;
use burn::optim::GradientsParams;
use burn::tensor::Device;
use demc_infer::device::{self, DeviceError};
use demc_model::LossConfig;
use demc_model::ops::{Isa, Ops};
use demc_model::{Reading, Variant};

use crate::fixture::{
    Fixture, config, gradients_by_name, host, is_bias_before_norm, network, network_name,
};
use crate::tensors::{Tolerance, assert_close};

/// Two float32 roundings of 27 layers on the CPU; a GPU fuses and orders its sums differently.
const OUTPUT: Tolerance = Tolerance {
    absolute: 0.0,
    of_largest: 2e-5,
    of_value: 0.0,
};

/// Twice the tolerance of the parity tests, once for each side.
const GRADIENT: Tolerance = Tolerance {
    absolute: 0.0,
    of_largest: 4e-5,
    of_value: 2e-4,
};

/// A device with operations and instructions.
struct Backend {
    name: String,
    device: Device,
    ops: Ops,
    isa: Option<Isa>,
}

/// All backends of this build and machine, `flex` with Burn's operations first. Prints which
/// devices are left out and why.
fn backends() -> Vec<Backend> {
    let flex = |name, ops, isa| Backend {
        name,
        device: Device::flex(),
        ops,
        isa,
    };
    let mut backends = vec![flex("flex, Burn".into(), Ops::Burn, None)];
    for isa in Isa::available() {
        backends.push(flex(
            format!("flex, kernels on {isa}"),
            Ops::Kernels,
            Some(isa),
        ));
    }
    for name in ["ndarray", "wgpu", "cuda"] {
        match device::parse(name) {
            Ok(device) => backends.push(Backend {
                name: name.into(),
                device,
                // Requested, but not available on these devices, so Burn's operations run.
                ops: Ops::Kernels,
                isa: None,
            }),
            Err(error @ (DeviceError::NotBuilt { .. } | DeviceError::Absent { .. })) => {
                println!("left out: {error}");
            }
            Err(error) => panic!("{error}"),
        }
    }
    backends
}

/// Outputs in evaluation and in training, loss, and gradients by name.
fn run(backend: &Backend, variant: Variant, reading: Reading) -> BTreeMap<String, Vec<f32>> {
    if let Some(isa) = backend.isa {
        Isa::force(isa);
    }
    let inputs = Fixture::read("inputs");
    let weights = Fixture::read(&network_name(&config(variant, reading)));
    let device = backend.device.clone().autodiff();
    let model = network(&config(variant, reading), &weights, &device).with_ops(backend.ops);
    let images = |device| ["color_gamma", "features_z"].map(|name| inputs.tensor(name, device));

    let [color_gamma, features_z] = images(&backend.device);
    let evaluated = model.valid().forward(color_gamma, features_z);
    let [color_gamma, features_z] = images(&device);
    let output = model.forward(color_gamma, features_z);
    let reference_hdr = inputs.tensor("reference_hdr", &device);
    let ops = backend.ops;
    let losses = LossConfig::default().per_image(ops, output.clone(), reference_hdr, 2.2);
    let loss = losses.mean();
    let gradients = GradientsParams::from_grads(loss.backward(), &model);
    let mut found = gradients_by_name(&model, &gradients);
    found.insert("output in evaluation".into(), host(evaluated));
    found.insert("output".into(), host(output));
    found.insert("loss".into(), host(loss));
    found
}

/// A single test, because the instruction path is global to the process.
#[test]
fn all_backends_agree() {
    let backends = backends();
    for variant in Variant::with_encoders() {
        for reading in Reading::ALL {
            let expected = run(&backends[0], variant, reading);
            for backend in &backends[1..] {
                let found = run(backend, variant, reading);
                assert!(
                    found.keys().eq(expected.keys()),
                    "{}: the same weights have gradients",
                    backend.name
                );
                let mut worst = 0.0f32;
                for (name, values) in &expected {
                    let tolerance = match name.as_str() {
                        "output" | "output in evaluation" | "loss" => OUTPUT,
                        // Zero by construction: relative to the largest gradient of the
                        // convolution's weights.
                        bias if is_bias_before_norm(bias, reading) => {
                            let weight = &expected[&bias.replace("bias", "weight")];
                            let largest = weight.iter().fold(0.0f32, |m, v| m.max(v.abs()));
                            Tolerance {
                                absolute: GRADIENT.of_largest * largest,
                                ..GRADIENT
                            }
                        }
                        _ => GRADIENT,
                    };
                    let what = format!("{}: {name}", backend.name);
                    worst = worst.max(assert_close(&what, &found[name], values, tolerance));
                }
                println!(
                    "{}, {}: share of the tolerances {worst:.3}",
                    network_name(&config(variant, reading)),
                    backend.name
                );
            }
        }
    }
}
