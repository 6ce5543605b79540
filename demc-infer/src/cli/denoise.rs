//! `demc-infer denoise`: denoises EXR files one after another.

mod records;
mod work;

use std::ops::ControlFlow;
use std::path::{Path, PathBuf};

use clap::Args;
use demc_data::image::exr::ExrFile;
use demc_data::image::rewrite::Replaced;
use demc_program::exit::UsageError;
use demc_program::message;
use demc_program::output::{Directories, Outputs};

use super::clamped::Clamped;
use super::exposure::{InputScaleFlag, SequenceScales, stops};
use super::filter::FilterFlag;
use super::flags::{DeviceFlag, EnsembleFlag, LightFlag, ModelFlag, TilingFlags, describe};
use super::frames::Frames;
use super::inputs::Inputs;
use super::jobs::{Job, Jobs};
use super::layers::LayersFlag;
use super::layouts::LayoutFlags;
use super::output_flags::OutputFlags;
use super::preview;
use super::progress::Progress;
use super::record::Record;
use super::shard::Shard;
use super::warnings::Warnings;
use crate::Bundle;
use crate::denoise::{DenoiseOptions, DenoiseProgress};
use crate::guard::{EnergyBias, Warning};
use work::{Contents, Method, Prepared, Work, cache_bytes, described, far_from_sequence};

/// Denoise OpenEXR images of up to 32768 pixels a side and 134217728 pixels.
///
/// Inputs are files, directories, glob patterns, or frame sequences. Failed inputs and missing
/// frames are reported and skipped, and the exit code is 1. Rerun the command to resume a partly
/// finished directory.
///
/// Channels have the names of the model's training data, or those that Mitsuba, pbrt, Blender
/// Cycles, LuxCore or FBKSD write. --layout chooses other names. An image that differs from the training
/// data causes a warning with the likely cause. Negative radiance counts as 0.
///
/// The output is the input with denoised colour and layers. Parts, windows, attributes, compression and all
/// other channels stay.
///
/// An image that does not fit into memory is denoised in tiles with the same result. `demc-infer
/// cost` shows the tiles in advance.
#[derive(Args)]
#[command(after_help = "Examples:
  demc-infer denoise noisy.exr -o clean.exr
  demc-infer denoise --model fast noisy.exr -o preview.exr
  demc-infer denoise --model runs/quickstart noisy.exr -o clean.exr --png
  demc-infer denoise --model demc.safetensors renders/ -o denoised/
  demc-infer denoise 'shot.####.exr' --frames 1-10,15,20-40x2 -o denoised/
  demc-infer denoise 'shot.####.exr' --shard 3/8 -o denoised/
  demc-infer denoise shot.exr --layers 'ViewLayer.Combined_*' -o clean.exr
  demc-infer denoise --filter nfor passes.exr -o clean.exr")]
pub struct Arguments {
    #[command(flatten)]
    model: ModelFlag,
    #[command(flatten)]
    filter: FilterFlag,
    #[command(flatten)]
    layout: LayoutFlags,
    #[command(flatten)]
    layers: LayersFlag,
    /// Noisy images with feature channels: files, directories (their *.exr), glob patterns, or
    /// frame sequences (shot.####.exr or shot.%04d.exr)
    #[arg(value_name = "IN.exr", required = true)]
    inputs: Vec<PathBuf>,
    /// Output file for one input, NAME.exr, or output directory. Directories are created if needed. Images that
    /// exist are skipped, unless their input was written again
    #[arg(short, long, value_name = "OUT")]
    output: PathBuf,
    /// Replace NaN, infinite and negative samples by the median of their neighbours. Without it, an
    /// image with NaN or infinite samples is refused, and negative radiance counts as 0
    #[arg(long)]
    repair: bool,
    /// Replace existing outputs and previews, also those of other options or of another program. Inputs are
    /// never replaced
    #[arg(long)]
    overwrite: bool,
    /// Only these frames of sequences, such as 7, 1-240, or 1-10,15,20-40x2 (every second one)
    #[arg(long, value_name = "LIST")]
    frames: Option<Frames>,
    /// Only part I of N of the images, from 1/N to N/N: sorted by file name, the Ith and every Nth
    /// after it
    #[arg(long, value_name = "I/N", allow_hyphen_values = true)]
    shard: Option<Shard>,
    /// Also write the detail map of the feature fusion (Fig. 2 e) as channels detail.R, detail.G, detail.B.
    /// Needs a model of variant demc or semc
    #[arg(long)]
    detail_map: bool,
    #[command(flatten)]
    output_flags: OutputFlags,
    /// Also write a preview NAME.png of each output beside it: clip(2^EXPOSURE x, 0, 1)^(1/2.2)
    #[arg(long)]
    png: bool,
    /// Exposure of previews in stops
    #[arg(
        long,
        value_name = "STOPS",
        default_value_t = 0.0,
        requires = "png",
        allow_hyphen_values = true,
        value_parser = stops
    )]
    exposure: f32,
    #[command(flatten)]
    input_scale: InputScaleFlag,
    #[command(flatten)]
    ensemble: EnsembleFlag,
    #[command(flatten)]
    light: LightFlag,
    #[command(flatten)]
    tiling: TilingFlags,
    #[command(flatten)]
    device: DeviceFlag,
}

