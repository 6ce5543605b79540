//! The operations of the network, twice: our CPU kernels (`demc-kernels`) and Burn's own tensor operations.
//!
//! [`Ops`] says which of them a network asks for. The kernels know Burn's CPU backend `flex` only, so on every other
//! device Burn's own run, whatever was asked for. Modules never see the difference: they work on [`Maps`], which hold
//! feature maps in the layout that the running implementation likes, and nothing outside this folder branches on it.
//!
//! | file | holds |
//! |---|---|
//! | `maps` | [`Maps`], what the modules call |
//! | `kernels/` | the kernels as a Burn backend extension for `flex`, with gradients |
//! | `stock` | the same operations made of Burn's |
//! | `adam` | the optimizer's step and the norm of a gradient, in place where the kernels run |
//! | `muon` | the other optimizer's step |
//! | `average` | the moving average of weights, likewise |

pub mod adam;
pub mod average;
mod kernels;
mod maps;
pub mod muon;
mod stock;

use std::fmt;
use std::str::FromStr;
use std::sync::atomic::{AtomicBool, Ordering};

use burn::tensor::{Device, Tensor};
pub use demc_kernels::Isa;
pub use demc_kernels::isa::{UnknownIsa, VARIABLE as ISA_VARIABLE};
pub use demc_kernels::memory::Recycler;
pub use demc_kernels::within_pool;
use thiserror::Error;

pub use maps::{Activation, Maps};

/// Which operations a network asks for.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Hash)]
pub enum Ops {
    /// The kernels of `demc-kernels` where the device is `flex`, Burn's elsewhere.
    #[default]
    Kernels,
    /// Burn's own everywhere.
    Burn,
}

/// A name that is none of [`Ops`].
#[derive(Clone, Debug, PartialEq, Eq, Error)]
#[error("operations `{name}` are unknown; there are: kernels, burn")]
pub struct UnknownOps {
    /// What was asked for.
    pub name: String,
}

/// Whether networks are built with Burn's operations, where nothing else is said.
static DEFAULT_IS_BURN: AtomicBool = AtomicBool::new(false);

/// Makes `ops` what the networks built from now on in this process ask for.
pub fn set_default(ops: Ops) {
    DEFAULT_IS_BURN.store(ops == Ops::Burn, Ordering::Relaxed);
}

/// What a network asks for where nothing else is said: the kernels, until [`set_default`] is called.
pub fn process_default() -> Ops {
    match DEFAULT_IS_BURN.load(Ordering::Relaxed) {
        true => Ops::Burn,
        false => Ops::Kernels,
    }
}

impl Ops {
    /// Both.
    pub const ALL: [Ops; 2] = [Ops::Kernels, Ops::Burn];

    /// Name in switches and reports.
    pub fn name(self) -> &'static str {
        match self {
            Ops::Kernels => "kernels",
            Ops::Burn => "burn",
        }
    }

    /// What runs on `device` where these are asked for.
    pub fn on(self, device: &Device) -> Ops {
        // Devices compare without regard to autodiff.
        match *device == Device::flex() {
            true => self,
            false => Ops::Burn,
        }
    }

    /// What runs on `device`, in words: `kernels on avx512`, or `Burn's operations`.
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

/// RelMSE (Eq. 5) of each image of a network's output in gamma space against a reference in linear HDR; see
/// [`Loss`](crate::Loss).
///
/// # Shapes
/// Two `[B, 3, H, W]` to `[B]`.
pub(crate) fn rel_mse_of_gamma(
    ops: Ops,
    out_gamma: Tensor<4>,
    ref_hdr: Tensor<4>,
    gamma: f32,
    epsilon: f32,
) -> Tensor<1> {
    match ops.on(&out_gamma.device()) {
        Ops::Kernels => kernels::rel_mse_of_gamma(out_gamma, ref_hdr, gamma, epsilon),
        Ops::Burn => stock::rel_mse_of_gamma(out_gamma, ref_hdr, gamma, epsilon),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn names_parse_back_and_unknown_ones_list_what_exists() {
        for ops in Ops::ALL {
            assert_eq!(ops.to_string().parse(), Ok(ops));
        }
        let message = "cpu".parse::<Ops>().expect_err("unknown").to_string();
        assert_eq!(
            message,
            "operations `cpu` are unknown; there are: kernels, burn"
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
