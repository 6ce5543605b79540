//! A case: weights and one batch, drawn here and written to files that every contender reads.

use std::path::Path;

use anyhow::{Context, ensure};
use burn::tensor::Device;
use demc_data::{Batch, ChannelLayout, FEATURES, FeatureStats, Normalizer};
use demc_infer::{Bundle, BundleMeta, Names, Precision};
use demc_model::{ModelConfig, Reading, Variant, Weight, Weights};
use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;
use safetensors::tensor::{Dtype, SafeTensors, TensorView};

/// Of weights and inputs.
const SEED: u64 = 1;

/// A batch with its height and width, which [`Batch`] takes as equal.
#[derive(Clone, Debug, PartialEq)]
pub struct Input {
    /// The planes.
    pub batch: Batch,
    /// Pixels.
    pub height: usize,
    /// Pixels.
    pub width: usize,
}

/// DEMC in the paper's reading at base width `width`, with random weights that keep all maps at order 1.
///
/// A network as training starts it would hide errors: a grey head drowns what it is given, and bilinear
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
    for weight in &mut weights {
        let (low, high) = range(weight);
        weight.data.fill_with(|| rng.random_range(low..high));
        // The two convolutions to three channels: their inputs are positive, so small filters without a mean and
        // a bias above zero keep each channel above its ReLU.
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
        demodulate: 0.0,
        features: FeatureStats {
            mean: [0.0; FEATURES],
            std: [1.0; FEATURES],
        },
        flat_color: [0.5; 3],
    };
    let layout = ChannelLayout::resolve("demc-exr").expect("a preset");
    Bundle {
        model: config
            .load(&mut Weights::new(weights), &Device::flex())
            .expect("the network's own weights"),
        meta: BundleMeta::new(config, normalizer, layout, 0),
    }
}

/// Where a weight's values are drawn from: those of convolutions by He et al. 2015, `+-sqrt(6 / inputs of an output)`.
fn range(weight: &Weight) -> (f32, f32) {
    let last = weight.name.rsplit('.').next().unwrap_or_default();
    if let [out, inputs, height, width] = weight.shape[..] {
        // A deconvolution is [in, out, 4, 4], and with stride 2 each output sees 4 of the 16 taps.
        let fan = match weight.name.ends_with("deconv.weight") {
            true => out * 4,
            false => inputs * height * width,
        };
        let bound = (6.0 / fan as f32).sqrt();
        return (-bound, bound);
    }
    match last {
        "bias" if weight.shape == [3] => (1.2, 1.6),
        "gamma" => (0.8, 1.2),
        "beta" | "running_mean" => (-0.2, 0.2),
        "running_var" => (0.5, 1.5),
        _ => (0.0, 0.3),
    }
}

/// A batch of noise.
pub fn input(batch: usize, height: usize, width: usize) -> Input {
    let mut rng = ChaCha8Rng::seed_from_u64(SEED);
    let mut draw = |channels: usize, low: f32, high: f32| -> Vec<f32> {
        (0..batch * channels * height * width)
            .map(|_| rng.random_range(low..high))
            .collect()
    };
    let batch = Batch {
        size: batch,
        color_gamma: draw(3, 0.0, 1.5),
        features_z: draw(FEATURES, -1.7, 1.7),
        modulation: None,
        reference_hdr: draw(3, 0.2, 2.0),
        patches: Vec::new(),
    };
    Input {
        batch,
        height,
        width,
    }
}

/// Writes the files that all contenders read, with PyTorch's names.
///
/// # Errors
/// A path that cannot be written.
pub fn write(bundle: &Bundle, weights: &Path, input: &Input, inputs: &Path) -> anyhow::Result<()> {
    bundle.save(weights, Names::Torch, Precision::F32)?;
    let Batch {
        color_gamma,
        features_z,
        reference_hdr,
        ..
    } = &input.batch;
    write_tensors(
        inputs,
        [input.batch.size, input.height, input.width],
        &[
            ("color_gamma", color_gamma),
            ("features_z", features_z),
            ("reference_hdr", reference_hdr),
        ],
    )
}

/// Writes tensors `[B, channels, H, W]` of one `[B, H, W]`.
///
/// # Errors
/// A path that cannot be written.
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

/// Reads what [`write()`] wrote.
///
/// # Errors
/// A file that cannot be read or holds something else.
pub fn read_input(path: &Path) -> anyhow::Result<Input> {
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
    Ok(Input {
        batch: Batch {
            size: shape[0],
            color_gamma: values("color_gamma")?,
            features_z: values("features_z")?,
            modulation: None,
            reference_hdr: values("reference_hdr")?,
            patches: Vec::new(),
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

    /// Else contenders would agree on nothing.
    #[test]
    fn output_and_detail_map_are_of_order_one_and_alive() {
        let device = Device::flex();
        for width in [4, 16, 32] {
            let (network, input) = (network(width), input(1, 64, 64));
            let shape = [1, FEATURES, 64, 64];
            let features = TensorData::new(input.batch.features_z.clone(), shape);
            let map = network
                .model
                .detail_map(Tensor::from_data(features, &device));
            let map = map.expect("DEMC has one").try_into_vec_as().expect("read");
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
