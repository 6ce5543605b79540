//! The operations of the network, implemented twice: our CPU kernels (`demc-kernels`) and Burn's
//! own.
//!
//! [`Ops`] is the implementation that a network asks for. The kernels support Burn's CPU backend
//! `flex`; every other device runs Burn's operations. Modules work on [`Maps`] and need not know
//! which one runs. Only this folder matches on [`Ops`].
//!
//! - `maps`: [`Maps`], the feature maps that the modules compute with
//! - `kernels/`: the kernels as a Burn backend extension for `flex`, with gradients
//! - `filter`: kernels per pixel with Burn's operations
//! - [`update`]: updates of the weights: Adam's step, the gradient's norm, the moving average
//! - [`muon`]: Muon's step

mod filter;
mod kernels;
mod maps;
pub mod muon;
pub mod update;

use std::fmt;
use std::str::FromStr;
use std::sync::atomic::{AtomicBool, Ordering};

use burn::tensor::{Device, Tensor};
pub use demc_kernels::Isa;
pub use demc_kernels::isa::{UnknownIsa, VARIABLE as ISA_VARIABLE};
pub use demc_kernels::memory::{Recycler, return_kept, used as used_bytes};
pub use demc_kernels::{start_threads, within_pool};
use thiserror::Error;

pub use maps::{Activation, Maps};

/// The implementation of the operations that a network asks for.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Hash)]
pub enum Ops {
    /// The kernels of `demc-kernels` on `flex`, Burn's operations on all other devices.
    #[default]
    Kernels,
    /// Burn's operations on all devices.
    Burn,
}

/// An unknown name of [`Ops`].
#[derive(Clone, Debug, PartialEq, Eq, Error)]
#[error("unknown operations `{name}`: expected kernels or burn")]
pub struct UnknownOps {
    /// The name.
    pub name: String,
}

/// Whether new networks use Burn's operations by default.
static DEFAULT_IS_BURN: AtomicBool = AtomicBool::new(false);

/// Sets the operations of all networks that this process builds from now on.
pub fn set_default(ops: Ops) {
    DEFAULT_IS_BURN.store(ops == Ops::Burn, Ordering::Relaxed);
}

/// The operations of a new network: the kernels, until [`set_default`] is called.
pub fn process_default() -> Ops {
    match DEFAULT_IS_BURN.load(Ordering::Relaxed) {
        true => Ops::Burn,
        false => Ops::Kernels,
    }
}

impl Ops {
    /// Both implementations.
    pub const ALL: [Ops; 2] = [Ops::Kernels, Ops::Burn];

    /// The name in command-line options and reports.
    pub fn name(self) -> &'static str {
        match self {
            Ops::Kernels => "kernels",
            Ops::Burn => "burn",
        }
    }

    /// The operations that run on `device` for a network that asks for these.
    pub fn on(self, device: &Device) -> Ops {
        // Devices compare without regard to autodiff.
        match *device == Device::flex() {
            true => self,
            false => Ops::Burn,
        }
    }

    /// Whether these operations have the inference pass on slices ([`crate::inference`]).
    pub fn has_fast_inference(self) -> bool {
        self == Ops::Kernels
    }

    /// The operations that run on `device`, in words: `kernels on avx512` or `Burn's operations`.
    pub fn describe(self, device: &Device) -> String {
        match self.on(device) {
            Ops::Kernels => format!("kernels on {}", Isa::current()),
            Ops::Burn => "Burn's operations".into(),
        }
    }
}

impl fmt::Display for Ops {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(self.name())
    }
}

impl FromStr for Ops {
    type Err = UnknownOps;

    fn from_str(name: &str) -> Result<Self, UnknownOps> {
        let known = Ops::ALL.into_iter().find(|ops| ops.name() == name);
        known.ok_or_else(|| UnknownOps { name: name.into() })
    }
}

/// RelMSE (Eq. 5) of each image: `1/N sum (ref - out)^2 / (ref^2 + epsilon)` in linear HDR, N the
/// number of pixels.
///
/// # Shapes
/// `out_gamma` in gamma space and `ref_hdr` in linear HDR, both `[B, 3, H, W]`, to `[B]`.
pub(crate) fn rel_mse_of_gamma(
    ops: Ops,
    out_gamma: Tensor<4>,
    ref_hdr: Tensor<4>,
    gamma: f32,
    epsilon: f32,
) -> Tensor<1> {
    match ops.on(&out_gamma.device()) {
        Ops::Kernels => kernels::rel_mse_of_gamma(out_gamma, ref_hdr, gamma, epsilon),
        Ops::Burn => {
            let [_, channels, ..] = out_gamma.dims();
            let difference = out_gamma.powf_scalar(gamma) - ref_hdr.clone();
            let relative = difference.square() / ref_hdr.square().add_scalar(epsilon);
            mean_per_image(relative).mul_scalar(channels as f32)
        }
    }
}

/// The mean of each image.
///
/// # Shapes
/// `[B, C, H, W]` to `[B]`.
pub(crate) fn mean_per_image(images: Tensor<4>) -> Tensor<1> {
    let [batch, ..] = images.dims();
    images
        .reshape([batch as isize, -1])
        .mean_dim(1)
        .reshape([-1])
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn names_parse_back_and_an_unknown_name_lists_the_known_ones() {
        for ops in Ops::ALL {
            assert_eq!(ops.to_string().parse(), Ok(ops));
        }
        let message = "cpu".parse::<Ops>().expect_err("unknown").to_string();
        assert_eq!(
            message,
            "unknown operations `cpu`: expected kernels or burn"
        );
    }

    #[test]
    fn kernels_run_on_flex_with_and_without_autodiff() {
        for device in [Device::flex(), Device::flex().autodiff()] {
            assert_eq!(Ops::Kernels.on(&device), Ops::Kernels);
            assert_eq!(Ops::Burn.on(&device), Ops::Burn);
        }
    }
}
