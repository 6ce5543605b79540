//! The same weights on every backend that the build and the machine have: outputs and gradients against `flex`.
//!
//! `DEMC_REQUIRE_DEVICES` names devices (comma between) that must be there; others are skipped with a line that says so.

use std::io::Write;

use burn::module::{ModuleVisitor, Param};
use burn::optim::GradientsParams;
use burn::tensor::{Device, Tensor, TensorData};
use demc_infer::device;
use demc_model::metrics::{LOSS_EPSILON, hdr_from_gamma, rel_mse};
use demc_model::{Denoiser, Head, ModelConfig, Reading, Variant};
use rand::SeedableRng;
use rand_chacha::ChaCha8Rng;

const SIDE: usize = 64;
const BATCH: usize = 2;

/// What a backend makes of a network, on the host.
struct Result {
    /// Output in eval mode.
    output: Vec<f32>,
    /// Loss in train mode.
    loss: f32,
    /// Every gradient, in the order of the parameters.
    gradients: Vec<Vec<f32>>,
}

fn pattern(channels: usize, phase: f32, device: &Device) -> Tensor<4> {
    let shape = [BATCH, channels, SIDE, SIDE];
    let values: Vec<f32> = (0..shape.iter().product())
        .map(|i| 0.5 + 0.5 * (i as f32 * 0.0137 + phase).sin())
        .collect();
    Tensor::from_data(TensorData::new(values, shape), device)
}

fn gradients(model: &Denoiser, grads: &GradientsParams) -> Vec<Vec<f32>> {
    struct Visitor<'a>(&'a GradientsParams, Vec<Vec<f32>>);
    impl ModuleVisitor for Visitor<'_> {
        fn visit_float<const D: usize>(&mut self, param: &Param<Tensor<D>>) {
            if let Some(grad) = self.0.get::<D>(param.id) {
                self.1.push(grad.into_data().try_to_vec().expect("float32"));
            }
        }
    }
    use burn::module::Module;
    let mut visitor = Visitor(grads, Vec::new());
    model.visit(&mut visitor);
    visitor.1
}

fn run(config: &ModelConfig, device: &Device) -> Result {
    let rng = || ChaCha8Rng::seed_from_u64(7);
    let model = config.init(&mut rng(), [0.4; 3], device);
    let output = model.forward(pattern(3, 0.0, device), pattern(12, 1.0, device));
    let output = output.into_data().try_to_vec().expect("float32");

    let device = &device.clone().autodiff();
    let model = config.init(&mut rng(), [0.4; 3], device);
    let out = model.forward(pattern(3, 0.0, device), pattern(12, 1.0, device));
    let loss = rel_mse(
        hdr_from_gamma(out, 2.2),
        pattern(3, 2.0, device),
        LOSS_EPSILON,
    );
    let grads = GradientsParams::from_grads(loss.backward(), &model);
    Result {
        output,
        loss: loss.into_scalar(),
        gradients: gradients(&model, &grads),
    }
}

/// Largest difference over largest value.
fn deviation(found: &[f32], expected: &[f32]) -> f32 {
    assert_eq!(found.len(), expected.len());
    let largest = |values: &mut dyn Iterator<Item = f32>| values.fold(0.0f32, f32::max);
    let difference = largest(&mut found.iter().zip(expected).map(|(f, e)| (f - e).abs()));
    let scale = largest(&mut expected.iter().map(|e| e.abs()));
    difference / scale.max(1e-3)
}

#[test]
fn every_backend_computes_what_flex_computes() {
    let required = std::env::var("DEMC_REQUIRE_DEVICES").unwrap_or_default();
    let required: Vec<&str> = required
        .split(',')
        .filter(|name| !name.is_empty())
        .collect();
    for name in ["ndarray", "wgpu", "cuda"] {
        let other = match device::parse(name) {
            Ok(device) => device,
            Err(error) => {
                assert!(!required.contains(&name), "{name} is required, but {error}");
                // Not `println!`, which the test harness swallows.
                writeln!(std::io::stderr(), "skipped: {error}").expect("stderr can be written");
                continue;
            }
        };
        for variant in Variant::ALL {
            for reading in Reading::ALL {
                let config = ModelConfig {
                    variant,
                    reading,
                    width: 4,
                    head: Head::Grey,
                };
                let (found, expected) = (run(&config, &other), run(&config, &Device::flex()));
                let what = format!("{name} {variant:?} {reading:?}");
                // float32 sums of up to 9 x 32 x 3 terms in another order, through 30 layers.
                let output = deviation(&found.output, &expected.output);
                assert!(output < 1e-5, "{what}: output deviates by {output}");
                let loss = (found.loss / expected.loss - 1.0).abs();
                assert!(loss < 1e-5, "{what}: loss deviates by {loss}");
                assert_eq!(found.gradients.len(), expected.gradients.len());
                // A bias before a batch normalisation has no gradient but rounding, hence the scale of all.
                let scale = |result: &Result| {
                    result
                        .gradients
                        .iter()
                        .flatten()
                        .fold(0.0f32, |m, g| m.max(g.abs()))
                };
                let scale = scale(&expected);
                for (found, expected) in found.gradients.iter().zip(&expected.gradients) {
                    for (f, e) in found.iter().zip(expected) {
                        let bound = 1e-5 * scale + 1e-3 * e.abs();
                        assert!((f - e).abs() < bound, "{what}: gradient {f}, flex {e}");
                    }
                }
            }
        }
    }
}
