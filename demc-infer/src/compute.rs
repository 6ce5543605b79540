//! `--ops` and `--isa`: how a device computes, for the commands of both binaries that run a network.

use burn::tensor::Device;
use clap::Args;
use demc_model::ops::{self, ISA_VARIABLE, Isa, Ops, UnknownIsa};

/// Flags for how to compute, flattened into a command.
#[derive(Args, Clone, Copy, Debug)]
pub struct ComputeFlags {
    /// Operations on the CPU device flex: kernels (ours) or burn (Burn's own, slower). Other devices have Burn's
    #[arg(long, value_name = "OPS", default_value_t)]
    ops: Ops,
    /// Instructions of the kernels: avx512, avx2, neon or portable, where the machine has them; auto: as the variable
    /// DEMC_ISA says, else the best
    #[arg(long, value_name = "ISA", default_value = "auto")]
    isa: IsaFlag,
}

/// `--isa`.
#[derive(Clone, Copy, Debug)]
struct IsaFlag(Option<Isa>);

impl std::str::FromStr for IsaFlag {
    type Err = UnknownIsa;

    fn from_str(name: &str) -> Result<Self, UnknownIsa> {
        match name {
            "auto" => Ok(IsaFlag(None)),
            name => name.parse().map(|isa| IsaFlag(Some(isa))),
        }
    }
}

/// The variable `DEMC_ISA` names no instruction path of this machine.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[error("{ISA_VARIABLE}: {0}")]
pub struct IsaError(UnknownIsa);

impl ComputeFlags {
    /// Makes this process compute so. To be called before a network is built.
    ///
    /// # Errors
    /// Where no path was asked for by flag and the environment's is unknown or not on this machine.
    pub fn apply(self) -> Result<(), IsaError> {
        ops::set_default(self.ops);
        match self.isa {
            IsaFlag(Some(isa)) => Isa::force(isa),
            IsaFlag(None) => {
                Isa::from_environment().map_err(IsaError)?;
            }
        }
        Ok(())
    }
}

/// What networks that are built now run on `device`, in words.
pub fn describe(device: &Device) -> String {
    ops::process_default().describe(device)
}

#[cfg(test)]
mod tests {
    use super::*;
    use clap::Parser;

    #[derive(Parser)]
    struct Program {
        #[command(flatten)]
        compute: ComputeFlags,
    }

    #[test]
    fn kernels_on_the_best_instructions_are_the_default() {
        let flags = Program::try_parse_from(["demc"]).expect("defaults").compute;
        assert_eq!((flags.ops, flags.isa.0), (Ops::Kernels, None));
    }

    #[test]
    fn what_does_not_exist_is_a_usage_error_that_lists_what_does() {
        for (flags, listed) in [
            (["demc", "--ops", "cpu"], "kernels, burn"),
            (["demc", "--isa", "sse9"], "portable"),
        ] {
            let error = Program::try_parse_from(flags).err().expect("unknown");
            assert_eq!(error.exit_code(), 2);
            assert!(error.to_string().contains(listed), "{error}");
        }
    }
}
