//! A benchmark case: random weights and one random batch, in files that every contender reads.

use std::path::Path;

use anyhow::{Context, ensure};
use burn::tensor::Device;
use demc_data::{Batch, ChannelLayout, FEATURES, FeatureStats, Normalizer, Patch, PositionSpace};
use demc_infer::{Bundle, BundleMeta, Names, Precision};
use demc_model::{ModelConfig, Reading, Role, Variant, WeightSpec, Weights};
use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;
use safetensors::tensor::{Dtype, SafeTensors, TensorView};

const SEED: u64 = 1;

/// A batch with height and width, which may differ, unlike in [`Batch`].
#[derive(Clone, Debug, PartialEq)]
pub struct CaseInput {
    /// The planes.
    pub batch: Batch,
    /// Height in pixels.
    pub height: usize,
    /// Width in pixels.
    pub width: usize,
}

/// DEMC in the paper's reading at base width `width`, with random weights that keep all maps at
/// order 1.
///
/// An initialised network would hide errors: a grey head hides its input, and bilinear
/// deconvolutions and identity fusions are symmetric.
pub fn network(width: usize) -> Bundle {
    let config = ModelConfig {
        variant: Variant::Demc,
        reading: Reading::Paper,
        width,
        ..ModelConfig::default()
    };
    let mut rng = ChaCha8Rng::seed_from_u64(SEED);
    let mut weights = config.init(&mut rng, [0.5; 3], &Device::flex()).weights();
    for (weight, spec) in weights.iter_mut().zip(config.weight_specs()) {
        let (low, high) = range(&spec);
        weight.data.fill_with(|| rng.random_range(low..high));
        // The two convolutions to three channels have positive inputs. Small filters with zero mean
        // and a positive bias keep each channel above its ReLU.
        if let [3, inputs, height, width] = weight.shape[..] {
            let len = inputs * height * width;
            for filter in weight.data.chunks_exact_mut(len) {
                let mean = filter.iter().sum::<f32>() / len as f32;
                filter.iter_mut().for_each(|x| *x = 0.5 * (*x - mean));
            }
        }
    }
    let normalizer = Normalizer {
        gamma: 2.2,
        albedo_demodulation_epsilon: None,
        position: PositionSpace::Scene,
        transfer: demc_data::Transfer::Gamma,
        exposure_level: None,
        restore_light: false,
        features: FeatureStats {
            mean: [0.0; FEATURES],
            std: [1.0; FEATURES],
        },
        flat_color: [0.5; 3],
    };
    let layout = ChannelLayout::resolve("demc-exr").expect("a preset");
    let model = config
        .load(&mut Weights::new(weights), &Device::flex())
        .expect("the network's own weights");
    Bundle::new(BundleMeta::new(config, normalizer, layout, 0), model)
}

/// The range of a weight's values. That of kernels follows He et al. 2015, `+-sqrt(6 / fan-in)`.
fn range(spec: &WeightSpec) -> (f32, f32) {
    match spec.role {
        Role::Convolution | Role::Deconvolution => {
            let bound = (6.0 / spec.fan_in() as f32).sqrt();
            (-bound, bound)
        }
        Role::Bias if spec.len() == 3 => (1.2, 1.6),
        Role::Bias => (0.0, 0.3),
        Role::NormScale => (0.8, 1.2),
        Role::NormShift | Role::RunningMean => (-0.2, 0.2),
        Role::RunningVariance => (0.5, 1.5),
    }
}

/// A batch of noise.
pub fn input(batch: usize, height: usize, width: usize) -> CaseInput {
    let mut rng = ChaCha8Rng::seed_from_u64(SEED);
    let mut draw = |channels: usize, low: f32, high: f32| -> Vec<f32> {
        (0..batch * channels * height * width)
            .map(|_| rng.random_range(low..high))
            .collect()
    };
    let batch = Batch {
        size: batch,
        patch_size: width,
        color: draw(3, 0.0, 1.5),
        features: draw(FEATURES, -1.7, 1.7),
        modulation: None,
        reference_hdr: draw(3, 0.2, 2.0),
        reference_light: None,
        patches: patches(batch),
    };
    CaseInput {
        batch,
        height,
        width,
    }
}

/// The places that a batch of noise claims to be from.
fn patches(count: usize) -> Vec<Patch> {
    let place = Patch {
        scene: 0,
        y: 0,
        x: 0,
    };
    vec![place; count]
}

