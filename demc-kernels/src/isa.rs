//! The vector instructions to use: detected at run time, or forced.

use std::fmt;
use std::str::FromStr;
use std::sync::OnceLock;
use std::sync::atomic::{AtomicU8, Ordering};

/// Environment variable that forces a path where [`Isa::force`] was not called; see
/// [`Isa::current`].
pub const VARIABLE: &str = "DEMC_ISA";

/// An instruction path.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
pub enum Isa {
    /// AVX-512 F, 16 lanes, 32 registers.
    Avx512,
    /// AVX2 and FMA, 8 lanes, 16 registers.
    Avx2,
    /// NEON of AArch64, 4 lanes, 32 registers.
    Neon,
    /// Plain Rust, vectorised with the instructions that every machine of the architecture has.
    Portable,
}

/// A path that this machine does not have.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[error(
    "instruction path `{name}` is unknown or not on this machine, which has: {}",
    list(&Isa::available())
)]
pub struct UnknownIsa {
    /// The requested name.
    pub name: String,
}

fn list(paths: &[Isa]) -> String {
    let names: Vec<&str> = paths.iter().map(|isa| isa.name()).collect();
    names.join(", ")
}

impl Isa {
    const ALL: [Isa; 4] = [Isa::Avx512, Isa::Avx2, Isa::Neon, Isa::Portable];

    /// Name in switches and reports.
    pub fn name(self) -> &'static str {
        match self {
            Isa::Avx512 => "avx512",
            Isa::Avx2 => "avx2",
            Isa::Neon => "neon",
            Isa::Portable => "portable",
        }
    }

    pub(crate) fn is_available(self) -> bool {
        // Miri runs no vendor instructions.
        if cfg!(miri) {
            return self == Isa::Portable;
        }
        match self {
            #[cfg(target_arch = "x86_64")]
            Isa::Avx512 => {
                std::arch::is_x86_feature_detected!("avx512f") && Isa::Avx2.is_available()
            }
            #[cfg(target_arch = "x86_64")]
            Isa::Avx2 => {
                std::arch::is_x86_feature_detected!("avx2")
                    && std::arch::is_x86_feature_detected!("fma")
            }
            #[cfg(target_arch = "aarch64")]
            Isa::Neon => std::arch::is_aarch64_feature_detected!("neon"),
            Isa::Portable => true,
            #[allow(unreachable_patterns, reason = "the paths of other architectures")]
            _ => false,
        }
    }

    /// The paths of this machine, the best first.
    pub fn available() -> Vec<Isa> {
        Isa::ALL
            .into_iter()
            .filter(|isa| isa.is_available())
            .collect()
    }

    /// The path to use: the forced one, else the one named by [`VARIABLE`], else the best.
    ///
    /// Ignores a variable that names no path of this machine; binaries check it with
    /// [`Isa::from_environment`].
    pub fn current() -> Isa {
        static DEFAULT: OnceLock<Isa> = OnceLock::new();
        match FORCED.load(Ordering::Relaxed) {
            NONE => *DEFAULT.get_or_init(|| {
                let named = Isa::from_environment().ok().flatten();
                named.unwrap_or_else(|| Isa::available()[0])
            }),
            index => Isa::ALL[usize::from(index)],
        }
    }

    /// The path for products of this number of channels: 8 or fewer leave half of a 512-bit vector
    /// empty.
    pub(crate) fn for_channels(self, channels: usize) -> Isa {
        match (self, channels) {
            (Isa::Avx512, ..=8) => Isa::Avx2,
            _ => self,
        }
    }

    /// The path named by the variable [`VARIABLE`], if it is set.
    ///
    /// # Errors
    /// If this machine does not have the named path.
    pub fn from_environment() -> Result<Option<Isa>, UnknownIsa> {
        match std::env::var(VARIABLE) {
            Ok(name) => name.parse().map(Some),
            Err(_) => Ok(None),
        }
    }

    /// Makes [`Isa::current`] return `isa` in this process.
    ///
    /// # Panics
    /// If the machine does not have `isa`.
    pub fn force(isa: Isa) {
        assert!(isa.is_available(), "{isa} is not on this machine");
        FORCED.store(isa as u8, Ordering::Relaxed);
    }
}

const NONE: u8 = u8::MAX;
static FORCED: AtomicU8 = AtomicU8::new(NONE);

impl fmt::Display for Isa {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(self.name())
    }
}

impl FromStr for Isa {
    type Err = UnknownIsa;

    fn from_str(name: &str) -> Result<Self, UnknownIsa> {
        let known = Isa::available().into_iter().find(|isa| isa.name() == name);
        known.ok_or_else(|| UnknownIsa { name: name.into() })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn names_parse_back_and_unknown_ones_list_what_exists() {
        for isa in Isa::available() {
            assert_eq!(isa.name().parse(), Ok(isa));
        }
        let message = "sse9".parse::<Isa>().expect_err("unknown").to_string();
        assert!(
            message.contains("`sse9`") && message.contains("portable"),
            "{message}"
        );
    }
}
