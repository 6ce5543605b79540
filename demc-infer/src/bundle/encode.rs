//! Weights to the bytes of a safetensors file: names and precision.

use std::collections::HashMap;

use demc_model::Weight;
use half::f16;
use half::slice::HalfFloatSliceExt;
use safetensors::tensor::Dtype;
use serde::{Deserialize, Serialize};

use super::tensors::{Encoded, f32_bytes, serialize};
use super::{BundleError, BundleMeta};

/// The header's metadata key that makes a safetensors file a bundle.
pub(super) const KEY: &str = "demc";

/// Whose names the tensors have. They differ for batch normalisation only, and both load.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Names {
    /// The fields of the Burn modules: `norm.gamma`, `norm.beta`.
    Burn,
    /// What PyTorch's `load_state_dict` expects: `norm.weight`, `norm.bias`.
    Torch,
}

/// Endings of names, Burn's and PyTorch's.
const ENDINGS: [(&str, &str); 2] = [
    (".norm.gamma", ".norm.weight"),
    (".norm.beta", ".norm.bias"),
];

impl Names {
    /// The name in a file of the tensor that Burn calls `name`.
    pub fn from_burn(self, name: &str) -> String {
        match self {
            Names::Burn => name.into(),
            Names::Torch => with_ending(name, ENDINGS),
        }
    }

    /// Burn's name of the tensor that a file calls `name`: the inverse of [`from_burn`](Self::from_burn).
    pub fn to_burn(self, name: &str) -> String {
        match self {
            Names::Burn => name.into(),
            Names::Torch => with_ending(name, ENDINGS.map(|(burn, torch)| (torch, burn))),
        }
    }
}

fn with_ending(name: &str, endings: [(&str, &str); 2]) -> String {
    endings
        .into_iter()
        .find_map(|(from, to)| Some(format!("{}{to}", name.strip_suffix(from)?)))
        .unwrap_or_else(|| name.into())
}

/// The type of the weights in a file. Batch normalisation stays f32: its running variance spans many decades.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Precision {
    /// 32 bits: what training uses.
    F32,
    /// 16 bits: half the size, rounded to 11 significant bits.
    F16,
}

impl Precision {
    /// The type in the file of the tensor that Burn calls `name`.
    fn dtype(self, name: &str) -> Dtype {
        match self {
            Precision::F16 if !name.contains(".norm.") => Dtype::F16,
            _ => Dtype::F32,
        }
    }

    /// Whether `theirs` is `ours` after a trip through a file of this precision: bit for bit in f32, within half a
    /// unit in the last place (2^-11, or 2^-25 among the subnormals) in f16.
    pub(super) fn keeps(self, ours: &Weight, theirs: &Weight) -> bool {
        let equal = |a: f32, b: f32| match self.dtype(&ours.name) {
            Dtype::F16 => (a - b).abs() <= (a.abs() * 2f32.powi(-11)).max(2f32.powi(-25)),
            _ => a.to_bits() == b.to_bits(),
        };
        ours.name == theirs.name
            && ours.shape == theirs.shape
            && ours.data.len() == theirs.data.len()
            && ours
                .data
                .iter()
                .zip(&theirs.data)
                .all(|(&a, &b)| equal(a, b))
    }
}

/// The header entry: the metadata with the names' style beside it.
#[derive(Serialize)]
struct Header<'a> {
    #[serde(flatten)]
    meta: &'a BundleMeta,
    names: Names,
}

/// The bytes of a bundle file. safetensors sorts the tensors by type and name, so equal inputs give equal bytes.
///
/// # Errors
/// A weight beyond f16's range.
pub(super) fn encode(
    meta: &BundleMeta,
    weights: Vec<Weight>,
    names: Names,
    precision: Precision,
) -> Result<Vec<u8>, BundleError> {
    let header = serde_json::to_string(&Header { meta, names });
    let header = header.map_err(|error| BundleError::Encode(error.to_string()))?;
    let mut tensors = Vec::with_capacity(weights.len());
    for weight in weights {
        let dtype = precision.dtype(&weight.name);
        tensors.push(Encoded {
            name: names.from_burn(&weight.name),
            dtype,
            bytes: match dtype {
                Dtype::F16 => f16_bytes(&weight)?,
                _ => f32_bytes(&weight.data),
            },
            shape: weight.shape,
        });
    }
    let metadata = HashMap::from([(KEY.to_string(), header)]);
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
    fn torch_names_differ_in_batch_normalisation_only_and_go_back() {
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
            assert_eq!(Names::Torch.from_burn(burn), torch);
            assert_eq!(Names::Torch.to_burn(torch), burn);
            assert_eq!(Names::Burn.from_burn(burn), burn);
        }
    }

    #[test]
    fn f16_keeps_what_it_rounds_and_nothing_worse() {
        let weight = |value: f32| Weight {
            name: "decoder.head.bias".into(),
            shape: vec![1],
            data: vec![value],
        };
        for value in [0.0, 0.1, -3.3, 1e-7, 6e-8, 65504.0] {
            let rounded = f16::from_f32(value).to_f32();
            assert!(
                Precision::F16.keeps(&weight(value), &weight(rounded)),
                "{value}"
            );
        }
        assert!(!Precision::F16.keeps(&weight(1.0), &weight(1.001)));
        assert!(!Precision::F32.keeps(&weight(0.0), &weight(-0.0)));
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
