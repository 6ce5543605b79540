//! Inference compared with Burn's operations, which use no folding, no bands and no large tiles.

use burn::tensor::{Device, Tensor, TensorData};
use demc_model::{Denoiser, Head, ModelConfig, Ops, Reading, Role, Variant, Weights};
use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;

/// Share of the largest value. F(4x4, 3x3) loses up to a digit in each of 27 layers. Measured: 5e-7
/// to 3e-6.
const TOLERANCE: f32 = 2e-5;

/// For a kernel head: the power near black amplifies errors.
const KERNEL_TOLERANCE: f32 = 5e-5;

fn config(variant: Variant, reading: Reading, width: usize) -> ModelConfig {
    ModelConfig {
        variant,
        reading,
        width,
        ..ModelConfig::default()
    }
}

/// A network with maps of order 1 everywhere and running statistics that are far from the identity.
fn network(config: ModelConfig) -> Denoiser {
    let mut rng = ChaCha8Rng::seed_from_u64(5);
    let mut weights = config.init(&mut rng, [0.5; 3], &Device::flex()).weights();
    for (spec, weight) in config.weight_specs().iter().zip(&mut weights) {
        let (low, high) = match spec.role {
            // A softmax of large logits would amplify the errors of all layers before.
            Role::Convolution if spec.shape[0] >= 25 && spec.name.contains("kernels") => {
                (-0.2, 0.2)
            }
            Role::Convolution | Role::Deconvolution => {
                let bound = (6.0 / spec.fan_in() as f32).sqrt();
                (-bound, bound)
            }
            Role::NormScale => (0.8, 1.2),
            Role::RunningVariance => (0.5, 1.5),
            Role::NormShift | Role::RunningMean => (-0.2, 0.2),
            Role::Bias if spec.shape == [3] => (0.8, 1.2),
            Role::Bias => (0.0, 0.3),
        };
        weight.data.fill_with(|| rng.random_range(low..high));
    }
    config
        .load(&mut Weights::new(weights), &Device::flex())
        .expect("the network's own weights")
}

fn images(seed: u64, shape: [usize; 4]) -> Tensor<4> {
    let mut rng = ChaCha8Rng::seed_from_u64(seed);
    let values: Vec<f32> = (0..shape.iter().product())
        .map(|_| rng.random_range(0.0..1.5f32))
        .collect();
    Tensor::from_data(TensorData::new(values, shape), &Device::flex())
}

fn run(model: &Denoiser, [batch, height, width]: [usize; 3]) -> Vec<f32> {
    let out = model.forward(
        images(1, [batch, 3, height, width]),
        images(2, [batch, 12, height, width]),
    );
    assert_eq!(out.dims(), [batch, 3, height, width]);
    out.into_data().try_to_vec().expect("float32")
}

fn deviation(found: &[f32], expected: &[f32]) -> f32 {
    let scale = expected.iter().fold(0.0f32, |m, x| m.max(x.abs()));
    let differences = found.iter().zip(expected).map(|(f, e)| (f - e).abs());
    differences.fold(0.0, f32::max) / scale
}

fn check(config: ModelConfig, size: [usize; 3]) {
    let model = network(config);
    let expected = run(&model.clone().with_ops(Ops::Burn), size);
    let positive = expected.iter().filter(|x| **x > 0.0).count();
    assert!(
        positive * 3 > expected.len(),
        "{positive} of {} values are positive",
        expected.len()
    );
    let found = deviation(&run(&model, size), &expected);
    println!("{config} {size:?}: {found:e}");
    let tolerance = match config.head {
        Head::Kernel => KERNEL_TOLERANCE,
        Head::Grey | Head::Xavier => TOLERANCE,
    };
    assert!(found <= tolerance, "{config} {size:?}: {found:e}");
}

#[test]
fn inference_agrees_with_burns_operations_on_every_network() {
    for variant in Variant::with_encoders() {
        for reading in Reading::ALL {
            for size in [[1, 32, 32], [2, 64, 96], [1, 96, 32]] {
                for head in [Head::Grey, Head::Kernel] {
                    let config = config(variant, reading, 6);
                    check(ModelConfig { head, ..config }, size);
                }
            }
        }
    }
    let paper = config(Variant::Demc, Reading::Paper, 16);
    check(paper, [1, 64, 96]);
    let levels = [3, 1, 2, 2, 4];
    check(ModelConfig { levels, ..paper }, [1, 64, 96]);
    let head = Head::Kernel;
    check(
        ModelConfig {
            head,
            levels,
            ..paper
        },
        [1, 64, 96],
    );
}

#[test]
fn the_number_of_threads_changes_no_bit() {
    let model = network(config(Variant::Demc, Reading::Released, 6));
    let run_on = |threads| {
        let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build();
        pool.expect("threads").install(|| run(&model, [1, 96, 64]))
    };
    let expected = run_on(1);
    assert!(expected == run_on(2) && expected == run_on(3));
}
