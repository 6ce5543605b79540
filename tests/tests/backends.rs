//! The same weights through every way to compute that this build and this machine have: `flex` with our kernels on each
//! instruction path, `flex` with Burn's operations, and `ndarray`, `wgpu`, `cuda` where they were built in and found. Outputs, loss
//! and every gradient are those of `flex` with Burn's operations.
//!
//! The weights and images are the fixtures of `parity.rs`, which knows the right numbers; this test knows the list.
#![allow(
    dead_code,
    reason = "each test target uses its part of the shared files"
)]

#[path = "parity/fixture.rs"]
mod fixture;
#[path = "parity/tensors.rs"]
mod tensors;

use std::collections::BTreeMap;

use burn::module::Module;
use burn::optim::GradientsParams;
use burn::tensor::Device;
use demc_infer::device::{self, DeviceError};
use demc_model::Loss;
use demc_model::metrics::LOSS_EPSILON;
use demc_model::ops::{Isa, Ops};
use demc_model::{Reading, Variant};

use fixture::{Fixture, gradients_by_name, host, is_bias_before_norm, network, network_name};
use tensors::{Tolerance, assert_close};

/// Two float32 roundings of 27 layers on the CPU; a GPU fuses and orders its sums in its own ways.
const OUTPUT: Tolerance = Tolerance {
    absolute: 0.0,
    of_largest: 2e-5,
    of_value: 0.0,
};

/// As the parity tests have it, once for each side.
const GRADIENT: Tolerance = Tolerance {
    absolute: 0.0,
    of_largest: 4e-5,
    of_value: 2e-4,
};

/// One way to compute.
struct Way {
    name: String,
    device: Device,
    ops: Ops,
    isa: Option<Isa>,
}

/// Every way of this build and machine, `flex` with Burn's operations first; says which devices are left out and why.
fn ways() -> Vec<Way> {
    let flex = |name, ops, isa| Way {
        name,
        device: Device::flex(),
        ops,
        isa,
    };
    let mut ways = vec![flex("flex, Burn".into(), Ops::Burn, None)];
    for isa in Isa::available() {
        ways.push(flex(
            format!("flex, kernels on {isa}"),
            Ops::Kernels,
            Some(isa),
        ));
    }
    for name in ["ndarray", "wgpu", "cuda"] {
        match device::parse(name) {
            Ok(device) => ways.push(Way {
                name: name.into(),
                device,
                // Asked for, and not there: Burn's run.
                ops: Ops::Kernels,
                isa: None,
            }),
            Err(error @ (DeviceError::NotBuilt { .. } | DeviceError::Absent { .. })) => {
                println!("left out: {error}");
            }
            Err(error) => panic!("{error}"),
        }
    }
    ways
}

/// Output in evaluation and in training, loss, gradients by name.
fn run(way: &Way, variant: Variant, reading: Reading) -> BTreeMap<String, Vec<f32>> {
    if let Some(isa) = way.isa {
        Isa::force(isa);
    }
    let inputs = Fixture::read("inputs");
    let weights = Fixture::read(&network_name(variant, reading));
    let device = way.device.clone().autodiff();
    let model = network(variant, reading, &weights, &device).with_ops(way.ops);
    let images = |device| ["color_gamma", "features_z"].map(|name| inputs.tensor(name, device));

    let [color_gamma, features_z] = images(&way.device);
    let evaluated = model.valid().forward(color_gamma, features_z);
    let [color_gamma, features_z] = images(&device);
    let output = model.forward(color_gamma, features_z);
    let reference_hdr = inputs.tensor("reference_hdr", &device);
    let ops = way.ops;
    let losses = Loss::RelMse.per_image(ops, output.clone(), reference_hdr, 2.2, LOSS_EPSILON);
    let loss = losses.mean();
    let gradients = GradientsParams::from_grads(loss.backward(), &model);
    let mut found = gradients_by_name(&model, &gradients);
    found.insert("output in evaluation".into(), host(evaluated));
    found.insert("output".into(), host(output));
    found.insert("loss".into(), host(loss));
    found
}

/// One test, because the instruction path is the process's.
#[test]
fn every_way_to_compute_finds_the_same() {
    let ways = ways();
    for variant in Variant::ALL {
        for reading in Reading::ALL {
            let expected = run(&ways[0], variant, reading);
            for way in &ways[1..] {
                let found = run(way, variant, reading);
                assert!(
                    found.keys().eq(expected.keys()),
                    "{}: the same weights have gradients",
                    way.name
                );
                let mut worst = 0.0f32;
                for (name, values) in &expected {
                    let tolerance = match name.as_str() {
                        "output" | "output in evaluation" | "loss" => OUTPUT,
                        // Zero by construction: of the largest gradient of the convolution's weights.
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
                    let what = format!("{}: {name}", way.name);
                    worst = worst.max(assert_close(&what, &found[name], values, tolerance));
                }
                println!(
                    "{}, {}: share of the tolerances {worst:.3}",
                    network_name(variant, reading),
                    way.name
                );
            }
        }
    }
}
