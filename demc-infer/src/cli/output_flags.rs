//! `--precision`, `--compression`, `--only-color`: how an output is written.

use std::path::Path;

use clap::{Args, ValueEnum};
use demc_data::image::exr::{Compression, ExrFile};
use demc_data::image::rewrite::{OutputChannels, Replaced, WriteOptions, rewrite_with_layers};

use super::record::Record;

/// `--precision`, `--compression`, `--only-color`.
#[derive(Args)]
pub struct OutputFlags {
    /// Type of the channels of colour and layers: half has 11 bits of precision and a maximum of 65504 [default:
    /// as the input]
    #[arg(long, value_enum)]
    precision: Option<OutputPrecision>,
    /// none, rle, zips, zip, piz, pxr24, b44, b44a, dwaa or dwab. The last five are lossy [default:
    /// as the input, or zip if that would change the copied channels]
    #[arg(long, value_name = "NAME")]
    compression: Option<Compression>,
    /// Write only colour, alpha and layers
    #[arg(long)]
    only_color: bool,
}

#[derive(Clone, Copy, ValueEnum)]
enum OutputPrecision {
    /// 16-bit floating point
    Half,
    /// 32-bit floating point
    Float,
}

impl OutputFlags {
    /// Adds these flags to a record.
    pub fn record(&self, record: &mut Record) {
        if let Some(precision) = self
            .precision
            .and_then(|precision| precision.to_possible_value())
        {
            record.add("--precision", precision.get_name());
        }
        if let Some(compression) = self.compression {
            record.add("--compression", compression);
        }
        if self.only_color {
            record.add("--only-color", "on");
        }
    }

    /// Writes `output`: `input` with the denoised channels. Returns notes about other differences
    /// from the input.
    pub fn write(
        &self,
        input: &mut ExrFile,
        output: &Path,
        replaced: &Replaced,
        record: &str,
    ) -> Result<Vec<String>, demc_data::Error> {
        let options = WriteOptions {
            channels: if self.only_color {
                OutputChannels::Color
            } else {
                OutputChannels::All
            },
            precision: self.precision.map(|precision| match precision {
                OutputPrecision::Half => demc_data::SamplePrecision::Half,
                OutputPrecision::Float => demc_data::SamplePrecision::Float,
            }),
            compression: self.compression,
            record: Some(record),
        };
        let written = rewrite_with_layers(input, replaced, output, &options)?;
        let mut notes: Vec<String> = written.changes.iter().map(ToString::to_string).collect();
        if written.clamped > 0 {
            let clamped = written.clamped;
            notes.push(format!(
                "{clamped} samples above 65504, the maximum of half, are written as 65504"
            ));
        }
        Ok(notes)
    }
}
