//! `demc-infer export`: weights for other programs, in one file.

use std::fs;
use std::path::PathBuf;

use burn::tensor::Device;
use clap::{Args, ValueEnum};
use demc_infer::{Names, Precision};

use super::{Model, Usage, print};

/// Export a model as one file: weights, configuration, statistics and channel layout.
///
/// The file is read back and compared before success is reported. `demc-infer` loads it like a run directory, with
/// either style of names.
#[derive(Args)]
#[command(after_help = "Examples:
  demc-infer export --model runs/demc -o demc.safetensors
  demc-infer export --model runs/demc --names torch --precision f16 -o demc-torch.safetensors")]
pub struct Export {
    #[command(flatten)]
    model: Model,
    /// File format
    #[arg(long, value_enum, default_value = "safetensors")]
    format: Format,
    /// Names of the tensors: those of Burn or those that PyTorch's load_state_dict expects
    #[arg(long, value_enum, default_value = "burn")]
    names: NamesFlag,
    /// Type of the weights; batch normalisation stays f32
    #[arg(long, value_enum, default_value = "f32")]
    precision: PrecisionFlag,
    /// The file to write; an existing one is replaced, but never the model itself
    #[arg(short, long, value_name = "FILE")]
    output: PathBuf,
}

#[derive(Clone, Copy, ValueEnum)]
enum Format {
    Safetensors,
}

#[derive(Clone, Copy, ValueEnum)]
enum NamesFlag {
    Burn,
    Torch,
}

#[derive(Clone, Copy, ValueEnum)]
enum PrecisionFlag {
    F32,
    F16,
}

impl Export {
    /// Loads, writes, reads back, reports.
    pub fn run(self) -> anyhow::Result<()> {
        let file = self.model.read()?;
        // Rounding to f16 cannot be taken back: the model must outlive its export.
        let model = fs::canonicalize(&file.path).ok();
        if fs::canonicalize(&self.output).is_ok_and(|output| Some(output) == model) {
            let output = self.output.display();
            return Err(Usage(format!("output {output} would replace the model")).into());
        }
        let bundle = file.into_bundle(&Device::flex())?;
        let names = match self.names {
            NamesFlag::Burn => Names::Burn,
            NamesFlag::Torch => Names::Torch,
        };
        let precision = match self.precision {
            PrecisionFlag::F32 => Precision::F32,
            PrecisionFlag::F16 => Precision::F16,
        };
        match self.format {
            Format::Safetensors => bundle.export(&self.output, names, precision)?,
        }
        let tensors = bundle.model.weights().len();
        print(&format!(
            "{}: {tensors} tensors, read back and compared",
            self.output.display()
        ))
    }
}
