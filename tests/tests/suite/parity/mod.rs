//! Parity with PyTorch on committed fixtures: each block, each variant in each reading, the loss,
//! every gradient, and five steps of Adam. `docs/network.md` describes the network.
//!
//! These tests need no Python. `tests/parity/make_fixtures.py` computes the fixtures in float64, so
//! deviations come from this implementation. `parity_live.rs` compares with an installed PyTorch.
//!
//! `DEMC_DEVICE` names the device (default `flex`) and `DEMC_OPS` the operations (default
//! `kernels`), so the fixtures test every backend of the build.

mod blocks;
mod kpcn;
mod networks;

use crate::tensors::Tolerance;
use burn::tensor::Device;

/// The device under test.
pub fn device() -> Device {
    if let Ok(name) = std::env::var("DEMC_OPS") {
        let ops = name.parse();
        demc_model::ops::set_default(ops.unwrap_or_else(|error| panic!("{error}")));
    }
    let name = std::env::var("DEMC_DEVICE").unwrap_or_else(|_| "flex".into());
    demc_infer::device::parse(&name).unwrap_or_else(|error| panic!("{error}"))
}

/// For outputs: after 27 layers, float32 PyTorch deviates by up to 1e-6 of the largest value.
pub const OUTPUT: Tolerance = Tolerance {
    absolute: 0.0,
    of_largest: 1e-5,
    of_value: 0.0,
};

/// For gradients: sums over up to 8192 pixels and 27 layers. float32 PyTorch deviates by up to 0.15
/// of this.
pub const GRADIENT: Tolerance = Tolerance {
    absolute: 0.0,
    of_largest: 2e-5,
    of_value: 1e-4,
};
