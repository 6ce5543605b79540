//! What a network costs before it is built: trainable values and floating-point operations.

use burn::tensor::Device;

use crate::config::{LEVELS, ModelConfig};
use crate::denoiser::Denoiser;
use crate::weights::{Builder, Weight};

/// Floating-point operations of a multiplication with its addition.
const MULTIPLY_ADD: f64 = 2.0;

impl ModelConfig {
    /// Name and shape of every weight, in the order of the fields, without a network of this width: each axis is a multiple of
    /// the width or fixed, so a straight line through those at widths 1 and 2.
    pub fn weight_shapes(&self) -> Vec<(String, Vec<usize>)> {
        let [narrow, wide] = [1, 2].map(|width| shapes(&ModelConfig { width, ..*self }));
        let line = |(a, b): (&usize, &usize)| a + (b - a) * (self.width - 1);
        let weights = narrow.into_iter().zip(wide);
        weights
            .map(|(a, b)| (a.name, a.shape.iter().zip(&b.shape).map(line).collect()))
            .collect()
    }

    /// Number of trainable values: what [`Denoiser::parameter_count`] counts, without a network of this width.
    pub fn parameter_count(&self) -> u64 {
        let count = |config: &ModelConfig| {
            let shapes = shapes(config).into_iter();
            let trainable = shapes.filter(|weight| weight.is_trainable());
            trainable.map(|weight| volume(&weight)).sum::<f64>()
        };
        self.at_any_width(count).round() as u64
    }

    /// Floating-point operations of a forward pass for each pixel of the image: those of convolutions and deconvolutions, a
    /// multiplication and an addition counting as two, by the plain sums (Winograd needs fewer).
    pub fn flops_per_pixel(&self) -> f64 {
        let count = |config: &ModelConfig| {
            let shapes = shapes(config).into_iter();
            let kernels = shapes.filter(|weight| weight.shape.len() == 4);
            kernels
                .map(|weight| MULTIPLY_ADD * volume(&weight) * share_of_pixels(&weight.name))
                .sum::<f64>()
        };
        self.at_any_width(count)
    }

    /// The width at which this network has nearest to `parameters` trainable values.
    pub fn width_for(&self, parameters: u64) -> usize {
        let widths = 1..=crate::config::MAX_WIDTH;
        let distance = |width: &usize| {
            let config = ModelConfig {
                width: *width,
                ..*self
            };
            config.parameter_count().abs_diff(parameters)
        };
        widths.min_by_key(distance).expect("there are widths")
    }

    /// What `count` finds at this width: all channels are multiples of the width or fixed, so every count is a quadratic
    /// polynomial of it, through what it finds at widths 1, 2 and 3.
    fn at_any_width(&self, count: impl Fn(&ModelConfig) -> f64) -> f64 {
        let [a, b, c] = [1, 2, 3].map(|width| count(&ModelConfig { width, ..*self }));
        let w = self.width as f64 - 1.0;
        a + (b - a) * w + (c - 2.0 * b + a) * w * (w - 1.0) / 2.0
    }
}

/// Names and shapes of all weights; no values.
fn shapes(config: &ModelConfig) -> Vec<Weight> {
    let mut shapes = Vec::new();
    let mut source = |name: &str, shape: &[usize], _| {
        shapes.push(Weight {
            name: name.into(),
            shape: shape.into(),
            data: Vec::new(),
        });
        Ok(vec![0.0; shape.iter().product()])
    };
    let device = Device::flex();
    let mut builder = Builder::new(&mut source, &device);
    Denoiser::build(&mut builder, config, [0.0; 3]).expect("zeros have the shape asked for");
    shapes
}

fn volume(weight: &Weight) -> f64 {
    weight.shape.iter().product::<usize>() as f64
}

/// Pixels that a kernel is applied to, as a share of the image's: each level has a quarter of those above it. Deconvolutions
/// are applied to what lies below their level.
fn share_of_pixels(name: &str) -> f64 {
    let mut parts = name.split('.');
    let number = |part: Option<&str>| part.and_then(|part| part.parse().ok()).unwrap_or(0);
    let level = match parts.next() {
        // encoders.E.levels.L
        Some("encoders") => number(parts.nth(2)),
        Some("latent") => LEVELS,
        // decoder.levels.K.deconv, K from the deepest up
        Some("decoder") if parts.next() == Some("levels") => {
            let level = LEVELS - 1 - number(parts.next());
            level + usize::from(parts.next() == Some("deconv"))
        }
        _ => 0,
    };
    0.25f64.powi(level as i32)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::config::{Reading, Variant};

    fn config(variant: Variant, reading: Reading, width: usize) -> ModelConfig {
        ModelConfig {
            variant,
            reading,
            width,
            ..ModelConfig::default()
        }
    }

    /// Counted from the paper's text and from the authors' model (network.md); see also `tests/network.rs`.
    #[test]
    fn parameters_are_those_of_the_paper() {
        for (variant, reading, width, expected) in [
            (Variant::Demc, Reading::Paper, 64, 42_857_926),
            (Variant::DemcNosn, Reading::Paper, 64, 42_780_291),
            (Variant::Semc, Reading::Paper, 77, 43_000_040),
            (Variant::Demc, Reading::Released, 64, 44_852_678),
        ] {
            assert_eq!(config(variant, reading, width).parameter_count(), expected);
        }
    }

    #[test]
    fn width_for_the_papers_parameters_is_the_papers() {
        let semc = config(Variant::Semc, Reading::Paper, 1);
        assert_eq!(semc.width_for(42_857_926), 77);
        let demc = config(Variant::Demc, Reading::Paper, 1);
        assert_eq!(demc.width_for(42_857_926), 64);
    }

    /// Color-only at width 1, layer by layer.
    #[test]
    fn operations_are_those_of_a_sum_by_hand() {
        let widths = [1.0, 2.0, 4.0, 8.0, 8.0];
        let share = |level: i32| 0.25f64.powi(level);
        let mut expected = 9.0 * 8.0 * 8.0 * share(5);
        let (mut from, mut below) = (3.0, 8.0);
        for (level, to) in widths.into_iter().enumerate() {
            expected += 9.0 * (from * to + 2.0 * to * to) * share(level as i32);
            from = to;
        }
        for (level, to) in widths.into_iter().enumerate().rev() {
            let level = level as i32;
            expected += 16.0 * below * to * share(level + 1) + 2.0 * to * to * share(level);
            below = to;
        }
        expected += 9.0 * 3.0;
        let found = config(Variant::ColorOnly, Reading::Paper, 1).flops_per_pixel();
        assert!((found - 2.0 * expected).abs() < 1e-9 * found, "{found}");
    }

    #[test]
    fn any_width_is_counted_as_if_it_was_built() {
        for variant in Variant::ALL {
            for reading in Reading::ALL {
                let wide = ModelConfig {
                    levels: [1, 3, 4, 2, 5],
                    ..config(variant, reading, 7)
                };
                let named = |w: Weight| (w.name, w.shape);
                let expected: Vec<_> = shapes(&wide).into_iter().map(named).collect();
                assert_eq!(wide.weight_shapes(), expected);
                let built: f64 = shapes(&wide)
                    .iter()
                    .filter(|weight| weight.is_trainable())
                    .map(volume)
                    .sum();
                assert_eq!(
                    wide.parameter_count(),
                    built as u64,
                    "{variant:?} {reading:?}"
                );
            }
        }
    }
}
