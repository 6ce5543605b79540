//! Channels that died and how they begin anew (ReDo: Sokar et al., "The Dormant Neuron Phenomenon", 2023).
//!
//! A channel behind a ReLU that is zero at every pixel has no gradient: no step brings it back. Here it gets fresh incoming weights,
//! and those by which the layers after it read it become zero, so that the network computes what it did before and can learn more.

use std::collections::BTreeMap;

use burn::tensor::Device;
use rand::{Rng, RngExt};

use crate::config::{FEATURE_CHANNELS, Input, LEVELS, ModelConfig};
use crate::denoiser::Denoiser;
use crate::fusion::{BLOCKS, DETAIL_LAYER};
use crate::init::OPEN_BIAS;
use crate::weights::{Weight, Weights, fan_in, is_deconvolution};

/// Bias of a channel that begins anew; ours: a little above zero, so that it is open at half of the pixels and more.
const FRESH_BIAS: f32 = 0.1;

/// A batch normalisation that begins anew is the identity.
const NORM_START: [(&str, f32); 4] = [
    ("gamma", 1.0),
    ("beta", 0.0),
    ("running_mean", 0.0),
    ("running_var", 1.0),
];

/// Channels by the path of the layer that computes them, such as `encoders.0.levels.1.convs.2`: `true` where one is dormant.
pub type Dormant = BTreeMap<String, Vec<bool>>;

/// A convolution or deconvolution, and what it reads.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Layer {
    /// Path of its module.
    pub path: String,
    /// What its input channels are, concatenated in this order.
    pub inputs: Vec<Source>,
}

/// Where input channels come from.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Source {
    /// The output of the layer with this path.
    Layer(String),
    /// So many channels of images, which are never dormant.
    Images(usize),
}

impl ModelConfig {
    /// Every layer of the network in the order of a forward pass (Fig. 3).
    pub fn layers(&self) -> Vec<Layer> {
        let (variant, reading) = (self.variant.spec(), self.reading.spec());
        let mut layers = Vec::new();
        let mut add = |path: String, inputs: Vec<Source>| {
            let output = Source::Layer(path.clone());
            layers.push(Layer { path, inputs });
            output
        };
        let mut detail = Source::Images(FEATURE_CHANNELS);
        if variant.has_fusion() {
            for block in 0..BLOCKS {
                detail = add(format!("fusion.blocks.{block}.conv"), vec![detail]);
            }
        }
        let mut skips: Vec<Vec<Source>> = vec![Vec::new(); LEVELS];
        let mut below = None;
        for (e, images) in variant.encoders.iter().enumerate() {
            let feeds_latent = e + 1 == variant.encoders.len();
            let mut inputs: Vec<Source> = images
                .iter()
                .map(|image| match image {
                    Input::DetailMap => detail.clone(),
                    other => Source::Images(other.channels()),
                })
                .collect();
            for (level, skips) in skips.iter_mut().enumerate() {
                let (skip_after, pooled) = (
                    reading.skip_after[level],
                    feeds_latent || level + 1 < LEVELS,
                );
                let count = match pooled {
                    true => reading.convolutions[level],
                    false => skip_after,
                };
                for conv in 0..count {
                    let path = format!("encoders.{e}.levels.{level}.convs.{conv}");
                    inputs = vec![add(path, inputs)];
                    if conv + 1 == skip_after {
                        skips.extend(inputs.clone());
                    }
                }
            }
            below = Some(inputs);
        }
        let mut x = add("latent.conv".into(), below.expect("there are encoders"));
        for (k, skips) in skips.into_iter().rev().enumerate() {
            let decoded = add(format!("decoder.levels.{k}.deconv"), vec![x]);
            let parts = std::iter::once(decoded).chain(skips).collect();
            x = add(format!("decoder.levels.{k}.fuse"), parts);
        }
        add("decoder.head".into(), vec![x]);
        layers
    }
}

/// New values for some places of a network's tensors.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Renewal(BTreeMap<String, Vec<(u32, f32)>>);

