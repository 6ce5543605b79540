//! Parity with PyTorch on committed fixtures: each block, each variant in each reading, the loss, every gradient, five
//! steps of Adam. No Python is needed here; `tests/parity/make_fixtures.py` makes the fixtures, in float64, so the
//! deviations are those of this side. `parity_live.rs` compares with a PyTorch that is there.
//!
//! `DEMC_DEVICE` names the device (default `flex`) and `DEMC_OPS` the operations (default `kernels`), so the same numbers are
//! asked of every backend that was built.

mod blocks;
mod fixture;
mod networks;
mod tensors;

use burn::tensor::Device;
use tensors::Tolerance;

/// The device under test.
pub fn device() -> Device {
    if let Ok(name) = std::env::var("DEMC_OPS") {
        let ops = name.parse();
        demc_model::ops::set_default(ops.unwrap_or_else(|error| panic!("{error}")));
    }
    let name = std::env::var("DEMC_DEVICE").unwrap_or_else(|_| "flex".into());
    demc_infer::device::parse(&name).unwrap_or_else(|error| panic!("{error}"))
}

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
