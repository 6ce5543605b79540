//! Encodes weights as a safetensors file.

use std::collections::HashMap;

use demc_model::Weight;
use half::f16;
use half::slice::HalfFloatSliceExt;
use safetensors::tensor::Dtype;
use serde::Serialize;

use super::checksum::{SummedTensor, of_bundle};
use super::error::BundleError;
use super::meta::BundleMeta;
use super::names::{Names, Precision};
use super::network::{Bundle, PREFIX};
use super::tensors::{EncodedTensor, f32_bytes, serialize};

/// The metadata key in the header that identifies a bundle.
pub(super) const KEY: &str = "demc";

/// Everything about a bundle's networks except their weights, as JSON.
#[derive(Serialize)]
pub(crate) struct Description<'a> {
    #[serde(flatten)]
    meta: &'a BundleMeta,
    #[serde(skip_serializing_if = "Option::is_none")]
    albedo_filter: Option<&'a BundleMeta>,
}

impl<'a> Description<'a> {
    pub(crate) fn of(bundle: &'a Bundle) -> Self {
        Self {
            meta: &bundle.meta,
            albedo_filter: bundle.albedo_filter.as_ref().map(|filter| &filter.meta),
        }
    }
}

/// The header entry: the description, the naming scheme and the checksum.
#[derive(Serialize)]
struct Header<'a> {
    #[serde(flatten)]
    description: Description<'a>,
    names: Names,
    sha256: &'a str,
}

impl Header<'_> {
    fn to_json(&self) -> Result<String, BundleError> {
        serde_json::to_string(self).map_err(|error| BundleError::Encode(error.to_string()))
    }
}

/// The bytes of a bundle file. safetensors sorts tensors by type and name, so equal inputs give
/// equal bytes.
///
/// # Errors
/// A weight beyond f16's range.
pub(super) fn encode(
    bundle: &Bundle,
    names: Names,
    precision: Precision,
) -> Result<Vec<u8>, BundleError> {
    let mut tensors = Vec::new();
    for (network, prefix) in bundle.networks().zip(["", PREFIX]) {
        let specs = network.meta.model.weight_specs();
        for (mut weight, spec) in network.model.weights().into_iter().zip(specs) {
            debug_assert_eq!(weight.name, spec.name);
            weight.name.insert_str(0, prefix);
            let dtype = precision.dtype(spec.role);
            tensors.push(EncodedTensor {
                name: format!("{prefix}{}", names.in_file(&spec)),
                dtype,
                bytes: match dtype {
                    Dtype::F16 => f16_bytes(&weight)?,
                    _ => f32_bytes(&weight.data),
                },
                shape: weight.shape,
            });
        }
    }
    let mut header = Header {
        description: Description::of(bundle),
        names,
        sha256: "",
    };
    let summed = tensors
        .iter()
        .map(|tensor| SummedTensor::new(&tensor.name, tensor.dtype, &tensor.shape, &tensor.bytes));
    let sum = of_bundle(&header.to_json()?, summed.collect());
    header.sha256 = &sum;
    let metadata = HashMap::from([(KEY.to_string(), header.to_json()?)]);
    serialize(&tensors, Some(metadata)).map_err(BundleError::Encode)
}

fn f16_bytes(weight: &Weight) -> Result<Vec<u8>, BundleError> {
    let mut halves = vec![f16::ZERO; weight.data.len()];
    halves.convert_from_f32_slice(&weight.data);
    match halves.iter().position(|half| !half.is_finite()) {
        Some(i) => Err(BundleError::Overflow {
            name: weight.name.clone(),
            value: weight.data[i],
        }),
        None => Ok(halves.iter().flat_map(|half| half.to_le_bytes()).collect()),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_weight_beyond_f16_is_named() {
        let weight = Weight {
            name: "decoder.head.bias".into(),
            shape: vec![2],
            data: vec![1.0, 1e6],
        };
        let error = f16_bytes(&weight).expect_err("too large").to_string();
        assert_eq!(
            error,
            "tensor decoder.head.bias: 1000000 does not fit into f16; export with f32"
        );
    }
}
