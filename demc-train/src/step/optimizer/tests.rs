use super::*;
use crate::config::OptimizerKind;
use crate::step::gradients::{grad_norm, scaled};
use burn::optim::{AdamConfig, GradientsParams};
use rand::SeedableRng;

const LR: f64 = 1e-3;

fn config() -> Config {
    let mut config = Config::default();
    config.model.width = 1;
    config
}

fn model(device: &Device) -> Denoiser {
    let mut rng = rand_chacha::ChaCha8Rng::seed_from_u64(3);
    config().model.init(&mut rng, [0.3; 3], device)
}

fn gradient(model: &Denoiser, device: &Device) -> GradientsParams {
    let image = |channels| Tensor::<4>::full([1, channels, 32, 32], 0.7, device);
    GradientsParams::from_grads(
        model.forward(image(3), image(12)).square().sum().backward(),
        model,
    )
}

/// The trainable weights: every forward pass changes the running statistics.
fn trainable(model: &Denoiser) -> Vec<Weight> {
    let specs = model.config().weight_specs();
    let weights = model.weights().into_iter().zip(specs);
    let trainable = weights.filter(|(_, spec)| spec.role.is_trainable());
    trainable.map(|(weight, _)| weight).collect()
}

/// The weights after three steps of this optimizer and of Burn's whole-module optimizer, the
/// oracle, with the same gradients.
fn steps_beside_burn(ops: Ops) -> [Vec<Weight>; 2] {
    let device = Device::flex().autodiff();
    let mut theirs = model(&device).with_ops(ops);
    let mut ours = model(&device).with_ops(ops);
    let mut oracle = AdamConfig::new().with_epsilon(1e-8).init();
    let mut adam = Optimizer::new(&config());
    for _ in 0..3 {
        ours = adam.step(LR, ours, gradient(&theirs, &device));
        let grads = gradient(&theirs, &device);
        theirs = oracle.step(1e-3, theirs, grads);
    }
    assert!(trainable(&ours) != trainable(&model(&device)));
    [ours, theirs].map(|model| trainable(&model))
}

#[test]
fn steps_on_burns_operations_equal_burns_bit_for_bit() {
    let [ours, theirs] = steps_beside_burn(Ops::Burn);
    assert!(ours == theirs);
}

/// The kernels fuse the arithmetic of a step and so round less often.
#[test]
fn steps_in_place_equal_burns_up_to_rounding() {
    let [ours, theirs] = steps_beside_burn(Ops::Kernels);
    for (ours, theirs) in ours.iter().zip(&theirs) {
        for (a, b) in ours.data.iter().zip(&theirs.data) {
            // Weights up to about 1 moved by up to 3e-3.
            assert!((a - b).abs() <= 3e-7, "{}: {a} {b}", ours.name);
        }
    }
}

/// Levels of width 1 have 1, 2, 4, 8 and 8 outputs: Muon updates some of them.
fn muon() -> Config {
    let mut config = config();
    config.optimizer.kind = OptimizerKind::Muon;
    config.optimizer.muon_max_rows = Some(4);
    config
}

#[test]
fn muon_updates_kernels_up_to_its_rows_except_the_head() {
    let device = Device::flex().autodiff();
    let model = model(&device);
    let mut optimizer = Optimizer::new(&muon());
    let grads = gradient(&model, &device);
    optimizer.step(LR, model, grads);
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

/// Against a step without decay, Adam's and Muon's kernels lose `lr * weight_decay` of themselves;
/// biases and normalisations lose nothing.
#[test]
fn weight_decay_shrinks_kernels_only() {
    let device = Device::flex().autodiff();
    let mut model = model(&device);
    model = Optimizer::new(&muon()).step(LR, model.clone(), gradient(&model, &device));
    let grads = || gradient(&model, &device);
    let mut config = muon();
    let plain = Optimizer::new(&config).step(LR, model.clone(), grads());
    config.optimizer.weight_decay = 0.5;
    let decayed = Optimizer::new(&config).step(LR, model.clone(), grads());
    let specs = model
        .config()
        .weight_specs()
        .into_iter()
        .filter(|spec| spec.role.is_trainable());
    let weights = [&model, &plain, &decayed].map(trainable);
    for (i, spec) in specs.enumerate() {
        let share = if spec.rows().is_some() { 0.5 * LR } else { 0.0 };
        for (k, before) in weights[0][i].data.iter().enumerate() {
            let [plain, decayed] = [1, 2].map(|w: usize| weights[w][i].data[k]);
            let expected = plain - share as f32 * before;
            assert!((decayed - expected).abs() < 1e-6, "{}", spec.name);
        }
    }
}

#[test]
fn a_restored_optimizer_resumes_bit_for_bit() {
    let device = Device::flex().autodiff();
    let mut optimizer = Optimizer::new(&muon());
    let first = model(&device);
    let grads = gradient(&first, &device);
    let first = optimizer.step(LR, first, grads);
    let (steps, state) = (optimizer.steps(), optimizer.state());
    let mut restored = Optimizer::restore(&muon(), steps, state.clone(), &Device::flex()).unwrap();
    assert!(restored.is_complete());
    let other = Optimizer::restore(&config(), steps, state, &Device::flex());
    assert!(!other.unwrap().is_complete());
    let grads = || gradient(&first, &device);
    let a = optimizer.step(LR, first.clone(), grads());
    let b = restored.step(LR, first.clone(), grads());
    assert!(trainable(&a) == trainable(&b));
}

#[test]
fn a_lost_moment_is_named() {
    let state = vec![Weight {
        name: "head.m".into(),
        shape: vec![1],
        data: vec![0.0],
    }];
    assert_eq!(
        Optimizer::restore(&config(), 1, state, &Device::flex()).err(),
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
