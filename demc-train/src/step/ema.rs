//! The exponential moving average of the weights, which is less noisy than the network in training.
//! The paper has none.

use std::collections::VecDeque;

use burn::module::{Module, ModuleMapper, ModuleVisitor, Param};
use burn::tensor::Tensor;
use demc_model::ops::update::moving_average;
use demc_model::{Denoiser, Ops};

/// The average of a network's weights, including the running statistics of batch normalisation.
pub struct Ema {
    decay: f64,
    average: Option<Denoiser>,
}

impl Ema {
    /// An average that starts at `average`, a network without autodiff. Each update keeps the share
    /// `decay`.
    pub fn new(decay: f64, average: Denoiser) -> Self {
        Ema {
            decay,
            average: Some(average),
        }
    }

    /// The averaged network, without autodiff.
    pub fn model(&self) -> &Denoiser {
        let average = self.average.as_ref();
        average.expect("the average is taken only within an update")
    }

    /// Updates the average with `live`, the network without autodiff after `steps` steps.
    ///
    /// The decay is at most `(1 + steps) / (10 + steps)`, so that the initial weights soon lose
    /// influence.
    pub fn update(&mut self, live: &Denoiser, steps: u64) {
        let warmup = (1.0 + steps as f64) / (10.0 + steps as f64);
        let mut weights = FlatWeights::default();
        live.visit(&mut weights);
        let mut step = EmaUpdate {
            ops: live.ops(),
            share: (1.0 - self.decay.min(warmup)) as f32,
            live: weights.0,
        };
        // Taken, not cloned: a shared weight would be copied before the update.
        self.average = self.average.take().map(|average| average.map(&mut step));
    }
}

/// A network's tensors in module order.
#[derive(Default)]
struct FlatWeights(VecDeque<Tensor<1>>);

impl ModuleVisitor for FlatWeights {
    fn visit_float<const D: usize>(&mut self, param: &Param<Tensor<D>>) {
        self.0.push_back(param.val().reshape([-1]));
    }
}

/// One update over a whole network.
struct EmaUpdate {
    ops: Ops,
    share: f32,
    live: VecDeque<Tensor<1>>,
}

impl ModuleMapper for EmaUpdate {
    fn map_float<const D: usize>(&mut self, param: Param<Tensor<D>>) -> Param<Tensor<D>> {
        let (id, average, mapper) = param.consume();
        let live = self
            .live
            .pop_front()
            .expect("two networks with the same configuration")
            .reshape(average.dims());
        let average = moving_average(self.ops, average, live, self.share);
        Param::from_mapped_value(id, average, mapper)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use burn::tensor::Device;
    use demc_model::{ModelConfig, Weight};
    use rand::SeedableRng;

    fn model(seed: u64) -> Denoiser {
        let config = ModelConfig {
            width: 1,
            ..ModelConfig::default()
        };
        let mut rng = rand_chacha::ChaCha8Rng::seed_from_u64(seed);
        config.init(&mut rng, [0.3; 3], &Device::flex())
    }

    /// Every value of three networks: average before, live network, average after.
    fn values(networks: [Vec<Weight>; 3]) -> impl Iterator<Item = [f32; 3]> {
        let [a, b, c] = networks.map(|weights| weights.into_iter().flat_map(|w| w.data));
        a.zip(b).zip(c).map(|((a, b), c)| [a, b, c])
    }

    #[test]
    fn an_update_interpolates_on_all_operations() {
        for ops in Ops::ALL {
            let (before, live) = (model(1), model(2).with_ops(ops));
            let mut ema = Ema::new(0.75, before.clone());
            // After the warmup.
            ema.update(&live, 1000);
            let all = [before.weights(), live.weights(), ema.model().weights()];
            let mut moved = false;
            for [before, live, after] in values(all) {
                let expected = before + 0.25 * (live - before);
                assert!(
                    (after - expected).abs() <= 1e-6,
                    "{ops}: {after} {expected}"
                );
                moved |= after != before;
            }
            assert!(moved);
        }
    }

    #[test]
    fn initial_weights_soon_lose_influence() {
        let (start, live) = (model(1), model(2));
        let mut ema = Ema::new(0.9999, start);
        for steps in 1..100 {
            ema.update(&live, steps);
        }
        // The product of (1 + t) / (10 + t) up to 99 is below 1e-8. With a decay of 0.9999 it would
        // be 0.99.
        for [_, live, average] in values([live.weights(), live.weights(), ema.model().weights()]) {
            assert!((average - live).abs() < 1e-5);
        }
    }
}
