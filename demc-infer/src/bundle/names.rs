//! The names of tensors in a file, and their types.

use std::collections::BTreeMap;

use demc_model::{ModelConfig, Role, Weight, WeightSpec};
use safetensors::tensor::Dtype;
use serde::{Deserialize, Serialize};

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
    pub(super) fn dtype(self, role: Role) -> Dtype {
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

#[cfg(test)]
mod tests {
    use half::f16;

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
}
