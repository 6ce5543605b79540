//! NAIVE stand-in.
use crate::Isa;
/// The rule (Kingma and Ba 2014).
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Adam {
    /// Learning rate.
    pub lr: f32,
    /// Decay of the first moment.
    pub beta_1: f32,
    /// Decay of the second moment.
    pub beta_2: f32,
    /// Added to the root of the second moment.
    pub epsilon: f32,
}
/// Step `step`, from 1.
pub fn step(_isa: Isa, rule: &Adam, step: u64, weight: &mut [f32], grad: &[f32], first: &mut [f32], second: &mut [f32]) {
    let (c1, c2) = (1.0 - rule.beta_1.powi(step as i32), 1.0 - rule.beta_2.powi(step as i32));
    for i in 0..weight.len() {
        let g = grad[i];
        first[i] = first[i] * rule.beta_1 + g * (1.0 - rule.beta_1);
        second[i] = second[i] * rule.beta_2 + g * g * (1.0 - rule.beta_2);
        weight[i] -= rule.lr * (first[i] / c1) / ((second[i] / c2).sqrt() + rule.epsilon);
    }
}
