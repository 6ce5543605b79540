//! Exports the network for other runtimes as one ONNX graph, from a renderer's buffers to the
//! denoised image.
//!
//! - Input `color`, `[batch, 3, height, width]`: noisy radiance in linear HDR; below 0 counts as 0.
//! - Input `features`, `[batch, 12, height, width]`: raw features, ordered as [`FEATURE_NAMES`].
//!   Of a model with `normalizer.position = "image"`, positions after [`demc_data::PositionMap`].
//! - Output `output`, `[batch, 3, height, width]`: radiance in linear HDR, not negative.
//!
//! The batch can have any size. Height and width must be multiples of 32; with another size, a
//! runtime fails at the first skip fusion. The graph contains gamma, Z-score and their inverses.
//! Two conversions need the whole image, and a batch may hold tiles, so the caller does them. The
//! colour is multiplied by [`Bundle::input_scale`] and the output divided by it. Positions are
//! mapped.
//! An albedo filter of the bundle is the first part of the graph; it takes the same positions.
//! Batch normalisation is folded into the convolutions. All variants have both inputs; color-only
//! ignores the second. Inputs, outputs and all computations are float32; [`Precision::F16`] only
//! affects the stored weights of the convolutions.
//!
//! The graph of KPCN is its network alone: `color` `[batch, 6, height, width]`, `features` of 12 channels,
//! and `output` are those of [`demc_model::kpcn::Kpcn::forward`], and the caller converts
//! ([`demc_data::input::kpcn`]).
//!
//! The operator set is 17 (June 2022). Later ones change no operator used here except for added
//! types, so a newer set would only exclude older runtimes.

mod albedo;
mod graph;
mod kernel_head;
mod kpcn;
mod network;
mod proto;
mod transfer;
mod unet;

use std::fs;
use std::io::Write;
use std::path::Path;

use demc_data::InputKind;
use demc_data::image::frame::FEATURE_NAMES;
use demc_model::config::FEATURE_CHANNELS;

use crate::bundle::Description;
use crate::{Bundle, BundleError, Precision};
use graph::GraphBuilder;
use proto::{
    Dimension, Extent, FLOAT, Message, ModelProto, OperatorSetIdProto, StringStringEntryProto,
    TensorShapeProto, TensorTypeProto, TypeProto, ValueInfoProto,
};

pub use network::{COLOR, FEATURES, OUTPUT};

/// The operator set.
pub const OPSET: i64 = 17;
/// The version of the file format released with it (ONNX 1.12).
const IR_VERSION: i64 = 8;
/// Protobuf's limit for a message. Larger graphs would need separate files for the weights.
const MAX_BYTES: u64 = i32::MAX as u64;
/// Upper bound for the file's size without weights: names, attributes, texts. Measured: 21 kB.
const OTHER_BYTES: u64 = 1 << 20;

/// Metadata key of the bundle's header as JSON: model, normalizer, layout, step, albedo filter.
pub const META: &str = "demc";
/// Metadata key of [`FEATURE_NAMES`] as JSON.
pub const FEATURE_ORDER: &str = "demc.features";

const DOCUMENTATION: &str = "DEMC, a denoiser for Monte Carlo renderings (Yang et al. 2019). \
    color [batch, 3, height, width] is noisy radiance in linear HDR, times a factor s; divide the output by s. \
    s is 1 if e = mean(luminance^(1/2.2))^2.2 is between low / 2 and 2 * high of ranges.exposure in the metadata, \
    otherwise sqrt(low * high) / e. \
    features [batch, 12, height, width] are shading normal xyz, world position xyz, and albedo RGB at the \
    first and at the second intersection, raw, in the renderer's units. If normalizer.position of the \
    metadata is `image`, positions are clamp((p - median) / median distance from it, -5, 5), and 0 without a hit. \
    output [batch, 3, height, width] is radiance in linear HDR. \
    Height and width must be multiples of 32: repeat the last row and column, and crop the output. \
    Values must be finite. \
    Metadata: `demc` holds model, statistics, channel names and training step as JSON, `demc.features` the \
    order of the features.";

const KPCN_DOCUMENTATION: &str = "KPCN, a denoiser for Monte Carlo renderings (Bako et al. 2017). \
    color [batch, 6, height, width] is noisy diffuse light / (albedo + 0.00316), and ln(1 + specular light). \
    features [batch, 12, height, width] are normal xyz, albedo RGB, depth / its largest value in the image, \
    and the variances of the mean of both parts of color, normal, albedo, and depth, each of the luminance. \
    output [batch, 6, height, width] is color without noise. \
    Height and width must be multiples of 32: repeat the last row and column, and crop the output. \
    Values must be finite. \
    Metadata: `demc` holds model, statistics, channel names and training step as JSON, `demc.features` the \
    order of the features.";

const KPCN_FEATURES: [&str; FEATURE_CHANNELS] = [
    "normal.x",
    "normal.y",
    "normal.z",
    "albedo.r",
    "albedo.g",
    "albedo.b",
    "depth",
    "variance of diffuse",
    "variance of specular",
    "variance of normal",
    "variance of albedo",
    "variance of depth",
];

