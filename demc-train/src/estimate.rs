//! How long a run will take, from a few patches that are trained on and thrown away.

use std::convert::Infallible;
use std::fmt;
use std::time::Instant;

use burn::tensor::Device;
use demc_data::{Batch, FEATURES, Patch};

use crate::config::Config;
use crate::data::Data;
use crate::initial::drawn;
use crate::optimizer::Optimizer;
use crate::trainer::Trainer;

/// A forward pass as a share of forward, backward and optimizer; ours, measured between 0.2 and 0.4.
const FORWARD_SHARE: f64 = 0.3;

/// Patches of the larger of two batches that are timed; ours: enough to fill the kernels.
const SEVERAL: usize = 4;

/// Seconds after which a step is not timed a second time: by then what comes once, such as compiling shaders, is little of it (ours).
const LONG: f64 = 30.0;

/// A step is timed so often, as the first ones find memory cold, or for so many seconds, so that a run starts soon (ours).
const SOME: u32 = 6;
const SHORT: f64 = 1.0;

/// A run's duration, roughly.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Estimate {
    /// One step, seconds.
    pub step: f64,
    /// One validation, seconds.
    pub validation: f64,
    /// The steps and validations that are left, seconds.
    pub left: f64,
}

impl Estimate {
    /// Trains a network like that of `config` on one patch and on up to four: what a patch takes and what a step does, whatever its
    /// patches, give the time of the steps after `first`.
    pub fn measure(config: &Config, data: &Data, first: u64, device: &Device) -> Self {
        let mut single = config.clone();
        single.train.grad_accumulation = 1;
        let model = drawn(&config.model, 0, data.normalizer.flat_color, device);
        let mut trainer = Trainer::new(
            &single,
            model,
            Optimizer::new(&single.train),
            None,
            device.clone(),
        );
        let mut once = |batch: &Batch| {
            let started = Instant::now();
            let Ok(_) = trainer.step(0.0, || Ok::<_, Infallible>(batch.clone()));
            started.elapsed().as_secs_f64()
        };
        let mut time = |patches: usize| {
            let batch = grey_batch(patches, config.data.patch_size);
            let (mut least, mut spent, mut times) = (f64::INFINITY, 0.0, 0);
            while times < 2 && spent < LONG || times < SOME && spent < SHORT {
                let time = once(&batch);
                (least, spent, times) = (least.min(time), spent + time, times + 1);
            }
            least
        };
        // No more than a batch of the run: there may be no memory for them.
        let several = SEVERAL.min(config.data.batch_size);
        let one = time(1);
        let patch_time = patch_time(one, several, if several > 1 { time(several) } else { one });
        let pixels: usize = data
            .validation
            .iter()
            .map(|scene| scene.width * scene.height)
            .sum();
        let patches = pixels as f64 / (config.data.patch_size * config.data.patch_size) as f64;
        let step = one + patch_time * (config.patches_per_step() - 1) as f64;
        let validation = patch_time * patches * FORWARD_SHARE;
        let steps = config.train.steps.saturating_sub(first) as f64;
        let left = steps * (step + validation / config.run.validate_every as f64);
        Estimate {
            step,
            validation,
            left,
        }
    }
}

/// What one more patch takes, from the times of a step with one and of one with several.
fn patch_time(one: f64, several: usize, time: f64) -> f64 {
    match several {
        0 | 1 => one,
        // Times have noise: a patch is neither free nor dearer than a step of its own.
        _ => ((time - one) / (several - 1) as f64).clamp(0.1 * one, one),
    }
}

fn grey_batch(size: usize, side: usize) -> Batch {
    let planes = |channels: usize| vec![0.5; size * channels * side * side];
    let patch = Patch {
        scene: 0,
        y: 0,
        x: 0,
    };
    Batch {
        size,
        color_gamma: planes(3),
        features_z: planes(FEATURES),
        modulation: None,
        reference_hdr: planes(3),
        patches: vec![patch; size],
    }
}

impl fmt::Display for Estimate {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(
            f,
            "about {} ({} a step)",
            human(self.left),
            human(self.step)
        )
    }
}

/// `3 days 4 h`, `2 h 5 min`, `3 min 20 s`, `4.2 s`, `250 ms`: two units at most.
fn human(duration: f64) -> String {
    let seconds = duration as u64;
    let (days, hours, minutes) = (seconds / 86_400, seconds / 3600 % 24, seconds / 60 % 60);
    match (days, hours, minutes) {
        (0, 0, 0) if duration < 1.0 => format!("{:.0} ms", 1000.0 * duration),
        (0, 0, 0) => format!("{duration:.1} s"),
        (0, 0, _) => format!("{minutes} min {} s", seconds % 60),
        (0, _, _) => format!("{hours} h {minutes} min"),
        _ => format!("{days} days {hours} h"),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_patch_takes_what_it_adds_to_a_step() {
        // A step of 100 ms and 50 ms a patch.
        assert!((patch_time(0.15, 4, 0.3) - 0.05).abs() < 1e-12);
        assert_eq!(patch_time(0.15, 1, 0.15), 0.15);
        assert_eq!(patch_time(0.2, 4, 0.1), 0.1 * 0.2);
        assert_eq!(patch_time(0.2, 2, 0.9), 0.2);
    }

    #[test]
    fn durations_have_two_units_at_most() {
        assert_eq!(human(0.25), "250 ms");
        assert_eq!(human(4.24), "4.2 s");
        assert_eq!(human(200.0), "3 min 20 s");
        assert_eq!(human(7500.0), "2 h 5 min");
        assert_eq!(human(273_700.0), "3 days 4 h");
    }
}