/// Writes the files that all contenders read, with PyTorch's names.
///
/// # Errors
/// If a path cannot be written.
pub fn write(
    bundle: &Bundle,
    weights: &Path,
    input: &CaseInput,
    inputs: &Path,
) -> anyhow::Result<()> {
    bundle.save(weights, Names::Torch, Precision::F32)?;
    let Batch {
        color,
        features,
        reference_hdr,
        ..
    } = &input.batch;
    write_tensors(
        inputs,
        [input.batch.size, input.height, input.width],
        &[
            ("color_gamma", color),
            ("features_z", features),
            ("reference_hdr", reference_hdr),
        ],
    )
}

/// Writes tensors `[B, channels, H, W]` of one `[B, H, W]`.
///
/// # Errors
/// If the path cannot be written.
pub fn write_tensors(
    path: &Path,
    [batch, height, width]: [usize; 3],
    tensors: &[(&str, &[f32])],
) -> anyhow::Result<()> {
    let bytes: Vec<Vec<u8>> = tensors
        .iter()
        .map(|(_, values)| values.iter().flat_map(|x| x.to_le_bytes()).collect())
        .collect();
    let views = tensors
        .iter()
        .zip(&bytes)
        .map(|((name, values), bytes)| {
            let channels = values.len() / (batch * height * width);
            let shape = vec![batch, channels, height, width];
            Ok((*name, TensorView::new(Dtype::F32, shape, bytes)?))
        })
        .collect::<anyhow::Result<Vec<_>>>()?;
    let bytes = safetensors::serialize(views, None)?;
    std::fs::write(path, bytes).with_context(|| path.display().to_string())
}

/// Reads the inputs written by [`write()`].
///
/// # Errors
/// If the file cannot be read or has other contents.
pub fn read_input(path: &Path) -> anyhow::Result<CaseInput> {
    let bytes = std::fs::read(path).with_context(|| path.display().to_string())?;
    let file = SafeTensors::deserialize(&bytes).with_context(|| path.display().to_string())?;
    let values = |name: &str| -> anyhow::Result<Vec<f32>> {
        let chunks = file.tensor(name)?.data().as_chunks::<4>().0;
        Ok(chunks.iter().map(|x| f32::from_le_bytes(*x)).collect())
    };
    let shape = file.tensor("color_gamma")?.shape().to_vec();
    ensure!(
        shape.len() == 4 && shape[1] == 3,
        "{}: color_gamma is {shape:?}: expected [B, 3, H, W]",
        path.display()
    );
    Ok(CaseInput {
        batch: Batch {
            size: shape[0],
            patch_size: shape[3],
            color: values("color_gamma")?,
            features: values("features_z")?,
            modulation: None,
            reference_hdr: values("reference_hdr")?,
            reference_light: None,
            patches: patches(shape[0]),
        },
        height: shape[2],
        width: shape[3],
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::contender::Inference;
    use burn::tensor::{Tensor, TensorData};

    #[test]
    fn files_hold_the_case() {
        let folder = tempfile::tempdir().expect("a temporary directory");
        let [weights, inputs] = ["weights", "inputs"].map(|name| folder.path().join(name));
        let (network, input) = (network(2), input(2, 32, 64));
        write(&network, &weights, &input, &inputs).expect("written");
        assert_eq!(read_input(&inputs).expect("read"), input);
        let read = Bundle::load(&weights, &Device::flex()).expect("read");
        assert_eq!(read.model.weights(), network.model.weights());
    }

    /// Otherwise the agreement of contenders would prove nothing.
    #[test]
    fn output_and_detail_map_are_of_order_one_and_alive() {
        let device = Device::flex();
        for width in [4, 16, 32] {
            let (network, input) = (network(width), input(1, 64, 64));
            let shape = [1, FEATURES, 64, 64];
            let features = TensorData::new(input.batch.features.clone(), shape);
            let map = network
                .model
                .detail_map(Tensor::from_data(features, &device))
                .expect("DEMC has one")
                .try_into_vec_as()
                .expect("read");
            let out = Inference::new(network, input, &device).run();
            for values in [map, out] {
                let mean = values.iter().sum::<f32>() / values.len() as f32;
                let zeros = values.iter().filter(|x| **x == 0.0).count();
                assert!(mean > 0.3 && mean < 5.0, "width {width}: mean {mean}");
                assert!(zeros * 4 < values.len(), "width {width}: {zeros} zeros");
            }
        }
    }
}
