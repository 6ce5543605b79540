//! Arguments of all subcommands that compute, and their exit after a signal.

use crate::ranks::{NodeShare, Reduce};
use crate::record::progress::say;
use crate::run::place::SessionPlace;
use crate::run::signals::{self, Stopped};
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
    /// The device of this process, without autodiff. Sets implementation and instruction set for the
    /// process.
    pub(super) fn place(&self, reduce: &Reduce) -> anyhow::Result<SessionPlace> {
        let name = device_on_node(&self.device, reduce.on_node());
        let device = || -> anyhow::Result<Device> {
            self.flags.apply()?;
            Ok(device::parse(&name)?)
        };
        Ok(SessionPlace {
            device: reduce.agree(device())?,
            device_name: name,
            reduce: reduce.clone(),
        })
    }
}

/// If several processes of a node share the name of a GPU backend, each gets the GPU of its number.
fn device_on_node(name: &str, node: NodeShare) -> String {
    match name {
        "wgpu" | "cuda" if node.count > 1 => format!("{name}:{}", node.index),
        name => name.to_owned(),
    }
}

/// Reports that a signal stopped the run after this step, and how to resume. Returns the exit code.
pub(super) fn report_stop(stopped: Stopped, how: &str) -> u8 {
    let Stopped { signal, step } = stopped;
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
    fn each_process_of_a_node_has_its_own_gpu() {
        let second = NodeShare { index: 1, count: 4 };
        assert_eq!(device_on_node("wgpu", second), "wgpu:1");
        assert_eq!(device_on_node("cuda:3", second), "cuda:3");
        assert_eq!(device_on_node("flex", second), "flex");
        let alone = NodeShare { index: 0, count: 1 };
        assert_eq!(device_on_node("wgpu", alone), "wgpu");
    }
}
