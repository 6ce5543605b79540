use super::*;
use burn::optim::{AdamConfig, GradientsParams};
use demc_model::ModelConfig;
use rand::SeedableRng;

const RATE: Rate = Rate {
    lr: 1e-3,
    fan_in: 0,
};

fn model(device: &Device) -> Denoiser {
    let config = ModelConfig {
        width: 1,
        ..ModelConfig::default()
    };
    config.init(
        &mut rand_chacha::ChaCha8Rng::seed_from_u64(3),
        [0.3; 3],
        device,
    )
}

fn gradient(model: &Denoiser, device: &Device) -> GradientsParams {
    let image = |channels| Tensor::<4>::full([1, channels, 32, 32], 0.7, device);
    GradientsParams::from_grads(
        model.forward(image(3), image(12)).square().sum().backward(),
        model,
    )
}

/// Without the running statistics, which every forward pass moves.
fn trainable(weights: Vec<Weight>) -> Vec<Weight> {
    weights.into_iter().filter(Weight::is_trainable).collect()
}

/// The weights after three steps of ours and of Burn's whole-module optimizer, the oracle, along the same gradients.
fn steps_beside_burn(ops: Ops) -> [Vec<Weight>; 2] {
    let device = Device::flex().autodiff();
    let mut theirs = model(&device).with_ops(ops);
    let mut ours = model(&device).with_ops(ops);
    let mut oracle = AdamConfig::new().with_epsilon(1e-8).init();
    let mut adam = Optimizer::new(&TrainConfig::default());
    for _ in 0..3 {
        ours = adam.step(RATE, ours, gradient(&theirs, &device));
        let grads = gradient(&theirs, &device);
        theirs = oracle.step(1e-3, theirs, grads);
    }
    assert!(trainable(ours.weights()) != trainable(model(&device).weights()));
    [ours, theirs].map(|model| trainable(model.weights()))
}

#[test]
fn steps_on_burns_operations_are_burns_own_bit_for_bit() {
    let [ours, theirs] = steps_beside_burn(Ops::Burn);
    assert!(ours == theirs);
}

/// The kernels fuse the arithmetic of a step, which rounds less often.
#[test]
fn steps_in_place_are_burns_own_to_rounding() {
    let [ours, theirs] = steps_beside_burn(Ops::Kernels);
    for (ours, theirs) in ours.iter().zip(&theirs) {
        for (a, b) in ours.data.iter().zip(&theirs.data) {
            // Of weights up to about 1 that moved by up to 3e-3.
            assert!((a - b).abs() <= 3e-7, "{}: {a} {b}", ours.name);
        }
    }
}

/// Levels of width 1 have 1, 2, 4, 8 and 8 outputs: Muon moves some of them.
fn muon() -> TrainConfig {
    TrainConfig {
        muon: 4,
        ..TrainConfig::default()
    }
}

#[test]
fn muon_moves_kernels_of_so_many_outputs_and_not_the_head() {
    let device = Device::flex().autodiff();
    let model = model(&device);
    let mut optimizer = Optimizer::new(&muon());
    let grads = gradient(&model, &device);
    optimizer.step(RATE, model, grads);
    let names: Vec<String> = optimizer.state().into_iter().map(|w| w.name).collect();
    let has = |name: &str| names.iter().any(|n| n == name);
    for kernel in [
        "fusion.blocks.3.conv.weight",
        "encoders.1.levels.2.convs.0.weight",
        "decoder.levels.2.deconv.weight",
        "decoder.levels.4.fuse.weight",
    ] {
        assert!(has(&format!("{kernel}.velocity")) && !has(&format!("{kernel}.m")));
    }
    for other in [
        "encoders.1.levels.3.convs.0.weight",
        "decoder.levels.1.deconv.weight",
        "decoder.head.weight",
        "encoders.1.levels.0.convs.0.bias",
    ] {
        assert!(!has(&format!("{other}.velocity")) && has(&format!("{other}.m")));
    }
}

#[test]
fn restored_optimizer_goes_on_bit_for_bit() {
    let device = Device::flex().autodiff();
    let mut optimizer = Optimizer::new(&muon());
    let first = model(&device);
    let grads = gradient(&first, &device);
    let first = optimizer.step(RATE, first, grads);
    let (steps, state) = (optimizer.steps(), optimizer.state());
    let mut again = Optimizer::restore(&muon(), steps, state.clone(), &Device::flex()).unwrap();
    assert!(again.fits(&first.weights()));
    let other = Optimizer::restore(&TrainConfig::default(), steps, state, &Device::flex());
    assert!(!other.unwrap().fits(&first.weights()));
    let grads = || gradient(&first, &device);
    let a = optimizer.step(RATE, first.clone(), grads()).weights();
    let b = again.step(RATE, first.clone(), grads()).weights();
    assert!(trainable(a) == trainable(b));
}

#[test]
fn a_lost_moment_is_named() {
    let state = vec![Weight {
        name: "head.m".into(),
        shape: vec![1],
        data: vec![0.0],
    }];
    assert_eq!(
        Optimizer::restore(&TrainConfig::default(), 1, state, &Device::flex()).err(),
        Some("head.m".to_string())
    );
}

#[test]
fn scaling_scales_the_norm() {
    let device = Device::flex().autodiff();
    let model = model(&device);
    let grads = gradient(&model, &device);
    let norm = grad_norm(&model, &grads);
    let halved = grad_norm(&model, &scaled(&model, grads, 0.5));
    assert!(norm > 0.0 && (halved / norm - 0.5).abs() < 1e-6);
}