impl Renewal {
    /// What makes `dormant` channels begin anew in a network of this configuration whose weights are `weights`.
    ///
    /// Incoming weights are uniform with the variance of He et al. (2015), less their mean, because what they multiply is never
    /// negative; what a layer that stays reads of the channel is zero.
    pub fn draw(
        config: &ModelConfig,
        weights: &[Weight],
        dormant: &Dormant,
        rng: &mut impl Rng,
    ) -> Self {
        let shapes: BTreeMap<&str, &[usize]> = weights
            .iter()
            .map(|weight| (&*weight.name, &*weight.shape))
            .collect();
        let layers = config.layers();
        let width = |path: &str| shapes[&*format!("{path}.bias")][0];
        let is_dormant = |path: &str| match dormant.get(path) {
            Some(flags) => flags.clone(),
            None => vec![false; width(path)],
        };
        let mut renewal = BTreeMap::new();
        for Layer { path, inputs } in &layers {
            let outputs = is_dormant(path);
            let inputs: Vec<bool> = inputs
                .iter()
                .flat_map(|source| match source {
                    Source::Layer(path) => is_dormant(path),
                    Source::Images(count) => vec![false; *count],
                })
                .collect();
            let name = format!("{path}.weight");
            let shape = shapes[&*name];
            let taps: usize = shape[2..].iter().product();
            let mut places = Vec::new();
            for (o, fresh) in outputs.iter().enumerate() {
                let place = |i: usize| {
                    let kernel = match is_deconvolution(path) {
                        true => i * outputs.len() + o,
                        false => o * inputs.len() + i,
                    };
                    (kernel * taps) as u32..((kernel + 1) * taps) as u32
                };
                match fresh {
                    true => {
                        let drawn = centred(inputs.len() * taps, fan_in(&name, shape), rng);
                        places.extend((0..inputs.len()).flat_map(place).zip(drawn));
                    }
                    false => {
                        let zeroed = (0..inputs.len()).filter(|i| inputs[*i]);
                        places.extend(zeroed.flat_map(place).map(|at| (at, 0.0)));
                    }
                }
            }
            let bias = match &**path {
                DETAIL_LAYER => OPEN_BIAS,
                _ => FRESH_BIAS,
            };
            let each = |value: f32| {
                let fresh = outputs.iter().enumerate().filter(|(_, fresh)| **fresh);
                fresh.map(|(o, _)| (o as u32, value)).collect()
            };
            renewal.insert(format!("{path}.bias"), each(bias));
            renewal.insert(name, places);
            for (tensor, value) in NORM_START {
                let name = norm_of(path).map(|norm| format!("{norm}.{tensor}"));
                if let Some(name) = name.filter(|name| shapes.contains_key(&**name)) {
                    renewal.insert(name, each(value));
                }
            }
        }
        renewal.retain(|_, places| !places.is_empty());
        Renewal(renewal)
    }

    /// The places of the tensor with this name.
    pub fn places(&self, name: &str) -> impl Iterator<Item = usize> {
        let places = self.0.get(name).into_iter().flatten();
        places.map(|(place, _)| *place as usize)
    }

    /// `model`, which lives on `device`, with these values.
    pub fn apply(&self, model: &Denoiser, device: &Device) -> Denoiser {
        let mut weights = model.weights();
        for weight in &mut weights {
            for (place, value) in self.0.get(&weight.name).into_iter().flatten() {
                weight.data[*place as usize] = *value;
            }
        }
        let renewed = model.config().load(&mut Weights::new(weights), device);
        let renewed = renewed.expect("the weights are those of this network");
        renewed.with_ops(model.ops())
    }
}

/// `count` values with the variance `2 / fan_in` and a mean of zero.
fn centred(count: usize, fan_in: usize, rng: &mut impl Rng) -> Vec<f32> {
    let bound = (6.0 / fan_in as f32).sqrt();
    let mut values: Vec<f32> = (0..count)
        .map(|_| bound * (2.0 * rng.random::<f32>() - 1.0))
        .collect();
    let mean = values.iter().sum::<f32>() / count as f32;
    values.iter_mut().for_each(|value| *value -= mean);
    values
}

/// Where the normalisation after the layer at `path` is, if it has one: `latent.norm` for `latent.conv`. A level's fusion, beside
/// its deconvolution, has none.
fn norm_of(path: &str) -> Option<String> {
    let module = path
        .strip_suffix("deconv")
        .or_else(|| path.strip_suffix("conv"))?;
    Some(format!("{module}norm"))
}

#[cfg(test)]
mod tests {
    use rand::SeedableRng;
    use rand_chacha::ChaCha8Rng;

    use super::*;
    use crate::config::{Reading, Variant};
    use burn::tensor::Tensor;

    fn all_configs() -> impl Iterator<Item = ModelConfig> {
        let variants = Variant::ALL.into_iter();
        let both = variants.flat_map(|variant| Reading::ALL.map(|reading| (variant, reading)));
        both.map(|(variant, reading)| ModelConfig {
            variant,
            reading,
            width: 2,
            ..ModelConfig::default()
        })
    }

    fn drawn(config: &ModelConfig, device: &Device) -> Denoiser {
        config.init(&mut ChaCha8Rng::seed_from_u64(5), [0.3; 3], device)
    }

