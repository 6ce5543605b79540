//! `--ops` and `--isa`: operations and instruction set, for all commands that run a network.

use std::sync::{Mutex, PoisonError};

use burn::tensor::Device;
use demc_model::ops::{self, ISA_VARIABLE, Isa, Ops, UnknownIsa};

use crate::memory;

/// Flags for operations and instruction set.
#[derive(Clone, Copy, Debug)]
#[cfg_attr(feature = "cli", derive(clap::Args))]
pub struct ComputeFlags {
    /// Operations on the CPU device flex: kernels (this project's) or burn (Burn's, slower). Other
    /// devices use Burn's
    #[cfg_attr(feature = "cli", arg(long, value_name = "OPS", default_value_t))]
    ops: Ops,
    /// Instruction set of the kernels: avx512, avx2, neon or portable. auto uses the variable
    /// DEMC_ISA, or the best set of this machine
    #[cfg_attr(feature = "cli", arg(long, value_name = "ISA", default_value = "auto"))]
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

/// The variable `DEMC_ISA` names no instruction set of this machine.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[error("{ISA_VARIABLE}: {0}")]
pub struct IsaError(UnknownIsa);

impl ComputeFlags {
    /// Applies the flags to this process. Call it before a network is built.
    ///
    /// # Errors
    /// `--isa` is `auto`, and the variable names a set that is unknown or not on this machine.
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

/// Memory in bytes without which a program cannot read a model (ours: 250 MiB of address space suffice
/// for a bundled one).
const LEAST_MEMORY: u64 = 128 << 20;

/// Runs a program's `work` on one of its threads: as many as `RAYON_NUM_THREADS` asks for, at most
/// four per processor ([`demc_program::parallel::threads`]). The first call starts them.
///
/// # Errors
/// The process's limits leave too little memory or too few threads.
pub fn on_threads<R: Send>(work: impl FnOnce() -> R + Send) -> Result<R, StartError> {
    static STARTED: Mutex<bool> = Mutex::new(false);
    let mut started = STARTED.lock().unwrap_or_else(PoisonError::into_inner);
    if !*started {
        start()?;
        *started = true;
    }
    drop(started);
    Ok(ops::within_pool(work))
}

/// Starts the threads.
fn start() -> Result<(), StartError> {
    if let Some(left) = memory::below_own_limits().filter(|left| *left < LEAST_MEMORY) {
        let left = left >> 20;
        return Err(StartError::Memory { left });
    }
    let count = demc_program::parallel::threads().count;
    ops::start_threads(count).map_err(|error| StartError::Threads {
        count,
        reason: error.to_string(),
    })
}

/// The process's limits are too low for any work.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[allow(missing_docs, reason = "the messages explain the fields")]
pub enum StartError {
    /// Too little memory, in MiB.
    #[error("the limits on memory leave {left} MiB, but {} are needed; raise ulimit -v", LEAST_MEMORY >> 20)]
    Memory { left: u64 },
    /// Too few threads.
    #[error("cannot start {count} threads: {reason}; lower RAYON_NUM_THREADS or raise the limits")]
    Threads { count: usize, reason: String },
}

/// Describes the operations and instruction set of networks that are now built for `device`.
pub fn describe(device: &Device) -> String {
    ops::process_default().describe(device)
}

#[cfg(all(test, feature = "cli"))]
mod tests {
    use super::*;
    use clap::Parser;

    #[derive(Parser)]
    struct Program {
        #[command(flatten)]
        compute: ComputeFlags,
    }

    #[test]
    fn kernels_with_the_best_instruction_set_are_the_default() {
        let flags = Program::try_parse_from(["demc"]).expect("defaults").compute;
        assert_eq!((flags.ops, flags.isa.0), (Ops::Kernels, None));
    }

    #[test]
    fn an_unknown_value_is_a_usage_error_that_lists_the_known_ones() {
        for (flags, listed) in [
            (["demc", "--ops", "cpu"], "kernels or burn"),
            (["demc", "--isa", "sse9"], "portable"),
        ] {
            let error = Program::try_parse_from(flags).err().expect("unknown");
            assert_eq!(error.exit_code(), 2);
            assert!(error.to_string().contains(listed), "{error}");
        }
    }
}
