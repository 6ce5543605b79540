//! The cost of tiles, and the share of reading and writing in denoising a file.
//!
//! ```sh
//! cargo bench -p demc-bench --bench denoise                        # width 32, the sample's classroom
//! cargo bench -p demc-bench --bench denoise -- 16 my-render.exr    # another width, another file
//! cargo bench -p demc-bench --bench denoise -- files               # only one part: tiles or files
//! ```
//!
//! Tiles: 1280x720 pixels in memory, repeated from the file, whole and in the tiles of two memory
//! limits, in turns. Files: read, denoised and written with all channels; each part is timed in
//! turns.

use std::cell::RefCell;
use std::path::{Path, PathBuf};

use demc_bench::case;
use demc_bench::stopwatch::{Spread, Turns, interleaved};
use demc_data::Frame;
use demc_data::image::exr::ExrFile;
use demc_data::image::frame::{decode_input, read_input};
use demc_data::image::rewrite::{WriteOptions, rewrite};
use demc_infer::denoise::{DenoiseOptions, unobserved};
use demc_infer::{Bundle, Ensemble, Tiling};

#[global_allocator]
static ALLOCATOR: demc_model::ops::Recycler = demc_model::ops::Recycler;

const ROUNDS: usize = 7;
const KEPT_BYTES: usize = 256 << 20;
const WIDTH: usize = 1280;
const HEIGHT: usize = 720;

fn main() -> anyhow::Result<()> {
    demc_model::ops::within_pool(run)
}

fn run() -> anyhow::Result<()> {
    let words: Vec<String> = std::env::args().skip(1).collect();
    let width = words
        .iter()
        .find_map(|word| word.parse().ok())
        .unwrap_or(32);
    let file = words.iter().find(|word| word.ends_with(".exr"));
    let sample =
        Path::new(env!("CARGO_MANIFEST_DIR")).join("../data/sample/test/col-classroom-1.exr");
    let file = file.map_or(sample, PathBuf::from);
    let bundle = case::network(width);
    let frame = read_input(&file, &bundle.meta.layout)?;
    let asked = |part: &str| words.iter().any(|word| word == part);
    if !asked("files") {
        tiles(&bundle, &repeated(&frame))?;
    }
    if !asked("tiles") {
        files(&bundle, &file)?;
    }
    Ok(())
}

/// Denoises the image whole, and with three quarters and half of the memory.
fn tiles(bundle: &Bundle, frame: &Frame) -> anyhow::Result<()> {
    let whole = bundle.pass_bytes(HEIGHT.next_multiple_of(32), WIDTH);
    let tiling = |memory: u64, halo: usize| Tiling {
        halo,
        side: None,
        memory: Some(memory),
    };
    let exact = Tiling::default().halo;
    let cuts = [
        tiling(whole, exact),
        tiling(whole * 3 / 4, exact),
        tiling(whole / 2, exact),
    ];
    let run = |tiling: &Tiling| {
        let options = DenoiseOptions {
            tiling: *tiling,
            ..DenoiseOptions::default()
        };
        let denoised = bundle.denoise_with(frame, &options, unobserved);
        std::hint::black_box(denoised.expect("it fits"));
    };
    let turns = interleaved(
        ROUNDS,
        [&mut || run(&cuts[0]), &mut || run(&cuts[1]), &mut || {
            run(&cuts[2])
        }],
    );
    println!(
        "| {WIDTH}x{HEIGHT} | tiles | memory of a pass, MiB | pixels | s | relative to whole |"
    );
    println!("|---|---:|---:|---:|---:|---:|");
    for (cut, times) in cuts.iter().zip(&turns) {
        let plan = bundle.tiles(HEIGHT, WIDTH, cut, Ensemble::One)?;
        let (tall, wide) = plan.largest();
        let ratio = times.ratio(&turns[0]);
        println!(
            "| {} | {} | {} | {:.2} | {:.2} | {:.2} ({:.2}-{:.2}) |",
            if plan.count() == 1 {
                "whole"
            } else {
                "tiles of less memory"
            },
            plan.count(),
            bundle.pass_bytes(tall, wide) >> 20,
            plan.computed_pixels() as f64 / plan.image_pixels() as f64,
            times.spread().median,
            ratio.median,
            ratio.min,
            ratio.max
        );
    }
    Ok(())
}

/// Times each part of `demc-infer denoise` for one file.
fn files(bundle: &Bundle, file: &Path) -> anyhow::Result<()> {
    let layout = &bundle.meta.layout;
    let frame = read_input(file, layout)?;
    let image = bundle.denoise(&frame)?;
    let directory = tempfile::tempdir()?;
    let output = directory.path().join("out.exr");
    // Writing uses the file that reading opened.
    let open = RefCell::new(None);
    let [read, denoise, write] = interleaved(
        ROUNDS,
        [
            &mut || {
                let mut input = ExrFile::open(file)
                    .expect("it was read before")
                    .keeping(&layout.color, KEPT_BYTES);
                let frame = decode_input(&mut input, layout).expect("it was read before");
                std::hint::black_box(frame);
                open.replace(Some(input));
            },
            &mut || {
                std::hint::black_box(bundle.denoise(&frame).expect("it was denoised before"));
            },
            &mut || {
                let options = WriteOptions::default();
                // Already open, unless this is the second call in one turn.
                let again = || ExrFile::open(file).expect("it was read before");
                let mut input = open.take().unwrap_or_else(again);
                let written = rewrite(&mut input, layout, &image, &output, &options);
                std::hint::black_box(written.expect("a temporary file"));
            },
        ],
    );
    let percent = |part: &Turns| {
        let Spread { min, median, max } = part.ratio(&denoise);
        format!(
            "{:.1} ({:.1}-{:.1})",
            100.0 * median,
            100.0 * min,
            100.0 * max
        )
    };
    let [read_s, denoise_s, write_s] = [&read, &denoise, &write].map(|part| part.spread().median);
    println!(
        "\n{}x{}, all {} channels: reading takes {} % of the network's time, writing {} %: together {:.1} % of all three.",
        frame.width,
        frame.height,
        ExrFile::open(file)?.channels().len(),
        percent(&read),
        percent(&write),
        100.0 * (read_s + write_s) / (read_s + denoise_s + write_s)
    );
    Ok(())
}

/// Repeats the image until it has the size of the bench.
fn repeated(frame: &Frame) -> Frame {
    let planes = |planes: &[f32]| -> Vec<f32> {
        planes
            .chunks_exact(frame.width * frame.height)
            .flat_map(|plane| {
                (0..WIDTH * HEIGHT).map(|i| {
                    let (y, x) = (i / WIDTH % frame.height, i % WIDTH % frame.width);
                    plane[y * frame.width + x]
                })
            })
            .collect()
    };
    Frame::new(
        "repeated",
        WIDTH,
        HEIGHT,
        planes(&frame.color),
        planes(&frame.features),
    )
}
