//! `demc-infer cost`: computes the cost of denoising in advance.

use std::path::PathBuf;

use clap::Args;
use demc_data::image::exr::{ExrFile, check_size};
use demc_data::image::frame::{Presence, check_open_header};
use demc_model::{DOWNSAMPLING, ModelConfig};
use demc_program::message;
use serde::Serialize;

use super::flags::{DeviceFlag, ModelFlag, TilingFlags, describe};
use super::layouts::{LayoutFlags, say};
use crate::{Bundle, Ensemble, Tiling, memory};

/// Show the cost of denoising: parameters, operations, memory and tiles. Nothing is denoised.
#[derive(Args)]
#[command(after_help = "Examples:
  demc-infer cost --size 1280x720
  demc-infer cost --model runs/demc --size 7680x4320 --memory 6000
  demc-infer cost --json noisy.exr | jq .images[0].tiles")]
pub struct Arguments {
    #[command(flatten)]
    model: ModelFlag,
    #[command(flatten)]
    layout: LayoutFlags,
    /// Images; only their headers are read
    #[arg(value_name = "IN.exr", required_unless_present = "sizes")]
    inputs: Vec<PathBuf>,
    /// Image size in pixels, as large as a file may be. The flag can be repeated
    #[arg(long = "size", value_name = "WxH", value_parser = size)]
    sizes: Vec<(usize, usize)>,
    #[command(flatten)]
    tiling: TilingFlags,
    /// Print JSON
    #[arg(long)]
    json: bool,
    #[command(flatten)]
    device: DeviceFlag,
}

fn size(text: &str) -> Result<(usize, usize), String> {
    let sides = text
        .split_once(['x', 'X'])
        .and_then(|(w, h)| Some((w.parse().ok()?, h.parse().ok()?)));
    let (width, height) = sides.ok_or("not WIDTHxHEIGHT in pixels")?;
    check_size(width, height).map_err(|error| error.to_string())?;
    Ok((width, height))
}

#[derive(Serialize)]
struct CostReport {
    #[serde(flatten)]
    network: ModelConfig,
    /// With those of the albedo filter.
    parameters: u64,
    /// Size of the weights in memory.
    weight_bytes: u64,
    /// Memory available for a pass; `None` if unknown.
    available_bytes: Option<u64>,
    images: Vec<ImageCost>,
}

#[derive(Serialize)]
struct ImageCost {
    width: usize,
    height: usize,
    /// Floating-point operations with halos and padding, and with the albedo filter. Multiplication
    /// and addition count as one each.
    flops: f64,
    /// Operations without halos.
    flops_whole: f64,
    /// Memory of a pass over the largest tile, in addition to weights and images.
    pass_bytes: u64,
    /// Memory of colour, features and output as 32-bit floats.
    image_bytes: u64,
    tiles: usize,
    largest_tile: [usize; 2],
    #[serde(skip)]
    plan: String,
}

impl Arguments {
    pub fn run(self) -> anyhow::Result<()> {
        let layouts = self.layout.read()?;
        let bundle = self.model.load_onto(&self.device)?;
        let tiling = self.tiling.tiling();
        let read_size = |input: &PathBuf| -> anyhow::Result<(usize, usize)> {
            let file = ExrFile::open(input)?;
            let layout = layouts.of(&file, &bundle, say)?;
            let window = check_open_header(&file, &layout, Presence::Skip)?;
            Ok((window.width, window.height))
        };
        let given = self.sizes.iter().map(|size| Ok(*size));
        let sizes = given.chain(self.inputs.iter().map(read_size));
        let count = self.sizes.len() + self.inputs.len();
        let mut images = Vec::with_capacity(count);
        for size in sizes {
            let cost = size.and_then(|(width, height)| Ok(image(&bundle, &tiling, width, height)?));
            match cost {
                Ok(cost) => images.push(cost),
                Err(error) if count == 1 => return Err(error),
                Err(error) => message::say(format_args!("error: {error:#}")),
            }
        }
        let failed = count - images.len();
        let config = bundle.model.config();
        let parameters = bundle
            .networks()
            .map(|network| network.meta.model.parameter_count())
            .sum();
        let report = CostReport {
            network: *config,
            parameters,
            weight_bytes: parameters * size_of::<f32>() as u64,
            available_bytes: tiling.memory.or_else(|| bundle.memory_budget()),
            images,
        };
        let text = if self.json {
            message::json(&report)?
        } else {
            report.text()
        };
        message::result(&text)?;
        anyhow::ensure!(failed == 0, "{failed} of {count} images have no cost");
        Ok(())
    }
}

fn image(
    bundle: &Bundle,
    tiling: &Tiling,
    width: usize,
    height: usize,
) -> Result<ImageCost, memory::TooLarge> {
    let padded = height.next_multiple_of(DOWNSAMPLING) * width.next_multiple_of(DOWNSAMPLING);
    let tiles = bundle.tiles(height, width, tiling, Ensemble::One)?;
    let (tall, wide) = tiles.largest();
    let per_pixel = bundle.meta.model.flops_per_pixel();
    let mut flops = per_pixel * tiles.computed_pixels() as f64;
    let mut flops_whole = per_pixel * padded as f64;
    if let Some(filter) = &bundle.albedo_filter {
        let per_pixel = filter.meta.model.flops_per_pixel();
        let tiles = filter.tiles(height, width, &tiling.exact(), Ensemble::One)?;
        flops += per_pixel * tiles.computed_pixels() as f64;
        flops_whole += per_pixel * padded as f64;
    }
    Ok(ImageCost {
        width,
        height,
        flops,
        flops_whole,
        pass_bytes: bundle.pass_bytes(tall, wide),
        image_bytes: (width * height * (3 + 12 + 3) * size_of::<f32>()) as u64,
        tiles: tiles.count(),
        largest_tile: [wide, tall],
        plan: describe(&tiles, tiling),
    })
}

impl CostReport {
    fn text(&self) -> String {
        let mib = |bytes: u64| bytes.div_ceil(1 << 20);
        let mut lines = vec![
            format!("network     {}", self.network),
            format!(
                "parameters  {}, {} MiB",
                self.parameters,
                mib(self.weight_bytes)
            ),
            match self.available_bytes {
                Some(bytes) => format!("available   {} MiB", mib(bytes)),
                None => "available   unknown".into(),
            },
        ];
        for image in &self.images {
            let ImageCost { width, height, .. } = image;
            lines.push(format!(
                "\n{width}x{height}\n  operations  {:.1} GFLOP ({:.1} without halos)\n  memory      {} MiB for a pass, {} MiB for the image and its features\n  tiles       {}",
                image.flops / 1e9,
                image.flops_whole / 1e9,
                mib(image.pass_bytes),
                mib(image.image_bytes),
                image.plan
            ));
        }
        lines.join("\n")
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_size_is_two_numbers() {
        assert_eq!(size("1280x720"), Ok((1280, 720)));
        for wrong in ["1280", "0x5", "5x", "axb", "1x2x3", "32769x2", "32768x4097"] {
            assert!(size(wrong).is_err(), "{wrong}");
        }
    }
}
