//! KPCN: its output, both losses, and their gradients.

use burn::optim::GradientsParams;
use burn::tensor::Tensor;
use demc_model::{LossConfig, ModelConfig, Ops, Reading, Variant, kpcn};

use super::{GRADIENT, OUTPUT};
use crate::fixture::{Fixture, config, gradients_by_name, host, network};
use crate::tensors::assert_close;

/// Exponent of the colour compression.
const GAMMA: f32 = 2.2;

#[test]
fn kpcn_is_pytorchs() {
    let fixture = Fixture::read("kpcn");
    let config: ModelConfig = config(Variant::Kpcn, Reading::Paper);
    let device = super::device().autodiff();
    let tensor = |name: &str| -> Tensor<4> { fixture.tensor(name, &device) };
    let joined_loss = LossConfig {
        relmse: 0.0,
        l1_hdr: 1.0,
        ..LossConfig::default()
    };
    for ops in Ops::ALL {
        let model = network(&config, &fixture, &device).with_ops(ops);
        for kind in ["separate", "joined"] {
            let output = model.forward(tensor("light"), tensor("features"));
            let expected = fixture.values("output");
            assert_close("output", &host(output.clone()), expected, OUTPUT);
            let losses = match kind {
                "separate" => kpcn::separate_losses(output, tensor("reference_light")),
                _ => {
                    let image = kpcn::joined_gamma(output, tensor("divisor"), GAMMA);
                    joined_loss.per_image(ops, image, tensor("reference_hdr"), GAMMA)
                }
            };
            let loss = losses.mean();
            let expected = fixture.values(&format!("{kind}/loss"));
            assert_close(kind, &host(loss.clone()), expected, OUTPUT);
            let gradients = GradientsParams::from_grads(loss.backward(), &model);
            let found = gradients_by_name(&model, &gradients);
            let expected = fixture.group(&format!("{kind}/grad/"));
            assert_eq!(
                found.len(),
                expected.len(),
                "every parameter has a gradient"
            );
            for weight in expected {
                let what = format!("{ops:?}, {kind}: gradient of {}", weight.name);
                assert_close(&what, &found[&weight.name], &weight.data, GRADIENT);
            }
        }
    }
}
