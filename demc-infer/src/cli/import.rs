//! `demc-infer import`: weights trained elsewhere, back into a file that this program uses.

use std::path::PathBuf;

use burn::tensor::Device;
use clap::Args;
use demc_infer::{BundleError, BundleFile, Names, Precision};

use super::{not_an_input, print};

/// Import weights that were trained in PyTorch, with the package of python/.
///
/// Only the tensors are taken from the file; network, statistics, channel layout and step are those of the model that it
/// started from (--like), or of the file's own header where it has kept it. Every tensor of the network must be there, and no
/// other, in f32 or f16. The result is read back and compared before success is reported.
#[derive(Args)]
#[command(after_help = "Examples:
  demc-infer export --model runs/demc --names torch -o demc.safetensors
  (trained further, and saved with safetensors.torch.save_file(model.state_dict(), \"tuned.safetensors\"))
  demc-infer import tuned.safetensors --like runs/demc -o demc-tuned.safetensors")]
pub struct Import {
    /// safetensors file with the names of PyTorch, or of Burn
    #[arg(value_name = "FILE")]
    weights: PathBuf,
    /// The model that the weights started from: run directory, checkpoint directory or exported file
    #[arg(long, value_name = "MODEL")]
    like: Option<PathBuf>,
    /// The file to write; an existing one is replaced, but none of those that are read
    #[arg(short, long, value_name = "FILE")]
    output: PathBuf,
}

impl Import {
    /// Reads, checks, writes, reads back, reports.
    pub fn run(self) -> anyhow::Result<()> {
        let like = match &self.like {
            Some(path) => Some(BundleFile::read(path)?),
            None => None,
        };
        let mut inputs = vec![(self.weights.as_path(), "the weights")];
        if let Some(like) = &like {
            inputs.push((&like.path, "the model"));
        }
        not_an_input(&self.output, &inputs)?;
        let known = like.is_some();
        let file = match BundleFile::import(&self.weights, like.map(|like| like.meta)) {
            Err(error @ BundleError::Foreign { .. }) if !known => {
                anyhow::bail!(
                    "{error}; --like MODEL takes them from the model that it started from"
                )
            }
            file => file?,
        };
        let bundle = file.into_bundle(&Device::flex())?;
        bundle.export(&self.output, Names::Burn, Precision::F32)?;
        let tensors = bundle.model.weights().len();
        let output = self.output.display();
        print(&format!(
            "{output}: {tensors} tensors, read back and compared"
        ))
    }
}
