//! Parity with PyTorch on committed fixtures: each block, each variant in each reading, the loss, every gradient, five
//! steps of Adam. No Python is needed here; `tests/parity/make_fixtures.py` makes the fixtures, in float64, so the
//! deviations are those of this side. `parity_live.rs` compares with a PyTorch that is there.

mod blocks;
mod fixture;
mod networks;
mod tensors;

use tensors::Tolerance;

/// Outputs: a float32 PyTorch is off by up to 1e-6 of the largest value, after 27 layers.
pub const OUTPUT: Tolerance = Tolerance {
    absolute: 0.0,
    of_largest: 1e-5,
    of_value: 0.0,
};

/// Gradients: sums over up to 8192 pixels and 27 layers, off by up to 0.15 of this in a float32 PyTorch.
pub const GRADIENT: Tolerance = Tolerance {
    absolute: 0.0,
    of_largest: 2e-5,
    of_value: 1e-4,
};