/// What a file says about its network.
struct Texts {
    color: &'static str,
    features: [&'static str; FEATURE_CHANNELS],
    documentation: &'static str,
}

const UNET_DOCUMENTATION: &str = "The U-Net of Open Image Denoise, or one that grew from it. \
    color [batch, 3, height, width] is noisy radiance in linear HDR, times a factor s; divide the output by s. \
    s is normalizer.exposure_level / the geometric mean of the luminance of the image's 16x16 pixels. \
    features [batch, 12, height, width] are shading normal xyz, world position xyz, and albedo RGB at the \
    first and at the second intersection. Of these, the guides of the model in the metadata count: the first albedo, \
    and the normal; for unet-demc and unet-nosn, all. output [batch, 3, height, width] is radiance in linear HDR. \
    Height and width must be multiples of 16: append rows and columns of color 0, albedo 0, normal -1, and \
    the metadata's means of the other features, and crop the output. Values must be finite. \
    Metadata: `demc` holds model, statistics, channel names and training step as JSON, `demc.features` the \
    order of the features.";

impl Texts {
    fn of(bundle: &Bundle) -> Self {
        if bundle.meta.model.variant.is_unet() {
            return Self {
                color: "radiance, linear HDR",
                features: FEATURE_NAMES,
                documentation: UNET_DOCUMENTATION,
            };
        }
        match bundle.meta.layout.inputs {
            InputKind::Demc => Self {
                color: "radiance, linear HDR",
                features: FEATURE_NAMES,
                documentation: DOCUMENTATION,
            },
            InputKind::Kpcn => Self {
                color: "diffuse light / albedo, logarithm of specular light",
                features: KPCN_FEATURES,
                documentation: KPCN_DOCUMENTATION,
            },
        }
    }
}

impl Bundle {
    /// Writes the network as an ONNX file atomically, reads it back and compares. In f16 the file
    /// holds the weights of [`rounded`](Self::rounded).
    ///
    /// The model must be on `flex`.
    ///
    /// # Errors
    /// A weight beyond f16's range, a network too large for one file, or a path that cannot be
    /// written; [`BundleError::ReadBack`] if the file differs from what was written.
    pub fn export_onnx(&self, path: &Path, precision: Precision) -> Result<(), BundleError> {
        let parameters = self
            .networks()
            .map(|bundle| bundle.meta.model.parameter_count());
        check_size(parameters.sum(), precision)?;
        let model = self.onnx(precision)?;
        let bytes = model.encode_to_vec();
        demc_program::file::write_whole(path, |file| file.write_all(&bytes))?;
        drop(bytes);
        let back = fs::read(path).map_err(|source| BundleError::Read {
            path: path.into(),
            source,
        })?;
        match ModelProto::decode(&back[..]) {
            Ok(back) if back == model => Ok(()),
            Ok(_) => Err("the graph".to_string()),
            Err(error) => Err(error.to_string()),
        }
        .map_err(|what| BundleError::ReadBack {
            path: path.into(),
            what,
        })
    }

    fn onnx(&self, precision: Precision) -> Result<ModelProto, BundleError> {
        let bundle = self.rounded(precision)?;
        let network = |bundle: &Bundle| {
            let mut graph = GraphBuilder::new(precision, bundle.meta.model.weight_specs());
            graph.denoise(&bundle.model, &bundle.meta.normalizer);
            graph.finish()
        };
        let mut graph = network(&bundle);
        if let Some(filter) = &bundle.albedo_filter {
            graph = albedo::with_filter(graph, network(filter), precision);
        }
        graph.name = "demc".into();
        let texts = Texts::of(&bundle);
        let colors = bundle.meta.model.variant.spec().color_channels;
        let features = texts.features.join(", ");
        graph.input = vec![
            image(COLOR, colors, &format!("Noisy {}", texts.color)),
            image(FEATURES, FEATURE_CHANNELS, &features),
        ];
        graph.output = vec![image(OUTPUT, colors, texts.color)];
        let json = |text: serde_json::Result<String>| {
            text.map_err(|error| BundleError::Encode(error.to_string()))
        };
        let entry = |key: &str, value| StringStringEntryProto {
            key: key.into(),
            value,
        };
        Ok(ModelProto {
            ir_version: IR_VERSION,
            producer_name: "demc".into(),
            producer_version: env!("CARGO_PKG_VERSION").into(),
            model_version: i64::try_from(bundle.meta.step).ok(),
            doc_string: texts.documentation.into(),
            graph: Some(graph),
            opset_import: vec![OperatorSetIdProto {
                domain: Some(String::new()),
                version: OPSET,
            }],
            metadata_props: vec![
                entry(
                    META,
                    json(serde_json::to_string(&Description::of(&bundle)))?,
                ),
                entry(FEATURE_ORDER, json(serde_json::to_string(&texts.features))?),
            ],
        })
    }
}

fn check_size(parameters: u64, precision: Precision) -> Result<(), BundleError> {
    let bytes_per_value = match precision {
        Precision::F32 => 4,
        Precision::F16 => 2,
    };
    match parameters * bytes_per_value + OTHER_BYTES {
        bytes if bytes > MAX_BYTES => Err(BundleError::TooLargeForOnnx { bytes }),
        _ => Ok(()),
    }
}

/// An input or output: a batch of images of any size.
fn image(name: &str, channels: usize, doc_string: &str) -> ValueInfoProto {
    let named = |name: &str| Extent::Named(name.into());
    let extents = [
        named("batch"),
        Extent::Fixed(channels as i64),
        named("height"),
        named("width"),
    ];
    let dim = extents.map(|extent| Dimension {
        value: Some(extent),
    });
    ValueInfoProto {
        name: name.into(),
        r#type: Some(TypeProto {
            tensor_type: Some(TensorTypeProto {
                elem_type: FLOAT,
                shape: Some(TensorShapeProto { dim: dim.into() }),
            }),
        }),
        doc_string: doc_string.into(),
    }
}

#[cfg(test)]
mod tests;
