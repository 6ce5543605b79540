//! `demc-infer import`: turns weights from PyTorch or Open Image Denoise into a file for this program.

use std::path::{Path, PathBuf};

use burn::tensor::Device;
use clap::Args;
use demc_program::cli::OverwriteFlag;
use demc_program::message::{self, printable};
use demc_program::output::Outputs;

use super::outputs::check_output;
use crate::bundle::locate;
use crate::tza::{DEFAULT_WEIGHTS, weight_sets};
use crate::{Bundle, BundleError, BundleFile, Names, Precision};

/// Import weights from PyTorch or Open Image Denoise.
///
/// With --oidn, they come from an installed Open Image Denoise 2: the file libOpenImageDenoise_core,
/// or a TZA file. The result denoises as Open Image Denoise does, and training can start from it.
///
/// Otherwise they were trained in PyTorch with the package of bindings/python/.
/// Only the tensors come from the file. Network, statistics, channel layout and step come from the
/// model that training started from (--like), or from the file's own header. The file must have
/// exactly the network's tensors, in f32 or f16. A file without the tensors of an albedo filter gets
/// the filter of --like. The result is read back and compared.
#[derive(Args)]
#[command(after_help = "Examples:
  demc-infer export --model runs/demc --names torch -o demc.safetensors
  # Train in PyTorch and save with safetensors.torch.save_file(model.state_dict(), \"tuned.safetensors\")
  demc-infer import tuned.safetensors --like runs/demc -o demc-tuned.safetensors
  demc-infer import --oidn libOpenImageDenoise_core.so.2.5.1 --list
  demc-infer import --oidn libOpenImageDenoise_core.so.2.5.1 -o unet.safetensors")]
pub struct Arguments {
    /// safetensors file with PyTorch's or Burn's names
    #[arg(value_name = "FILE", required_unless_present = "oidn")]
    file: Option<PathBuf>,
    /// The model that training started from: run directory, checkpoint directory or exported file
    #[arg(long, value_name = "MODEL", conflicts_with = "oidn")]
    like: Option<PathBuf>,
    /// Library of Open Image Denoise 2, or TZA file
    #[arg(long, value_name = "FILE", conflicts_with = "file")]
    oidn: Option<PathBuf>,
    /// Which weights of the library: a name or a number of --list [default: rt_hdr_alb_nrm]
    #[arg(long, value_name = "NAME", requires = "oidn")]
    weights: Option<String>,
    /// List the weights of the library, and write nothing
    #[arg(long, requires = "oidn", conflicts_with_all = ["weights", "output", "overwrite"])]
    list: bool,
    /// Output file
    #[arg(short, long, value_name = "FILE", required_unless_present = "list")]
    output: Option<PathBuf>,
    #[command(flatten)]
    overwrite: OverwriteFlag,
}

impl Arguments {
    pub fn run(self) -> anyhow::Result<()> {
        let weights = self.oidn.as_ref().or(self.file.as_ref());
        let weights = weights.expect("clap requires one");
        let Some(output) = &self.output else {
            return list(weights);
        };
        let mut outputs = Outputs::default();
        outputs.protect(weights, "the weights");
        for file in self.like.iter().flat_map(|like| locate::files(like)) {
            outputs.protect(&file, "the model");
        }
        check_output(outputs, output, self.overwrite.overwrite)?;
        let bundle = match &self.oidn {
            Some(oidn) => Bundle::import_oidn(oidn, self.weights.as_deref(), &Device::flex())?,
            None => self.trained(weights)?,
        };
        bundle.export(output, Names::Burn, Precision::F32)?;
        let tensors = bundle.tensors(Names::Burn).len();
        let output = printable(&output.display().to_string());
        message::status(format_args!(
            "{output}: {tensors} tensors, read back and compared"
        ));
        Ok(())
    }

    /// The weights of a file from PyTorch.
    fn trained(&self, weights: &Path) -> anyhow::Result<Bundle> {
        let like = match &self.like {
            Some(path) => Some(BundleFile::read(path)?),
            None => None,
        };
        let known = like.is_some();
        let file = match BundleFile::import(weights, like) {
            Err(error @ BundleError::Foreign { .. }) if !known => {
                anyhow::bail!(
                    "{error}; --like MODEL takes them from the model that training started from"
                )
            }
            file => file?,
        };
        Ok(file.into_bundle(&Device::flex())?)
    }
}

/// Prints the weights of a library of Open Image Denoise.
fn list(library: &Path) -> anyhow::Result<()> {
    let mut text = String::from(
        "| number | name                     | size  | guides        | parameters |\n",
    );
    text += "| -----: | ------------------------ | ----- | ------------- | ---------: |\n";
    for (number, set) in weight_sets(library)?.iter().enumerate() {
        let name = set.name.as_deref().unwrap_or("-");
        let (size, guides) = (set.size.spec().name, set.guides.name());
        let parameters = set.model().parameter_count();
        let note = match name {
            DEFAULT_WEIGHTS => " the default",
            _ if !set.is_hdr() => " not for HDR colour",
            _ => "",
        };
        text += &format!(
            "| {number:>6} | {name:<24} | {size:<5} | {guides:<13} | {parameters:>10} |{note}\n"
        );
    }
    Ok(message::result(text.trim_end())?)
}
