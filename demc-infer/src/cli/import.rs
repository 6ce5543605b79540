//! `demc-infer import`: turns weights from PyTorch into a file for this program.

use std::path::PathBuf;

use burn::tensor::Device;
use clap::Args;
use demc_program::cli::OverwriteFlag;
use demc_program::message::{self, printable};
use demc_program::output::Outputs;

use super::outputs::check_output;
use crate::bundle::locate;
use crate::{BundleError, BundleFile, Names, Precision};

/// Import weights that were trained in PyTorch with the package of bindings/python/.
///
/// Only the tensors come from the file. Network, statistics, channel layout and step come from the
/// model that training started from (--like), or from the file's own header. The file must have
/// exactly the network's tensors, in f32 or f16. A file without the tensors of an albedo filter gets
/// the filter of --like. The result is read back and compared.
#[derive(Args)]
#[command(after_help = "Examples:
  demc-infer export --model runs/demc --names torch -o demc.safetensors
  # Train in PyTorch and save with safetensors.torch.save_file(model.state_dict(), \"tuned.safetensors\")
  demc-infer import tuned.safetensors --like runs/demc -o demc-tuned.safetensors")]
pub struct Arguments {
    /// safetensors file with PyTorch's or Burn's names
    #[arg(value_name = "FILE")]
    weights: PathBuf,
    /// The model that training started from: run directory, checkpoint directory or exported file
    #[arg(long, value_name = "MODEL")]
    like: Option<PathBuf>,
    /// Output file
    #[arg(short, long, value_name = "FILE")]
    output: PathBuf,
    #[command(flatten)]
    overwrite: OverwriteFlag,
}

impl Arguments {
    pub fn run(self) -> anyhow::Result<()> {
        let mut outputs = Outputs::default();
        outputs.protect(&self.weights, "the weights");
        for file in self.like.iter().flat_map(|like| locate::files(like)) {
            outputs.protect(&file, "the model");
        }
        check_output(outputs, &self.output, self.overwrite.overwrite)?;
        let like = match &self.like {
            Some(path) => Some(BundleFile::read(path)?),
            None => None,
        };
        let known = like.is_some();
        let file = match BundleFile::import(&self.weights, like) {
            Err(error @ BundleError::Foreign { .. }) if !known => {
                anyhow::bail!(
                    "{error}; --like MODEL takes them from the model that training started from"
                )
            }
            file => file?,
        };
        let bundle = file.into_bundle(&Device::flex())?;
        bundle.export(&self.output, Names::Burn, Precision::F32)?;
        let tensors = bundle.tensors(Names::Burn).len();
        let output = printable(&self.output.display().to_string());
        message::status(format_args!(
            "{output}: {tensors} tensors, read back and compared"
        ));
        Ok(())
    }
}
