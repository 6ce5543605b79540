//! `demc-infer export`: writes a model as one file for other programs.

use std::env;
use std::ffi::OsStr;
use std::path::{Path, PathBuf};

use burn::tensor::Device;
use clap::{Args, ValueEnum};
use demc_data::ChannelLayout;
use demc_program::cli::OverwriteFlag;
use demc_program::exit::UsageError;
use demc_program::message::{self, printable};
use demc_program::output::Outputs;

use super::flags::ModelFlag;
use super::layouts::LAYOUT;
use super::outputs::check_output;
use crate::bundle::locate;
use crate::verify::{KERNEL_TOLERANCE, Runtime, TOLERANCE, verify};
use crate::{Bundle, BundleFile, Names, Precision};

/// Variable with the interpreter for `--verify`.
const PYTHON_VARIABLE: &str = "DEMC_PYTHON";
/// Value of `--albedo-filter` that removes the filter.
const NO_FILTER: &str = "none";

/// Export a model as one file: safetensors, an ONNX graph, or weights for Open Image Denoise.
///
/// A safetensors file has the weights, configuration, statistics and channel layout. `demc-infer`
/// loads it like a run directory, with either set of names. An ONNX graph takes a renderer's HDR
/// colour and raw features as input and returns HDR colour. A TZA file has the weights of a U-Net
/// for Open Image Denoise.
///
/// The file is read back and compared.
#[derive(Args)]
#[command(after_help = "Examples:
  demc-infer export --model runs/demc -o demc.safetensors
  demc-infer export --model runs/demc --names torch --precision f16 -o demc-torch.safetensors
  demc-infer export --model runs/demc --verify -o demc.onnx
  demc-infer export --model runs/unet -o unet.tza
  demc-infer export --model runs/demc --albedo-filter runs/albedo -o demc-filtered.safetensors")]
pub struct Arguments {
    #[command(flatten)]
    model: ModelFlag,
    /// File format [default: onnx for FILE.onnx, tza for FILE.tza, otherwise safetensors]
    #[arg(long, value_enum)]
    format: Option<Format>,
    /// Names of the tensors in a safetensors file: Burn's, or those that PyTorch's load_state_dict
    /// expects
    #[arg(long, value_enum, default_value = "burn")]
    names: NamesFlag,
    /// Type of the stored weights [default: f16 for tza, otherwise f32]. Batch normalisation stays f32,
    /// and ONNX graphs always compute in f32. A TZA file has f16 only
    #[arg(long, value_enum)]
    precision: Option<PrecisionFlag>,
    /// Channel layout to store instead of that of the training data: demc-exr, mitsuba3, pbrt-v4,
    /// cycles, fbksd, luxcore, or a TOML file
    #[arg(long, value_name = "PRESET|FILE")]
    layout: Option<String>,
    /// Albedo filter to store instead of the model's own: a run directory, a checkpoint directory or an
    /// exported file. A model that has a filter itself gives that one. `none`: no filter
    #[arg(long, value_name = "MODEL|none")]
    albedo_filter: Option<PathBuf>,
    /// Output file
    #[arg(short, long, value_name = "FILE")]
    output: PathBuf,
    #[command(flatten)]
    overwrite: OverwriteFlag,
    /// Run the file on synthetic images in ONNX Runtime, PyTorch, or Open Image Denoise, and compare.
    /// Deviations above 1e-4, or 1e-3 of a value of a kernel head, fail
    #[arg(long)]
    verify: bool,
    /// Python interpreter for --verify [default: the variable DEMC_PYTHON, or python3]
    #[arg(long, value_name = "PYTHON", requires = "verify")]
    python: Option<PathBuf>,
}

