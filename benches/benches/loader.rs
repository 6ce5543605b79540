//! Patches per second that the loader delivers and that a training step consumes.
//!
//! ```sh
//! cargo bench -p demc-bench --bench loader            # a step at base width 16, the fastest one
//! cargo bench -p demc-bench --bench loader -- 32
//! ```
//!
//! Cold: every scene is decoded from its EXR for its first patch. Cached: scenes are in memory.
//! Both run one worker, the configuration's default. In training, worker and step share the cores,
//! so the loader must be much faster than the step.

use std::path::Path;
use std::sync::Arc;
use std::time::Instant;

use burn::tensor::Device;
use demc_bench::case;
use demc_bench::contender::Training;
use demc_bench::stopwatch::Spread;
use demc_data::{BatchLoader, ChannelLayout, DataConfig, Dataset, PatchSource, Statistics};
use demc_model::LossConfig;

#[global_allocator]
static ALLOCATOR: demc_model::ops::Recycler = demc_model::ops::Recycler;

const ROUNDS: usize = 5;
const BATCH: usize = 4;
const PATCH: usize = 128;

fn main() -> anyhow::Result<()> {
    let width: usize = std::env::args()
        .skip(1)
        .find_map(|word| word.parse().ok())
        .unwrap_or(16);
    let config = DataConfig {
        root: Path::new(env!("CARGO_MANIFEST_DIR")).join("../data/sample"),
        batch_size: BATCH,
        ..DataConfig::default()
    };
    let mut training = Training::new(
        case::network(width),
        case::input(BATCH, PATCH, PATCH),
        1e-3,
        &Device::flex(),
    );
    training.run();
    let mut rates = [const { Vec::new() }; 3];
    for _ in 0..ROUNDS {
        let source = Arc::new(open(&config)?);
        let batches = source.patches().len() / BATCH;
        rates[0].push(rate(&source, batches)?);
        rates[1].push(rate(&source, batches)?);
        let started = Instant::now();
        training.run();
        rates[2].push(BATCH as f64 / started.elapsed().as_secs_f64());
    }
    let source = open(&config)?;
    println!(
        "{} patches of {PATCH} x {PATCH} from {} scenes, {} worker, {} threads for the step\n",
        source.patches().len(),
        source.scenes().len(),
        source.workers(),
        std::thread::available_parallelism()?
    );
    println!("{:<34} {:>28}", "", "patches/s (range of rounds)");
    let names = [
        "loader, cold".to_string(),
        "loader, cached".to_string(),
        format!("consumed by a step at width {width}"),
    ];
    let spreads = rates.map(Spread::of);
    for (name, spread) in names.iter().zip(spreads) {
        println!(
            "{name:<34} {:>10.0} ({:.0}-{:.0})",
            spread.median, spread.min, spread.max
        );
    }
    println!(
        "\nThe loader delivers {:.1} times what the step consumes when cold, {:.1} times when cached.",
        spreads[0].median / spreads[2].median,
        spreads[1].median / spreads[2].median
    );
    Ok(())
}

/// The sample's training scenes, not yet decoded.
fn open(config: &DataConfig) -> anyhow::Result<PatchSource> {
    let layout = ChannelLayout::resolve(&config.layout)?;
    let dataset = Dataset::open(&config.root, &layout)?;
    let (scenes, _) = dataset.train_validation(config.validation, 1)?;
    let statistics = Statistics::measure(
        &scenes,
        &layout,
        config,
        LossConfig::default().relmse_epsilon,
    )?;
    Ok(PatchSource::new(
        config,
        scenes,
        layout,
        statistics.normalizer,
        1,
    )?)
}

/// Patches a second over `batches` batches from a fresh loader.
fn rate(source: &Arc<PatchSource>, batches: usize) -> anyhow::Result<f64> {
    let started = Instant::now();
    let mut loader = BatchLoader::new(source.clone(), 0);
    for _ in 0..batches {
        std::hint::black_box(loader.next()?);
    }
    Ok((batches * BATCH) as f64 / started.elapsed().as_secs_f64())
}
