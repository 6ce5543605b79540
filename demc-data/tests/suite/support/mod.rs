//! Odd EXR files and small data sets for the tests.

pub mod batches;
pub mod files;
#[cfg(feature = "cli")]
pub mod program;
pub mod rewritten;

use std::path::{Path, PathBuf};

use demc_data::input::transform::FeatureStats;
use demc_data::{ChannelLayout, Normalizer, PositionSpace};
use exr::prelude::*;

/// The committed sample set.
pub fn sample() -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("../data/sample")
}

/// The sample's layout.
pub fn layout() -> ChannelLayout {
    ChannelLayout::resolve("demc-exr").expect("a preset")
}

/// Statistics that leave features as they are.
pub fn identity() -> Normalizer {
    let features = FeatureStats {
        mean: [0.0; 12],
        std: [1.0; 12],
    };
    Normalizer {
        gamma: 2.2,
        albedo_demodulation_epsilon: None,
        position: PositionSpace::Scene,
        transfer: demc_data::Transfer::Gamma,
        exposure_level: None,
        restore_light: false,
        features,
        flat_color: [0.4; 3],
    }
}

/// Half samples.
pub fn half(samples: impl IntoIterator<Item = f32>) -> FlatSamples {
    FlatSamples::F16(samples.into_iter().map(f16::from_f32).collect())
}

/// All channels of the `demc-exr` layout as half ramps, position as float; channel c of pixel i is
/// `c + i / pixels`, the mask 1.
pub fn scene_channels(width: usize, height: usize) -> Vec<(String, FlatSamples)> {
    let layout = layout();
    let features = layout
        .features()
        .into_iter()
        .filter_map(|feature| feature.channels.cloned());
    let triples = [layout.color.clone()]
        .into_iter()
        .chain(features)
        .chain(layout.reference.clone());
    let pixels = width * height;
    let mut channels: Vec<(String, FlatSamples)> = triples
        .flatten()
        .enumerate()
        .map(|(channel, name)| {
            let ramp = (0..pixels).map(|i| channel as f32 + i as f32 / pixels as f32);
            let position = name.starts_with("position");
            let samples = if position {
                FlatSamples::F32(ramp.collect())
            } else {
                half(ramp)
            };
            (name, samples)
        })
        .collect();
    channels.push(("mask.A".to_owned(), half(vec![1.0; pixels])));
    channels
}

/// One part of a file.
pub fn part(
    name: Option<&str>,
    size: (usize, usize),
    encoding: Encoding,
    channels: Vec<(String, FlatSamples)>,
) -> Layer<AnyChannels<FlatSamples>> {
    let attributes = LayerAttributes {
        layer_name: name.map(Text::from),
        ..Default::default()
    };
    let list = channels
        .into_iter()
        .map(|(name, samples)| AnyChannel::new(name.as_str(), samples));
    Layer::new(
        size,
        attributes,
        encoding,
        AnyChannels::sort(list.collect()),
    )
}

/// Scanlines, ZIP: as the sample is stored.
pub const ZIP: Encoding = Encoding {
    compression: Compression::ZIP16,
    blocks: Blocks::ScanLines,
    line_order: LineOrder::Increasing,
};

/// Writes a file of one part.
pub fn write(path: &Path, size: (usize, usize), channels: Vec<(String, FlatSamples)>) {
    Image::from_layer(part(None, size, ZIP, channels))
        .write()
        .to_file(path)
        .expect("a writable directory");
}

/// Writes a file of several parts.
pub fn write_parts(path: &Path, size: (usize, usize), parts: Vec<Layer<AnyChannels<FlatSamples>>>) {
    let attributes = ImageAttributes::with_size(size);
    Image::from_layers(attributes, Layers::from(parts))
        .write()
        .to_file(path)
        .expect("a writable directory");
}

/// Names for [`write`].
pub fn named<const N: usize>(channels: [(&str, FlatSamples); N]) -> Vec<(String, FlatSamples)> {
    channels
        .into_iter()
        .map(|(name, samples)| (name.to_owned(), samples))
        .collect()
}
