//! Converts named tensors to and from the bytes of a safetensors file.

use std::collections::HashMap;

use demc_model::Weight;
use demc_program::message::printable;
use half::f16;
use safetensors::tensor::{Dtype, SafeTensors, TensorView};

/// A tensor as stored in a file.
pub(super) struct EncodedTensor {
    pub name: String,
    pub dtype: Dtype,
    pub shape: Vec<usize>,
    pub bytes: Vec<u8>,
}

/// The bytes of a file. safetensors sorts tensors by type and name, so equal inputs give equal
/// bytes if `metadata` has at most one key.
///
/// # Errors
/// A message about a tensor whose bytes do not fit its shape.
pub(super) fn serialize(
    tensors: &[EncodedTensor],
    metadata: Option<HashMap<String, String>>,
) -> Result<Vec<u8>, String> {
    let views = tensors.iter().map(|tensor| {
        let view = TensorView::new(tensor.dtype, tensor.shape.clone(), &tensor.bytes)?;
        Ok((tensor.name.as_str(), view))
    });
    views
        .collect::<Result<Vec<_>, safetensors::SafeTensorError>>()
        .and_then(|views| safetensors::serialize(views, metadata))
        .map_err(|error| error.to_string())
}

/// Little-endian bytes of float32 values.
pub(crate) fn f32_bytes(values: &[f32]) -> Vec<u8> {
    values.iter().flat_map(|v| v.to_le_bytes()).collect()
}

/// The values of a tensor as f32.
///
/// # Errors
/// A message about a type other than f32 and f16, NaN or infinity.
pub(super) fn values(view: &TensorView<'_>) -> Result<Vec<f32>, String> {
    let bytes = view.data();
    let data: Vec<f32> = match view.dtype() {
        Dtype::F32 => bytes
            .as_chunks()
            .0
            .iter()
            .map(|b| f32::from_le_bytes(*b))
            .collect(),
        Dtype::F16 => bytes
            .as_chunks()
            .0
            .iter()
            .map(|b| f16::from_le_bytes(*b).to_f32())
            .collect(),
        other => return Err(format!("type {other}; expected F32 or F16")),
    };
    match data.iter().find(|value| !value.is_finite()) {
        Some(value) => Err(format!("{value} among its values")),
        None => Ok(data),
    }
}

/// The bytes of a file with f32 tensors and no metadata, for an optimizer's state.
///
/// # Errors
/// A tensor whose values do not fit its shape.
pub fn to_bytes(weights: &[Weight]) -> Result<Vec<u8>, super::BundleError> {
    let encoded: Vec<EncodedTensor> = weights
        .iter()
        .map(|weight| EncodedTensor {
            name: weight.name.clone(),
            dtype: Dtype::F32,
            shape: weight.shape.clone(),
            bytes: f32_bytes(&weight.data),
        })
        .collect();
    serialize(&encoded, None).map_err(super::BundleError::Encode)
}

/// The tensors of a file from [`to_bytes`], in any order.
///
/// # Errors
/// A message: the bytes are cut short or no safetensors file, or a tensor has a type other than f32
/// and f16, NaN or infinity.
pub fn from_bytes(bytes: &[u8]) -> Result<Vec<Weight>, String> {
    let file = SafeTensors::deserialize(bytes).map_err(|error| printable(&error.to_string()))?;
    let weights = file.tensors().into_iter().map(|(name, view)| {
        let data =
            values(&view).map_err(|detail| format!("tensor {}: {detail}", printable(&name)))?;
        let shape = view.shape().to_vec();
        Ok(Weight { name, shape, data })
    });
    weights.collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn weights_survive_a_round_trip() {
        let weight = |name: &str, data: &[f32]| Weight {
            name: name.into(),
            shape: vec![1, data.len()],
            data: data.to_vec(),
        };
        let weights = vec![weight("a.m", &[0.1, -2.0]), weight("a.v", &[1e-30, 3.0])];
        let bytes = to_bytes(&weights).unwrap();
        let mut back = from_bytes(&bytes).unwrap();
        back.sort_by(|a, b| a.name.cmp(&b.name));
        assert_eq!(back, weights);
        assert!(from_bytes(&bytes[..bytes.len() - 1]).is_err());
        let bad = to_bytes(&[weight("a.m", &[f32::NAN])]).unwrap();
        assert_eq!(
            from_bytes(&bad).unwrap_err(),
            "tensor a.m: NaN among its values"
        );
    }
}
