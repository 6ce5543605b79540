//! A tiny network with random weights and a frame with a pattern, for this crate's tests.

use burn::tensor::Device;
use demc_data::input::kpcn::PASS_PLANES;
use demc_data::{
    ChannelLayout, FEATURES, FeatureStats, Frame, Normalizer, PositionSpace, Transfer,
};
use demc_model::unet::UnetSize;
use demc_model::{Head, ModelConfig, Reading, Variant, Weights};
use rand::RngExt;
use rand_chacha::ChaCha8Rng;
use rand_chacha::rand_core::SeedableRng;

use super::{Bundle, BundleMeta};

/// A network of base width 2 in the released reading, which has the most batch normalisation.
pub(crate) fn bundle(variant: Variant) -> Bundle {
    bundle_with(variant, Head::default())
}

/// The network of [`bundle`] with a kernel head, whose kernels differ from pixel to pixel.
pub(crate) fn kernel_bundle() -> Bundle {
    let mut bundle = bundle_with(Variant::Demc, Head::Kernel);
    let mut rng = ChaCha8Rng::seed_from_u64(9);
    let mut weights = bundle.model.weights();
    for weight in &mut weights {
        if weight.name.starts_with("decoder.kernels") {
            let random = |value: &mut f32| *value = rng.random_range(-2.0..2.0);
            weight.data.iter_mut().for_each(random);
        }
    }
    let mut weights = Weights::new(weights);
    let loaded = bundle.meta.model.load(&mut weights, &Device::flex());
    bundle.model = loaded.expect("its own weights");
    bundle
}

pub(crate) fn bundle_with(variant: Variant, head: Head) -> Bundle {
    let model = match variant {
        _ if variant.is_unet() => ModelConfig {
            variant,
            size: UnetSize::Small,
            width: if variant == Variant::Unet {
                ModelConfig::default().width
            } else {
                2
            },
            head,
            ..ModelConfig::default()
        },
        _ => ModelConfig {
            variant,
            reading: match variant {
                Variant::Kpcn => Reading::Paper,
                _ => Reading::Released,
            },
            width: 2,
            head,
            ..ModelConfig::default()
        },
    };
    let features = FeatureStats {
        mean: std::array::from_fn(|channel| 0.1 * channel as f32),
        std: std::array::from_fn(|channel| 0.3 + 0.1 * channel as f32),
    };
    let normalizer = Normalizer {
        gamma: 2.2,
        albedo_demodulation_epsilon: None,
        position: PositionSpace::Scene,
        transfer: Transfer::Gamma,
        exposure_level: None,
        restore_light: false,
        features,
        flat_color: [0.4, 0.3, 0.2],
    };
    let layout = ChannelLayout::resolve("demc-exr").expect("a preset");
    let mut rng = ChaCha8Rng::seed_from_u64(7);
    let network = model.init(&mut rng, normalizer.flat_color, &Device::flex());
    Bundle::new(BundleMeta::new(model, normalizer, layout, 12), network)
}

/// The network of [`bundle`] with an albedo filter of the variant `filter`, whose output convolution is
/// random, so that the albedo changes.
pub(crate) fn filtered(variant: Variant, filter: Variant) -> Bundle {
    let mut network = bundle(variant);
    let mut model = bundle(filter);
    model.meta.step = 77;
    let mut rng = ChaCha8Rng::seed_from_u64(8);
    let mut weights = model.model.weights();
    for weight in &mut weights {
        let random = |value: &mut f32| *value += rng.random_range(-0.05..0.06);
        weight.data.iter_mut().for_each(random);
    }
    let mut weights = Weights::new(weights);
    let loaded = model.meta.model.load(&mut weights, &Device::flex());
    model.model = loaded.expect("its own weights");
    network
        .set_albedo_filter(model)
        .expect("the same positions");
    network
}

/// A header entry without its checksum, for files whose content is changed on purpose.
pub(crate) fn without_checksum(entry: &str) -> String {
    let (start, _) = entry.split_once(",\"sha256\"").expect("the last key");
    format!("{start}}}")
}

pub(crate) fn frame(width: usize, height: usize) -> Frame {
    let pattern = |channels: usize| {
        let values = 0..channels * width * height;
        values.map(|i| (i * 7919 % 1013) as f32 / 1013.0).collect()
    };
    let mut frame = Frame::new("pattern", width, height, pattern(3), pattern(FEATURES));
    frame.passes = Some(pattern(PASS_PLANES));
    frame
}
