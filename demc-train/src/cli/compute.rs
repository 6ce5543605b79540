//! Arguments of all subcommands that compute, and their exit after a signal.

use std::process::ExitCode;

use burn::tensor::Device;
use clap::Args;
use demc_infer::compute::ComputeFlags;
use demc_infer::device;
use demc_train::record::progress::say;
use demc_train::run::signals;

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
    /// The device, without autodiff. Sets implementation and instruction set for the process.
    pub(super) fn device(&self) -> anyhow::Result<Device> {
        self.flags.apply()?;
        Ok(device::parse(&self.device)?)
    }
}

/// Reports that a signal stopped the run after this step, and how to resume. Returns the exit code.
pub(super) fn stopped(signal: i32, step: u64, how: &str) -> ExitCode {
    say(format!(
        "\n{}: stopped after step {step}, everything is saved; {how}",
        signals::name(signal)
    ));
    ExitCode::from(u8::try_from(signals::exit_code(signal)).unwrap_or(1))
}
