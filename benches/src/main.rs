//! This project's contender in `benches/peers/run.py`. It reads commands from stdin and answers
//! each with a line of JSON.
//!
//! | command | answer |
//! |---|---|
//! | (start) | `{"ready": description}` |
//! | `check FILE` | inference: `{"zeros": share}`, the output in FILE; training: `{"losses",
//! "grad_norms"}` of 3 steps |
//! | `step N` | `{"seconds": of one step, on average}` |
//! | `memory` | `{"peak_mib": peak of the resident set; null if unknown}` |

use std::io::{BufRead, Write};
use std::path::{Path, PathBuf};
use std::time::Instant;

use anyhow::{Context, bail};
use burn::tensor::Device;
use clap::{Args, Parser, Subcommand};
use demc_bench::case::{self, CaseInput};
use demc_bench::contender::{Inference, Training};
use demc_infer::{Bundle, device};
use demc_model::ops::{self, Isa, Ops};
use serde_json::{Value, json};

#[global_allocator]
static ALLOCATOR: demc_model::ops::Recycler = demc_model::ops::Recycler;

/// Steps of a check: the third loss depends on two updates of the weights.
const CHECK_STEPS: usize = 3;

#[derive(Parser)]
#[command(about = "This project's contender in benches/peers/run.py", version)]
struct Arguments {
    #[command(subcommand)]
    command: PeerCommand,
}

#[derive(Subcommand)]
enum PeerCommand {
    /// Write weights and inputs for all contenders
    Make {
        /// Base width C
        #[arg(long)]
        width: usize,
        /// Images: batch, height, width
        #[arg(long, num_args = 3, value_names = ["B", "H", "W"])]
        size: Vec<usize>,
        #[command(flatten)]
        files: CaseFiles,
    },
    /// Run training steps on command
    Train {
        #[command(flatten)]
        files: CaseFiles,
        #[command(flatten)]
        options: ComputeOptions,
        /// Learning rate
        #[arg(long)]
        lr: f64,
    },
    /// Denoise on command
    Infer {
        #[command(flatten)]
        files: CaseFiles,
        #[command(flatten)]
        options: ComputeOptions,
    },
}

#[derive(Args)]
struct CaseFiles {
    /// Bundle with the weights
    #[arg(long)]
    weights: PathBuf,
    /// File with color_gamma, features_z and reference_hdr
    #[arg(long)]
    inputs: PathBuf,
}

#[derive(Args)]
struct ComputeOptions {
    /// Device: flex, ndarray, `wgpu[:N]`, `cuda[:N]`
    #[arg(long, default_value = "flex")]
    device: String,
    /// Operations on flex: kernels (the project's own) or burn
    #[arg(long, default_value_t)]
    ops: Ops,
    /// Instructions of the kernels: avx512, avx2, neon, portable; default: the best of this machine
    #[arg(long)]
    isa: Option<Isa>,
}

impl ComputeOptions {
    /// Applies the options and returns the device.
    fn choose(&self) -> anyhow::Result<Device> {
        ops::set_default(self.ops);
        if let Some(isa) = self.isa {
            Isa::force(isa);
        }
        Ok(device::parse(&self.device)?)
    }
}

fn main() {
    if let Err(error) = ops::within_pool(|| run(Arguments::parse().command)) {
        eprintln!("error: {error:#}");
        std::process::exit(1);
    }
}

fn run(command: PeerCommand) -> anyhow::Result<()> {
    match command {
        PeerCommand::Make { width, size, files } => {
            let input = case::input(size[0], size[1], size[2]);
            case::write(&case::network(width), &files.weights, &input, &files.inputs)
        }
        PeerCommand::Train { files, options, lr } => {
            let device = options.choose()?;
            let (bundle, input) = files.read()?;
            let mut training = Training::new(bundle, input, lr, &device);
            serve(&options, &device, |request| match request {
                Request::Check(_) => {
                    let steps: Vec<_> = (0..CHECK_STEPS).map(|_| training.run()).collect();
                    let losses: Vec<f64> = steps.iter().map(|step| step.loss).collect();
                    let grad_norms: Vec<f64> = steps.iter().map(|step| step.grad_norm).collect();
                    Ok(json!({"losses": losses, "grad_norms": grad_norms}))
                }
                Request::Step => {
                    training.run();
                    Ok(Value::Null)
                }
            })
        }
        PeerCommand::Infer { files, options } => {
            let device = options.choose()?;
            let (bundle, input) = files.read()?;
            let size = [input.batch.size, input.height, input.width];
            let inference = Inference::new(bundle, input, &device);
            serve(&options, &device, |request| match request {
                Request::Check(path) => {
                    let out = inference.run();
                    let zeros = out.iter().filter(|x| **x == 0.0).count();
                    case::write_tensors(path, size, &[("output", &out)])?;
                    Ok(json!({"zeros": zeros as f64 / out.len() as f64}))
                }
                Request::Step => {
                    inference.run();
                    Ok(Value::Null)
                }
            })
        }
    }
}

impl CaseFiles {
    fn read(&self) -> anyhow::Result<(Bundle, CaseInput)> {
        // Every build has this device; the contender copies the network to another one.
        let bundle = Bundle::load(&self.weights, &Device::flex())?;
        Ok((bundle, case::read_input(&self.inputs)?))
    }
}

/// A request to the current mode.
enum Request<'a> {
    Check(&'a Path),
    Step,
}

/// Answers commands until stdin ends.
fn serve(
    options: &ComputeOptions,
    device: &Device,
    mut answer: impl FnMut(Request) -> anyhow::Result<Value>,
) -> anyhow::Result<()> {
    let say = |value: Value| -> anyhow::Result<()> {
        let mut stdout = std::io::stdout().lock();
        writeln!(stdout, "{value}")?;
        Ok(stdout.flush()?)
    };
    let version = env!("CARGO_PKG_VERSION");
    let about = format!(
        "demc {version} ({}: {})",
        options.device,
        options.ops.describe(device)
    );
    say(json!({"ready": about}))?;
    for line in std::io::stdin().lock().lines() {
        let line = line?;
        match line.split_once(' ').unwrap_or((&line, "")) {
            ("check", path) => say(answer(Request::Check(path.as_ref()))?)?,
            ("step", count) => {
                let count: u32 = count.parse().with_context(|| format!("`{line}`"))?;
                let started = Instant::now();
                for _ in 0..count {
                    answer(Request::Step)?;
                }
                say(json!({"seconds": started.elapsed().as_secs_f64() / f64::from(count)}))?;
            }
            ("memory", _) => say(json!({"peak_mib": peak_mib()}))?,
            _ => bail!("unknown command `{line}`"),
        }
    }
    Ok(())
}

fn peak_mib() -> Option<f64> {
    let status = std::fs::read_to_string("/proc/self/status").ok()?;
    let line = status
        .lines()
        .find_map(|line| line.strip_prefix("VmHWM:"))?;
    let kib: f64 = line.trim().strip_suffix("kB")?.trim().parse().ok()?;
    Some(kib / 1024.0)
}