/// The channels of the detail map.
const DETAIL: [&str; 3] = ["detail.R", "detail.G", "detail.B"];

impl Arguments {
    pub fn run(self) -> anyhow::Result<()> {
        let inputs = Inputs::expand(&self.inputs, self.frames.as_ref())?;
        // One worker of a farm reports them, not all.
        let incomplete = if self.shard.is_none_or(Shard::is_first) {
            inputs.report_missing()
        } else {
            0
        };
        let mut jobs = Jobs::new(&inputs, &self.output, self.png)?;
        if let Some(shard) = self.shard {
            jobs.keep(shard);
        }
        let mut outputs = Outputs::default();
        inputs.protect(&mut outputs);
        self.model.protect(&mut outputs);
        self.layout.protect(&mut outputs);
        jobs.claim(&mut outputs)?;
        let layouts = self.layout.read()?;
        let method = self.method()?;
        let record = self.record(&method, &layouts)?;
        let mut scales = SequenceScales::new(match method {
            Method::Network(_) => &inputs.sequences,
            // A filter has no factor.
            Method::Filter(_) => &[],
        });
        if !self.overwrite {
            let of_image = |input: &Path| self.image_record(&record, input, &scales).ok();
            jobs.skip_existing(of_image, self.exposure, &mut outputs);
        }
        let kept = jobs.report_skipped()?;
        outputs.prepare(Directories::Create)?;
        let jobs = jobs.list;
        let work = Work {
            method,
            layouts,
            record,
            progress: Progress::new(jobs.len()),
            warnings: Warnings::default(),
        };
        let progress = &work.progress;
        let mut clamped = Clamped::default();
        let mut failed = 0;
        for job in &jobs {
            progress.start(job.input.display());
            let exposure = match (&work.method, self.input_scale.choice.factor()) {
                (Method::Network(bundle), None) => {
                    scales.exposure(&job.input, bundle, &work.layouts)
                }
                _ => None,
            };
            let done = self
                .image_record(&work.record, &job.input, &scales)
                .and_then(|record| self.image(&work, job, &record, exposure));
            match done {
                Ok(samples) => clamped.count(samples),
                Err(error) if jobs.len() == 1 && kept == 0 => return Err(error),
                Err(error) => {
                    failed += 1;
                    progress.line(format_args!("error: {error:#}"));
                }
            }
            progress.advance();
        }
        work.progress.finish();
        for line in work.warnings.rest() {
            message::say(format_args!("warning: {line}"));
        }
        clamped.report();
        anyhow::ensure!(
            failed == 0,
            "{failed} of {} images were not denoised",
            jobs.len()
        );
        anyhow::ensure!(kept == 0, "{kept} existing file(s) were kept");
        anyhow::ensure!(incomplete == 0, "{incomplete} input(s) lack images");
        Ok(())
    }

    fn method(&self) -> anyhow::Result<Method> {
        if let Some(filter) = self.filter.filter {
            return Ok(Method::Filter(filter));
        }
        let bundle = self.model.load_onto(&self.device)?;
        self.layers.check(&bundle, self.ensemble.passes)?;
        let variant = bundle.meta.model.variant.spec();
        if self.detail_map && !variant.has_fusion() {
            let name = variant.name;
            let problem = format!("--detail-map: a model of variant {name} has no feature fusion");
            return Err(UsageError(problem).into());
        }
        Ok(Method::Network(Box::new(bundle)))
    }

