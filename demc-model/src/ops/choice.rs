//! Which implementation of the operations a network asks for.

use std::fmt;
use std::str::FromStr;
use std::sync::atomic::{AtomicBool, Ordering};

use burn::tensor::Device;
use demc_kernels::Isa;
use thiserror::Error;

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
    if DEFAULT_IS_BURN.load(Ordering::Relaxed) {
        Ops::Burn
    } else {
        Ops::Kernels
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
        if *device == Device::flex() {
            self
        } else {
            Ops::Burn
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
