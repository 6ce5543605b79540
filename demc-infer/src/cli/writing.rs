//! The flags that say how a denoised image is written.

use clap::{Args, ValueEnum};
use demc_data::ChannelLayout;
use demc_data::exr::rewrite::{Keep, WriteOptions, rewrite};
use demc_data::exr::{Compression, ExrFile};

use super::jobs::Job;

/// `--precision`, `--compression`, `--only-color`.
#[derive(Args)]
pub struct Writing {
    /// Type of the colour channels: half has 11 bits of precision, up to 65504 [default: that of the input]
    #[arg(long, value_enum)]
    precision: Option<Precision>,
    /// none, rle, zips, zip, piz, pxr24, b44, b44a, dwaa or dwab; the last five lose precision [default: that of the input, zip where it would change the
    /// channels that are carried over]
    #[arg(long, value_name = "NAME")]
    compression: Option<Compression>,
    /// Write colour and alpha, and leave out all other channels
    #[arg(long)]
    only_color: bool,
}

#[derive(Clone, Copy, ValueEnum)]
enum Precision {
    /// 16-bit floating point
    Half,
    /// 32-bit floating point
    Float,
}

impl Writing {
    /// Writes the job's output, `input` with another colour; returns what is not as in its input, in words.
    pub fn write(
        &self,
        input: &mut ExrFile,
        job: &Job,
        layout: &ChannelLayout,
        color_hdr: &[f32],
    ) -> Result<Vec<String>, demc_data::Error> {
        let options = WriteOptions {
            channels: match self.only_color {
                true => Keep::Color,
                false => Keep::All,
            },
            precision: self.precision.map(|precision| match precision {
                Precision::Half => demc_data::Precision::Half,
                Precision::Float => demc_data::Precision::Float,
            }),
            compression: self.compression,
        };
        let written = rewrite(input, layout, color_hdr, &job.output, &options)?;
        let mut notes: Vec<String> = written.changes.iter().map(ToString::to_string).collect();
        if written.clamped > 0 {
            let clamped = written.clamped;
            notes.push(format!(
                "{clamped} samples above 65504, half's largest value, written as that"
            ));
        }
        Ok(notes)
    }
}