    /// Denoises one image if its output is due, and writes its preview. Returns the number of negative
    /// samples, which were set to 0.
    fn image(
        &self,
        work: &Work,
        job: &Job,
        record: &Record,
        exposure: Option<f64>,
    ) -> anyhow::Result<usize> {
        let progress = &work.progress;
        let name = job.input.display();
        let file = ExrFile::open(&job.input)?;
        let say = |choice: &str| progress.line(format_args!("note: {name}: {choice}"));
        let layout = &work.layout(&file, say)?;
        let clamped = if job.is_due {
            let prepared = Prepared {
                file,
                layout,
                record,
                exposure,
            };
            match &work.method {
                Method::Network(bundle) => self.denoise(work, bundle, job, prepared)?,
                Method::Filter(filter) => {
                    let mut file = prepared.file.keeping(&layout.color, cache_bytes());
                    let planes = filter.denoise(&mut file, layout)?;
                    let replaced = Replaced {
                        layout,
                        layers: &[],
                        added: &[],
                        planes: &planes,
                    };
                    self.write(work, job, &mut file, &replaced, record)?;
                    0
                }
            }
        } else {
            0
        };
        let beside = job.output.with_extension("png");
        if job.is_due && !self.png && preview::is_own(&beside) {
            let beside = beside.display();
            progress.line(format_args!(
                "note: {beside} shows the replaced image; --png makes it again"
            ));
        }
        if let Some(path) = &job.preview {
            anyhow::ensure!(
                self.overwrite || !path.exists() || preview::is_own(path),
                "{} was written by another program meanwhile; --overwrite replaces it",
                path.display()
            );
            preview::write(path, &job.output, layout, self.exposure)?;
        }
        Ok(clamped)
    }

    /// Denoises one image. Returns the number of negative samples, which were set to 0.
    fn denoise(
        &self,
        work: &Work,
        bundle: &Bundle,
        job: &Job,
        prepared: Prepared,
    ) -> anyhow::Result<usize> {
        let (progress, warnings) = (&work.progress, &work.warnings);
        let Prepared {
            file,
            layout,
            record,
            exposure,
        } = prepared;
        let name = job.input.display();
        let names = self.layers.names(&file, layout)?;
        let mut file = file.keeping(&layout.color, cache_bytes());
        let Contents {
            frame,
            layers,
            repaired,
        } = Contents::read(&mut file, layout, &names, self.repair)?;
        if repaired > 0 {
            progress.line(format_args!("note: {name}: {repaired} samples repaired"));
        }
        let warn = |warning: &Warning| {
            if let Some(line) = warnings.first(&job.input, warning) {
                progress.line(format_args!("warning: {line}"));
            }
        };
        bundle.warnings(&frame)?.iter().for_each(warn);
        far_from_sequence(&frame, exposure).iter().for_each(warn);
        let tiling = self.tiling.tiling();
        let given = self.input_scale.choice.factor();
        let options = DenoiseOptions {
            tiling,
            ensemble: self.ensemble.passes,
            input_scale: given.or(exposure.map(|exposure| bundle.input_scale(exposure))),
            restore_light: self.light.restore_light,
            layers,
        };
        let mut shown = None;
        let on_progress = |done: DenoiseProgress| {
            let tile = done.tile + 1;
            if done.tiles > 1 && shown.replace(tile) != Some(tile) {
                progress.start(format_args!("{name}, tile {tile} of {}", done.tiles));
            }
            ControlFlow::Continue(())
        };
        let denoised = bundle.denoise_with(&frame, &options, on_progress)?;
        if denoised.tiles.count() > 1 {
            let plan = describe(&denoised.tiles, &tiling);
            progress.line(format_args!("note: {name}: {plan}"));
        }
        if let Some(error) = denoised.seam_error {
            let error = described(&error);
            progress.line(format_args!("note: {name}: {error}"));
        }
        let bias = EnergyBias::of(&frame, &denoised.color_hdr);
        bias.warning().iter().for_each(warn);
        let mut planes = denoised.color_hdr;
        // Alpha that is not denoised stays as it is in the file, unless it was repaired.
        let repaired_alpha = || frame.alpha.clone().filter(|_| repaired > 0);
        planes.extend(denoised.alpha.or_else(repaired_alpha).into_iter().flatten());
        planes.extend(denoised.layers);
        let detail = self.detail_map.then(|| bundle.detail_map(&frame));
        let detail = detail.transpose()?.flatten();
        let added = if detail.is_some() { &DETAIL[..] } else { &[] };
        planes.extend(detail.into_iter().flatten());
        let replaced = Replaced {
            layout,
            layers: &names,
            added,
            planes: &planes,
        };
        self.write(work, job, &mut file, &replaced, record)?;
        Ok(frame.clamped)
    }

    /// Writes an output, unless another program did so meanwhile.
    fn write(
        &self,
        work: &Work,
        job: &Job,
        file: &mut ExrFile,
        replaced: &Replaced,
        record: &Record,
    ) -> anyhow::Result<()> {
        if !job.replaces && job.output.exists() {
            let output = job.output.display();
            anyhow::bail!(
                "{output} was written by another program meanwhile; --overwrite replaces it"
            );
        }
        let flags = &self.output_flags;
        for note in flags.write(file, &job.output, replaced, &record.text())? {
            let name = job.input.display();
            work.progress.line(format_args!("note: {name}: {note}"));
        }
        Ok(())
    }
}
