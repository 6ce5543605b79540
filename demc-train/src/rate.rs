//! The learning rate of each weight: smaller for layers that sum up more inputs (the rule of Yang et al. 2021, "Tensor Programs V", for
//! Adam).
//!
//! Adam moves every weight by about the learning rate, whatever its gradient. What a layer reads is never negative behind ReLUs, so
//! the steps of one output's weights add up: at 1e-3 the 2304 weights of an output of the deepest layers at width 32 move it by up to 2.3
//! times the mean of its inputs, in one step. So channels fall below zero, and stay there.

use demc_model::fusion::DETAIL_LAYER;
use demc_model::weights::fan_in;

/// What the detail map's convolution counts its inputs times: its three channels are all that the encoder behind it sees, and one that
/// falls below zero is a third of them. Ours. A bias counts once, like any other.
const DETAIL_FACTOR: usize = 10;

/// How far one step may move a weight.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Rate {
    /// The learning rate.
    pub lr: f64,
    /// Kernels whose outputs sum up more inputs than this learn at a rate that is smaller in proportion; 0: all alike.
    pub fan_in: usize,
}

impl Rate {
    /// The rate of the weight with this name and shape. A bias counts as one input.
    pub fn of(self, name: &str, shape: &[usize]) -> f64 {
        match inputs(name, shape) {
            inputs if inputs > self.fan_in && self.fan_in > 0 => {
                self.lr * self.fan_in as f64 / inputs as f64
            }
            _ => self.lr,
        }
    }
}

/// The inputs that count: the detail map's convolution is as sensitive as one of many more.
fn inputs(name: &str, shape: &[usize]) -> usize {
    match name.strip_suffix(".weight") {
        Some(DETAIL_LAYER) => DETAIL_FACTOR * fan_in(name, shape),
        _ => fan_in(name, shape),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Level 1 of width 2 reads 18 values or fewer, the deepest level 144: the rate is that of 18.
    #[test]
    fn wide_layers_learn_at_a_rate_that_is_smaller_in_proportion() {
        let of = |fan_in| Rate { lr: 1.0, fan_in };
        for (name, shape, expected) in [
            ("encoders.1.levels.0.convs.1.weight", vec![2, 2, 3, 3], 1.0),
            (
                "encoders.1.levels.4.convs.1.weight",
                vec![16, 16, 3, 3],
                18.0 / 144.0,
            ),
            (
                "decoder.levels.0.deconv.weight",
                vec![16, 8, 4, 4],
                18.0 / 64.0,
            ),
            (
                "fusion.blocks.3.conv.weight",
                vec![3, 2, 3, 3],
                18.0 / 180.0,
            ),
            ("encoders.1.levels.4.convs.1.bias", vec![16], 1.0),
        ] {
            assert_eq!(of(18).of(name, &shape), expected, "{name}");
            assert_eq!(of(0).of(name, &shape), 1.0, "{name}");
        }
    }
}