    /// Every kernel of the network is a layer's, and reads as many channels as the layer's inputs have.
    #[test]
    fn layers_are_those_of_the_modules() {
        for config in all_configs() {
            let shapes: BTreeMap<String, Vec<usize>> = config.weight_shapes().into_iter().collect();
            let layers = config.layers();
            let kernels = shapes.values().filter(|shape| shape.len() == 4).count();
            assert_eq!(layers.len(), kernels);
            for Layer { path, inputs } in layers {
                let channels = inputs.iter().map(|source| match source {
                    Source::Layer(path) => shapes[&format!("{path}.bias")][0],
                    Source::Images(count) => *count,
                });
                let axis = usize::from(!path.ends_with("deconv"));
                let found: usize = channels.sum();
                assert_eq!(found, shapes[&format!("{path}.weight")][axis], "{path}");
            }
        }
    }

    /// Layers with some channels, or all, far below zero; those around them alive.
    const KILLED: [(&str, usize); 6] = [
        ("encoders.0.levels.0.convs.1", 1),
        ("encoders.0.levels.2.convs.2", 8),
        ("encoders.0.levels.3.convs.0", 3),
        ("latent.conv", 16),
        ("decoder.levels.0.deconv", 5),
        ("decoder.levels.3.fuse", 2),
    ];

    /// By the shift before the ReLU: a normalisation's, where there is one. Only what a ReLU follows can be killed.
    fn killed(model: &Denoiser, device: &Device) -> (Denoiser, Dormant) {
        let mut weights = model.weights();
        let mut dormant = Dormant::new();
        let fusions_have_one = model.config().reading.spec().activated_fusion;
        for (path, count) in KILLED {
            if path.ends_with("fuse") && !fusions_have_one {
                continue;
            }
            let shift = norm_of(path).map(|norm| format!("{norm}.beta"));
            let shift = shift.filter(|beta| weights.iter().any(|weight| weight.name == *beta));
            let shift = shift.unwrap_or_else(|| format!("{path}.bias"));
            let bias = weights.iter_mut().find(|weight| weight.name == shift);
            let bias = bias.expect("the layer is there");
            bias.data[..count].fill(-1e3);
            let flags = (0..bias.data.len()).map(|channel| channel < count);
            dormant.insert(path.into(), flags.collect());
        }
        let model = model.config().load(&mut Weights::new(weights), device);
        (model.unwrap(), dormant)
    }

    fn output(model: &Denoiser, device: &Device) -> Vec<f32> {
        let image = |channels: usize| {
            let values: Vec<f32> = (0..channels * 64 * 64)
                .map(|i| 0.5 + 0.5 * (i as f32 * 0.37).sin())
                .collect();
            Tensor::<1>::from_floats(values.as_slice(), device).reshape([1, channels, 64, 64])
        };
        let out = model.forward(image(3), image(12));
        out.into_data().try_to_vec().unwrap()
    }

    /// The output stays, no channel is killed any more, and what was not touched has its weights.
    #[test]
    fn a_renewed_network_computes_what_it_did() {
        let device = Device::flex();
        for config in all_configs() {
            let (model, dormant) = killed(&drawn(&config, &device), &device);
            let mut rng = ChaCha8Rng::seed_from_u64(1);
            let renewal = Renewal::draw(&config, &model.weights(), &dormant, &mut rng);
            let renewed = renewal.apply(&model, &device);
            for (a, b) in output(&model, &device)
                .iter()
                .zip(output(&renewed, &device))
            {
                assert!((a - b).abs() <= 1e-6, "{:?}: {a} {b}", config.variant);
            }
            for (before, after) in model.weights().iter().zip(renewed.weights()) {
                let places: Vec<usize> = renewal.places(&before.name).collect();
                let values = before.data.iter().zip(&after.data).enumerate();
                for (place, (before, after)) in values {
                    assert!(*after > -1e2 && (before == after || places.contains(&place)));
                }
            }
        }
    }

    /// All killed channels reach the output again as soon as the weights that read them are not zero any more.
    #[test]
    fn renewed_channels_are_alive() {
        let device = Device::flex();
        let config = ModelConfig {
            width: 2,
            ..ModelConfig::default()
        };
        let (model, dormant) = killed(&drawn(&config, &device), &device);
        let mut rng = ChaCha8Rng::seed_from_u64(1);
        let renewal = Renewal::draw(&config, &model.weights(), &dormant, &mut rng);
        let renewed = renewal.apply(&model, &device);
        let mut read = renewed.weights();
        for weight in read.iter_mut().filter(|weight| weight.shape.len() == 4) {
            for place in renewal.places(&weight.name) {
                weight.data[place] += 0.01;
            }
        }
        let read = config.load(&mut Weights::new(read), &device).unwrap();
        assert!(output(&read, &device) != output(&renewed, &device));
    }
}
