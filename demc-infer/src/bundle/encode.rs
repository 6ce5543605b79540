//! Encodes weights as a safetensors file: names and precision.

use std::collections::{BTreeMap, HashMap};

use demc_model::{ModelConfig, Role, Weight, WeightSpec};
use half::f16;
use half::slice::HalfFloatSliceExt;
use safetensors::tensor::Dtype;
use serde::{Deserialize, Serialize};

use super::checksum::{SummedTensor, of_bundle};
use super::tensors::{EncodedTensor, f32_bytes, serialize};
use super::{Bundle, BundleError, BundleMeta, PREFIX};

/// The metadata key in the header that identifies a bundle.
pub(super) const KEY: &str = "demc";

/// The naming scheme of the tensors. The schemes differ for batch normalisation only, and both
/// load.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Names {
    /// Field names of the Burn modules: `norm.gamma`, `norm.beta`.
    Burn,
    /// Names that PyTorch's `load_state_dict` expects: `norm.weight`, `norm.bias`.
    Torch,
}

impl Names {
    /// The name of a tensor in a file. PyTorch calls the scale and shift of a batch normalisation
    /// `weight` and `bias`.
    pub fn in_file(self, spec: &WeightSpec) -> String {
        match (self, spec.role) {
            (Names::Torch, Role::NormScale) => format!("{}.weight", spec.layer()),
            (Names::Torch, Role::NormShift) => format!("{}.bias", spec.layer()),
            _ => spec.name.clone(),
        }
    }

    /// A network's tensors, keyed by their names in a file.
    pub fn specs_in_file(self, model: &ModelConfig) -> BTreeMap<String, WeightSpec> {
        let specs = model.weight_specs().into_iter();
        specs.map(|spec| (self.in_file(&spec), spec)).collect()
    }
}

/// The type of the weights in a file. Batch normalisation stays f32, because its running variance
/// spans many orders of magnitude.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Precision {
    /// 32 bits, as in training.
    F32,
    /// 16 bits: half the size, rounded to 11 significant bits.
    F16,
}

impl Precision {
    /// The type of a tensor in a file.
    fn dtype(self, role: Role) -> Dtype {
        match self {
            Precision::F16 if !role.is_norm() => Dtype::F16,
            _ => Dtype::F32,
        }
    }

    /// Whether `read` equals `written` after storage with this precision.
    ///
    /// f32 is compared bit for bit, f16 within half a unit in the last place (2^-11, or 2^-25 for
    /// subnormals).
    pub(super) fn preserves(self, role: Role, written: &Weight, read: &Weight) -> bool {
        let equal = |a: f32, b: f32| match self.dtype(role) {
            Dtype::F16 => (a - b).abs() <= (a.abs() * 2f32.powi(-11)).max(2f32.powi(-25)),
            _ => a.to_bits() == b.to_bits(),
        };
        written.name == read.name
            && written.shape == read.shape
            && written.data.len() == read.data.len()
            && written
                .data
                .iter()
                .zip(&read.data)
                .all(|(&a, &b)| equal(a, b))
    }
}

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
    fn pytorch_names_differ_for_batch_normalisation_only() {
        let specs = super::super::testing::bundle(demc_model::Variant::Demc)
            .meta
            .model
            .weight_specs();
        let name_of = |burn: &str| {
            let spec = specs.iter().find(|spec| spec.name == burn).expect(burn);
            assert_eq!(Names::Burn.in_file(spec), burn);
            Names::Torch.in_file(spec)
        };
        for (burn, torch) in [
            ("fusion.blocks.1.norm.gamma", "fusion.blocks.1.norm.weight"),
            ("latent.norm.beta", "latent.norm.bias"),
            ("latent.norm.running_mean", "latent.norm.running_mean"),
            ("decoder.head.weight", "decoder.head.weight"),
            (
                "decoder.levels.0.deconv.bias",
                "decoder.levels.0.deconv.bias",
            ),
        ] {
            assert_eq!(name_of(burn), torch);
        }
    }

    #[test]
    fn f16_preserves_values_up_to_rounding() {
        let weight = |value: f32| Weight {
            name: "decoder.head.bias".into(),
            shape: vec![1],
            data: vec![value],
        };
        for value in [0.0, 0.1, -3.3, 1e-7, 6e-8, 65504.0] {
            let rounded = f16::from_f32(value).to_f32();
            assert!(
                Precision::F16.preserves(Role::Bias, &weight(value), &weight(rounded)),
                "{value}"
            );
        }
        assert!(!Precision::F16.preserves(Role::Bias, &weight(1.0), &weight(1.001)));
        assert!(!Precision::F32.preserves(Role::Bias, &weight(0.0), &weight(-0.0)));
    }

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
