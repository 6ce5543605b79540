//! The network for other runtimes: one ONNX graph from what a renderer writes to what it wants.
//!
//! | name | shape | what |
//! |---|---|---|
//! | `color` | `[batch, 3, height, width]` | noisy radiance, linear HDR; below 0 counts as 0 |
//! | `features` | `[batch, 12, height, width]` | raw features in the order of [`FEATURE_NAMES`], in the renderer's units |
//! | `output` | `[batch, 3, height, width]` | radiance, linear HDR, not negative |
//!
//! Batch, height and width are free, height and width multiples of 32: of another size a runtime refuses the first skip
//! fusion. Gamma, Z-score and the way back are in the graph, batch normalisation is folded into the convolutions before it.
//! All variants have both inputs; color-only does not look at the second. In and out is float32, and so is every
//! computation; [`Precision::F16`] is how the convolutions' weights are stored.
//!
//! The opset is 17, of June 2022: later ones add types to the operators used here and change nothing that they compute, so a
//! newer one would only shut older runtimes out.

mod graph;
mod network;
mod proto;

use std::fs;
use std::io::Write;
use std::path::Path;

use demc_data::frame::FEATURE_NAMES;
use demc_model::ModelConfig;
use demc_model::config::{COLOR_CHANNELS, FEATURE_CHANNELS};

use crate::{Bundle, BundleError, Precision};
use graph::Graph;
use proto::{
    Dimension, Entry, Extent, FLOAT, Message, Model, OperatorSet, Shape, TensorType, Type,
    ValueInfo,
};

/// The operator set.
pub const OPSET: i64 = 17;
/// The version of the file format that came with it (ONNX 1.12).
const IR_VERSION: i64 = 8;
/// Protobuf's limit for a message: what lies above it only files beside the graph could hold.
const MOST_BYTES: u64 = i32::MAX as u64;
/// More than a file takes beside its weights: names, settings, texts. Measured: 21 kB.
const OTHER_BYTES: u64 = 1 << 20;

/// Name of the input with the noisy colour.
pub const COLOR: &str = "color";
/// Name of the input with the features.
pub const FEATURES: &str = "features";
/// Name of the output.
pub const OUTPUT: &str = "output";
/// Key of the metadata that a bundle has in its header: model, normalizer, layout, step, as JSON.
pub const META: &str = "demc";
/// Key of the metadata with [`FEATURE_NAMES`], as JSON.
pub const FEATURE_ORDER: &str = "demc.features";

const DOCUMENTATION: &str = "DEMC, a denoiser for Monte Carlo renderings (Yang et al. 2019). color [batch, 3, height, width] is noisy \
    radiance in linear HDR, features [batch, 12, height, width] are shading normal xyz, world position xyz, texture RGB at the \
    first and at the second intersection, raw, in the renderer's units; output [batch, 3, height, width] is radiance in linear \
    HDR. Height and width are multiples of 32: repeat the last row and column, and cut the output. Values must be finite. \
    Metadata: `demc` has model, statistics, channel names and training step as JSON, `demc.features` the order of the features.";

impl Bundle {
    /// Writes the network as an ONNX file, whole or not at all, then reads it back and compares. In f16 the file holds the
    /// weights of [`rounded`](Self::rounded).
    ///
    /// The model must be on `flex`.
    ///
    /// # Errors
    /// A weight that f16 cannot hold, a network too large for one file, a path that cannot be written;
    /// [`BundleError::ReadBack`] where another file is read than was written.
    pub fn export_onnx(&self, path: &Path, precision: Precision) -> Result<(), BundleError> {
        check_size(&self.meta.model, precision)?;
        let model = self.onnx(precision)?;
        let bytes = model.encode_to_vec();
        demc_data::file::write_whole(path, |file| file.write_all(&bytes))?;
        drop(bytes);
        let back = fs::read(path).map_err(|source| BundleError::Read {
            path: path.into(),
            source,
        })?;
        match Model::decode(&back[..]) {
            Ok(back) if back == model => Ok(()),
            Ok(_) => Err("the graph".to_string()),
            Err(error) => Err(error.to_string()),
        }
        .map_err(|what| BundleError::ReadBack {
            path: path.into(),
            what,
        })
    }

    /// The file's message.
    fn onnx(&self, precision: Precision) -> Result<Model, BundleError> {
        let bundle = self.rounded(precision)?;
        let mut graph = Graph::new(precision);
        graph.denoise(&bundle.model, &bundle.meta.normalizer);
        let mut graph = graph.finish();
        graph.name = "demc".into();
        graph.input = vec![
            image(COLOR, COLOR_CHANNELS, "Noisy radiance, linear HDR"),
            image(FEATURES, FEATURE_CHANNELS, &FEATURE_NAMES.join(", ")),
        ];
        graph.output = vec![image(OUTPUT, COLOR_CHANNELS, "Radiance, linear HDR")];
        let json = |text: serde_json::Result<String>| {
            text.map_err(|error| BundleError::Encode(error.to_string()))
        };
        let entry = |key: &str, value| Entry {
            key: key.into(),
            value,
        };
        Ok(Model {
            ir_version: IR_VERSION,
            producer_name: "demc".into(),
            producer_version: env!("CARGO_PKG_VERSION").into(),
            model_version: i64::try_from(bundle.meta.step).ok(),
            doc_string: DOCUMENTATION.into(),
            graph: Some(graph),
            opset_import: vec![OperatorSet {
                domain: Some(String::new()),
                version: OPSET,
            }],
            metadata_props: vec![
                entry(META, json(serde_json::to_string(&bundle.meta))?),
                entry(FEATURE_ORDER, json(serde_json::to_string(&FEATURE_NAMES))?),
            ],
        })
    }
}

/// Refuses a network that one file cannot hold.
fn check_size(config: &ModelConfig, precision: Precision) -> Result<(), BundleError> {
    let each = match precision {
        Precision::F32 => 4,
        Precision::F16 => 2,
    };
    match config.parameter_count() * each + OTHER_BYTES {
        bytes if bytes > MOST_BYTES => Err(BundleError::TooLargeForOnnx { bytes }),
        _ => Ok(()),
    }
}

/// A batch of images of any size.
fn image(name: &str, channels: usize, doc_string: &str) -> ValueInfo {
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
    ValueInfo {
        name: name.into(),
        r#type: Some(Type {
            tensor_type: Some(TensorType {
                elem_type: FLOAT,
                shape: Some(Shape { dim: dim.into() }),
            }),
        }),
        doc_string: doc_string.into(),
    }
}

#[cfg(test)]
mod tests;
