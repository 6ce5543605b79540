//! NAIVE stand-in.
use crate::Isa;
/// Training forward.
#[allow(clippy::too_many_arguments)]
pub fn forward_train(isa: Isa, x: &[f32], gamma: &[f32], beta: &[f32], epsilon: f32, relu: bool, y: &mut [f32], mean: &mut [f32], variance: &mut [f32]) {
    let c = gamma.len(); let n = (x.len() / c) as f64;
    for i in 0..c {
        let m = x[i..].iter().step_by(c).map(|x| f64::from(*x)).sum::<f64>() / n;
        mean[i] = m as f32;
        variance[i] = (x[i..].iter().step_by(c).map(|x| (f64::from(*x) - m).powi(2)).sum::<f64>() / n) as f32;
    }
    forward_eval(isa, x, gamma, beta, mean, variance, epsilon, relu, y);
}
/// Evaluation forward.
#[allow(clippy::too_many_arguments)]
pub fn forward_eval(_isa: Isa, x: &[f32], gamma: &[f32], beta: &[f32], mean: &[f32], variance: &[f32], epsilon: f32, relu: bool, y: &mut [f32]) {
    let c = gamma.len();
    for (i, (x, y)) in x.iter().zip(y).enumerate() { let i = i % c; let v = (x - mean[i]) / (variance[i] + epsilon).sqrt() * gamma[i] + beta[i]; *y = if relu { v.max(0.0) } else { v }; }
}
/// Backward.
#[allow(clippy::too_many_arguments)]
pub fn backward(_isa: Isa, x: &[f32], gamma: &[f32], mean: &[f32], variance: &[f32], epsilon: f32, y: Option<&[f32]>, dy: &[f32], dx: &mut [f32], dgamma: &mut [f32], dbeta: &mut [f32]) {
    let c = gamma.len(); let n = (x.len() / c) as f64;
    let gate = |j: usize| match y { Some(y) if y[j] <= 0.0 => 0.0, _ => f64::from(dy[j]) };
    for i in 0..c {
        let s = 1.0 / (f64::from(variance[i]) + f64::from(epsilon)).sqrt();
        let hat = |j: usize| (f64::from(x[j]) - f64::from(mean[i])) * s;
        let (mut a, mut b) = (0.0, 0.0);
        for j in (i..x.len()).step_by(c) { a += gate(j); b += gate(j) * hat(j); }
        dbeta[i] = a as f32; dgamma[i] = b as f32;
        for j in (i..x.len()).step_by(c) { dx[j] = (f64::from(gamma[i]) * s * (gate(j) - a / n - hat(j) * b / n)) as f32; }
    }
}
