//! Arguments of all subcommands that compute, and their exit after a signal.

use crate::ranks::{OnNode, Ranks};
use crate::record::progress::say;
use crate::run::session::SessionPlace;
use crate::run::signals;
use burn::tensor::Device;
use clap::Args;
use demc_infer::compute::ComputeFlags;
use demc_infer::device;

/// Device and implementation of the computation.
#[derive(Debug, Args)]
pub(super) struct ComputeArguments {
    /// Device: flex (CPU), or ndarray, wgpu[:N], cuda[:N] in a build with that feature
    #[arg(short, long, value_name = "DEVICE", default_value = "flex")]
    pub(super) device: String,

    #[command(flatten)]
    flags: ComputeFlags,
}

impl ComputeArguments {
    /// The device of this rank, without autodiff. Sets implementation and instruction set for the
    /// process.
    pub(super) fn place(&self, ranks: &Ranks) -> anyhow::Result<SessionPlace> {
        let name = device_of_rank(&self.device, ranks.on_node());
        let device = || -> anyhow::Result<Device> {
            self.flags.apply()?;
            Ok(device::parse(&name)?)
        };
        Ok(SessionPlace {
            device: ranks.agree(device())?,
            device_name: name,
            ranks: ranks.clone(),
        })
    }
}

/// The device of a rank: if several ranks of a node share the name of a GPU backend, each gets the
/// GPU of its number.
fn device_of_rank(name: &str, on_node: OnNode) -> String {
    match name {
        "wgpu" | "cuda" if on_node.count > 1 => format!("{name}:{}", on_node.rank),
        name => name.to_owned(),
    }
}

/// Reports that a signal stopped the run after this step, and how to resume. Returns the exit code.
pub(super) fn stopped(signal: i32, step: u64, how: &str) -> u8 {
    say(format!(
        "\n{}: stopped after step {step}, everything is saved; {how}",
        signals::name(signal)
    ));
    u8::try_from(signals::exit_code(signal)).unwrap_or(1)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn each_rank_of_a_node_has_its_own_gpu() {
        let second = OnNode { rank: 1, count: 4 };
        assert_eq!(device_of_rank("wgpu", second), "wgpu:1");
        assert_eq!(device_of_rank("cuda:3", second), "cuda:3");
        assert_eq!(device_of_rank("flex", second), "flex");
        let alone = OnNode { rank: 0, count: 1 };
        assert_eq!(device_of_rank("wgpu", alone), "wgpu");
    }
}