#[derive(Clone, Copy, PartialEq, ValueEnum)]
enum Format {
    /// Weights for demc-infer, or for PyTorch with the package of bindings/python/
    Safetensors,
    /// A graph for ONNX Runtime, TensorRT, OpenVINO and others
    Onnx,
    /// Weights of variant unet for Open Image Denoise
    Tza,
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

impl Arguments {
    pub fn run(self) -> anyhow::Result<()> {
        let format = self.format()?;
        // Rounding to f16 cannot be undone, so an export must not replace its model.
        let mut outputs = Outputs::default();
        self.model.protect(&mut outputs);
        let filter_path = self
            .albedo_filter
            .as_deref()
            .filter(|path| *path != Path::new(NO_FILTER));
        for file in filter_path.iter().flat_map(|path| locate::files(path)) {
            outputs.protect(&file, "the albedo filter");
        }
        if let Some(layout) = &self.layout {
            outputs.protect(Path::new(layout), LAYOUT);
        }
        if let Some(python) = &self.python {
            outputs.protect(python, "the Python interpreter");
        }
        check_output(outputs, &self.output, self.overwrite.overwrite)?;
        let file = self.model.read()?;
        let filter = filter_path.map(BundleFile::read).transpose()?;
        let names = match self.names {
            NamesFlag::Burn => Names::Burn,
            NamesFlag::Torch => Names::Torch,
        };
        if format != Format::Safetensors && names == Names::Torch {
            return Err(UsageError("--names is for safetensors only".into()).into());
        }
        let precision = match (self.precision, format) {
            (Some(PrecisionFlag::F32), Format::Tza) => {
                let why = "Open Image Denoise takes only f16 in a TZA file; remove --precision";
                return Err(UsageError(why.into()).into());
            }
            (Some(PrecisionFlag::F16), _) | (None, Format::Tza) => Precision::F16,
            (Some(PrecisionFlag::F32) | None, _) => Precision::F32,
        };
        let mut bundle = file.into_bundle(&Device::flex())?;
        match filter {
            Some(filter) => bundle.set_albedo_filter(filter.into_bundle(&Device::flex())?)?,
            None if self.albedo_filter.is_some() => bundle.albedo_filter = None,
            None => {}
        }
        if let Some(name) = &self.layout {
            let layout = ChannelLayout::resolve(name);
            let layout = layout.map_err(|error| UsageError(error.to_string()))?;
            let inputs = bundle.meta.layout.inputs;
            bundle.meta.layout = ChannelLayout { inputs, ..layout };
        }
        let output = printable(&self.output.display().to_string());
        match format {
            Format::Safetensors => {
                bundle.export(&self.output, names, precision)?;
                let tensors = bundle.tensors(names).len();
                message::status(format_args!(
                    "{output}: {tensors} tensors, read back and compared"
                ));
            }
            Format::Onnx => {
                bundle.export_onnx(&self.output, precision)?;
                message::status(format_args!("{output}: ONNX graph, read back and compared"));
            }
            Format::Tza => {
                bundle.export_tza(&self.output)?;
                message::status(format_args!(
                    "{output}: weights for Open Image Denoise, read back and compared"
                ));
            }
        }
        if self.verify {
            self.verify(format, &bundle.rounded(precision)?)
        } else {
            Ok(())
        }
    }

    /// The format that the flag or the name of the file asks for.
    fn format(&self) -> Result<Format, UsageError> {
        let output = self.output.display();
        let extension = self.output.extension().and_then(OsStr::to_str);
        let named = match extension.map(str::to_ascii_lowercase).as_deref() {
            Some("onnx") => Some(Format::Onnx),
            Some("tza") => Some(Format::Tza),
            Some("safetensors") => Some(Format::Safetensors),
            _ => None,
        };
        match (self.format, named) {
            _ if self.output == Path::new("-") => {
                Err(UsageError("-o -: give the name of a file".into()))
            }
            (Some(format), Some(named)) if format != named => Err(UsageError(format!(
                "-o {output}: its name says another format than --format"
            ))),
            (format, named) => Ok(format.or(named).unwrap_or(Format::Safetensors)),
        }
    }

    /// Runs the file and prints its deviation from `expected`.
    fn verify(&self, format: Format, expected: &Bundle) -> anyhow::Result<()> {
        let python = match &self.python {
            Some(python) => python.clone(),
            None => env::var_os(PYTHON_VARIABLE).map_or_else(|| "python3".into(), PathBuf::from),
        };
        let runtime = match format {
            Format::Onnx => Runtime::OnnxRuntime,
            Format::Safetensors => Runtime::PyTorch,
            Format::Tza => Runtime::Oidn,
        };
        let found = verify(&self.output, runtime, &python, expected)?;
        message::result(&format!(
            "{}: largest deviation, relative to the batch's largest value and to sqrt(x^2 + 0.001) of each value x",
            found.runtime
        ))?;
        for deviation in &found.deviations {
            let [batch, height, width] = deviation.size;
            let (of_largest, of_value) = (deviation.of_largest, deviation.of_value);
            message::result(&format!(
                "{batch} x {height:>3} x {width:>3}  {of_largest:.1e}  {of_value:.1e}"
            ))?;
        }
        let passes = found.deviations.iter().all(|deviation| deviation.passes());
        let path: &Path = &self.output;
        anyhow::ensure!(
            passes,
            "{}: deviates by more than {TOLERANCE:e} ({KERNEL_TOLERANCE:e} of a value of a kernel head) \
             from this program's output",
            path.display()
        );
        Ok(())
    }
}
