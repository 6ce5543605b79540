//! Tensors in safetensors files, and their comparison.

use std::collections::BTreeMap;
use std::fs;
use std::path::Path;

use safetensors::SafeTensors;

/// A tensor on the host.
#[derive(Clone, Debug)]
pub struct HostTensor {
    /// Axes, outermost first.
    pub shape: Vec<usize>,
    /// Row-major values.
    pub data: Vec<f32>,
}

/// All tensors of a safetensors file of f32.
pub fn read(path: &Path) -> BTreeMap<String, HostTensor> {
    let bytes = fs::read(path).unwrap_or_else(|e| panic!("{}: {e}", path.display()));
    let file = SafeTensors::deserialize(&bytes).expect("a whole safetensors file");
    let values = |bytes: &[u8]| {
        let words = bytes.as_chunks::<4>().0.iter();
        words.map(|&word| f32::from_le_bytes(word)).collect()
    };
    let tensors = file.iter().map(|(name, view)| {
        let shape = view.shape().to_vec();
        (
            name.to_string(),
            HostTensor {
                shape,
                data: values(view.data()),
            },
        )
    });
    tensors.collect()
}

/// Maximum difference from the expected value: the sum of the three parts.
#[derive(Clone, Copy, Debug, Default)]
pub struct Tolerance {
    /// In the unit of the values.
    pub absolute: f32,
    /// As a share of the tensor's largest expected value.
    pub of_largest: f32,
    /// As a share of the expected value itself.
    pub of_value: f32,
}

/// Asserts that all elements are within the tolerance; a failure names `what` and the worst
/// element. Returns the largest share of the tolerance.
pub fn assert_close(what: &str, found: &[f32], expected: &[f32], tolerance: Tolerance) -> f32 {
    assert_eq!(found.len(), expected.len(), "{what}: number of values");
    let largest = expected.iter().fold(0.0f32, |m, v| m.max(v.abs()));
    let share = |(found, expected): (&f32, &f32)| {
        let allowed = tolerance.absolute
            + tolerance.of_largest * largest
            + tolerance.of_value * expected.abs();
        let difference = (found - expected).abs();
        // Equal zeros pass any tolerance, NaN passes none.
        if difference == 0.0 {
            0.0
        } else if difference.is_nan() {
            f32::INFINITY
        } else {
            difference / allowed
        }
    };
    let shares = found.iter().zip(expected).map(share);
    let (worst, index) = shares.zip(0..).fold(
        (0.0, 0),
        |best, next| if next.0 > best.0 { next } else { best },
    );
    assert!(
        worst <= 1.0,
        "{what}[{index}]: found {}, expected {}: {worst:.2} times the tolerance (largest value {largest})",
        found[index],
        expected[index],
    );
    worst
}
