//! `demc-infer denoise`: EXR in, EXR out, one file after another.

use std::fs;
use std::path::PathBuf;

use anyhow::Context;
use clap::Args;
use demc_data::exr::ExrFile;
use demc_data::frame::decode_input;
use demc_infer::denoise::SeamError;
use demc_infer::guard::EnergyBias;
use demc_infer::{Bundle, Picture, memory};

use super::inputs::{Frames, Inputs};
use super::jobs::{Job, Jobs};
use super::tiling::{TilingFlags, describe};
use super::writing::Writing;
use super::{Clamped, DeviceFlag, EnsembleFlag, Model};
use crate::progress::Progress;

/// Most bytes of an input's decoded blocks that are kept until its output is written (ours: 19 half channels of 1920x1080
/// three times; what is beyond is decompressed twice).
const MOST_KEPT: u64 = 256 << 20;

/// How many are kept with the memory that there is: the network needs most of it.
fn kept_bytes() -> usize {
    let room = memory::available().map_or(MOST_KEPT, |bytes| bytes / 16);
    room.min(MOST_KEPT) as usize
}

/// Denoise OpenEXR images of any size.
///
/// The channels are those of the layout that the model was trained with; `demc-infer inspect` shows it. The output is the input with
/// another colour: parts, windows, attributes, compression and all other channels stay. Negative radiance counts as 0. An image that does not fit into memory is denoised in tiles that equal it; `demc-infer cost` tells beforehand.
///
/// A file that fails is reported, the others are still denoised, and the exit code is 1 in the end. An image that is unlike what
/// the model was trained on gets a warning with the likely cause.
#[derive(Args)]
#[command(after_help = "Examples:
  demc-infer denoise noisy.exr -o clean.exr
  demc-infer denoise --model runs/quickstart noisy.exr -o clean.exr --png
  demc-infer denoise --model demc.safetensors renders/ -o denoised/
  demc-infer denoise 'shot.####.exr' --frames 1-240 -o denoised/")]
pub struct Denoise {
    #[command(flatten)]
    model: Model,
    /// Noisy images with their feature channels: files, directories (their *.exr), patterns, frame sequences (shot.####.exr
    /// or shot.%04d.exr)
    #[arg(value_name = "IN.exr", required = true)]
    inputs: Vec<PathBuf>,
    /// Output: a file for one input; a directory, made if needed, for several. In a directory, images that are there already
    /// are done and skipped
    #[arg(short, long, value_name = "OUT")]
    output: PathBuf,
    /// Replace outputs that exist; an input is never replaced
    #[arg(long)]
    overwrite: bool,
    /// Of sequences, only these frames
    #[arg(long, value_name = "FIRST-LAST")]
    frames: Option<Frames>,
    #[command(flatten)]
    writing: Writing,
    /// Also write a preview beside each output, NAME.png: clip(2^EXPOSURE x, 0, 1)^(1/2.2)
    #[arg(long)]
    png: bool,
    /// Exposure of previews, in stops
    #[arg(
        long,
        value_name = "STOPS",
        default_value_t = 0.0,
        requires = "png",
        allow_hyphen_values = true
    )]
    exposure: f32,
    #[command(flatten)]
    ensemble: EnsembleFlag,
    #[command(flatten)]
    tiling: TilingFlags,
    #[command(flatten)]
    device: DeviceFlag,
}

impl Denoise {
    /// Denoises all inputs.
    pub fn run(self) -> anyhow::Result<()> {
        let inputs = Inputs::expand(&self.inputs, self.frames)?;
        let mut jobs = Jobs::new(&inputs, &self.output)?;
        if !self.overwrite {
            jobs.skip_done(self.png)?;
        }
        if jobs.skipped > 0 {
            let (done, all) = (jobs.skipped, jobs.skipped + jobs.list.len());
            eprintln!("note: {done} of {all} images are there already; --overwrite replaces them");
        }
        let bundle = self.model.load_onto(&self.device)?;
        if jobs.directory {
            fs::create_dir_all(&self.output)
                .with_context(|| format!("cannot create {}", self.output.display()))?;
        }
        let jobs = jobs.list;
        let progress = Progress::new(jobs.len());
        let mut clamped = Clamped::default();
        let mut failed = 0;
        for job in &jobs {
            progress.start(job.input.display());
            match self.image(job, &bundle, &progress) {
                Ok(samples) => clamped.count(samples),
                Err(error) if jobs.len() == 1 => return Err(error),
                Err(error) => {
                    failed += 1;
                    progress.line(format_args!("error: {error:#}"));
                }
            }
            progress.advance();
        }
        progress.finish();
        clamped.report();
        anyhow::ensure!(
            failed == 0,
            "{failed} of {} images not denoised",
            jobs.len()
        );
        Ok(())
    }

    /// Returns the number of negative samples that were set to 0.
    fn image(&self, job: &Job, bundle: &Bundle, progress: &Progress) -> anyhow::Result<usize> {
        let name = job.input.display();
        let layout = &bundle.meta.layout;
        let mut file = ExrFile::open(&job.input)?.keeping(layout, kept_bytes());
        let frame = decode_input(&mut file, layout)?;
        for warning in bundle.warnings(&frame)? {
            progress.line(format_args!("warning: {name}: {warning}"));
        }
        let tiling = self.tiling.tiling();
        let denoised = bundle.denoise_tiled(&frame, &tiling, self.ensemble.looks, |done, of| {
            if of > 1 {
                progress.start(format_args!("{name}, tile {} of {of}", done + 1));
            }
        })?;
        if denoised.tiles.count() > 1 {
            let plan = describe(&denoised.tiles, &tiling);
            progress.line(format_args!("note: {name}: {plan}"));
        }
        if let Some(error) = denoised.seam_error {
            let SeamError {
                relmse,
                largest,
                windows,
            } = error;
            progress.line(format_args!(
                "note: {name}: against exact tiles, at {windows} places on seams: RelMSE {relmse:.2e}, largest difference {largest:.2e} of the largest value"
            ));
        }
        let image = &denoised.color_hdr;
        if let Some(warning) = EnergyBias::of(&frame, image).warning() {
            progress.line(format_args!("warning: {name}: {warning}"));
        }
        // The preview first: an image that is there is done.
        if self.png {
            let exposed: Vec<f32> = image.iter().map(|x| x * self.exposure.exp2()).collect();
            let path = job.preview();
            Picture::from_hdr(&exposed, frame.height, frame.width)
                .write_png(&path)
                .with_context(|| format!("cannot write {}", path.display()))?;
        }
        for note in self.writing.write(&mut file, job, layout, image)? {
            progress.line(format_args!("note: {name}: {note}"));
        }
        Ok(frame.clamped)
    }
}
