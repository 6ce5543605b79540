//! Cost of a network that is not built: trainable values and floating-point operations.

use crate::config::ModelConfig;
use crate::weights::{Role, Stage, WeightSpec};

/// Floating-point operations of a multiplication with its addition.
const MULTIPLY_ADD: f64 = 2.0;

/// Values in memory at the peak of a training step per output value of a kernel. Measured:
/// `demc-train/tests/suite/memory.rs`.
const MAPS_KEPT: f64 = 1.5;

/// Values in memory per weight: the weight, its gradient and two moments.
const WEIGHT_COPIES: u64 = 4;

impl ModelConfig {
    /// Number of trainable values.
    pub fn parameter_count(&self) -> u64 {
        let specs = self.weight_specs().into_iter();
        let trainable = specs.filter(|spec| spec.is_trainable());
        trainable.map(|spec| spec.len() as u64).sum()
    }

    /// Floating-point operations of a forward pass per pixel of the image.
    ///
    /// Convolutions and deconvolutions are counted as plain sums, a multiplication with its
    /// addition as two operations. (Winograd needs fewer.)
    pub fn flops_per_pixel(&self) -> f64 {
        let specs = self.weight_specs().into_iter();
        let kernels = specs.filter(|spec| spec.rows().is_some());
        kernels
            .map(|spec| MULTIPLY_ADD * spec.len() as f64 * share_of_pixels(self.level_of(&spec)))
            .sum()
    }

    /// Bytes that a training step of the kernels needs for this number of patches of `side` x `side`
    /// pixels. It counts maps, weights, gradients and moments, but not the patches' own planes. The
    /// estimate is right to about a third.
    pub fn step_bytes(&self, patches: usize, side: usize) -> u64 {
        let specs = self.weight_specs();
        let maps = specs.iter().filter_map(|spec| {
            let level = match spec.stage {
                // At the resolution of its output.
                Stage::Decoder { level } => level,
                _ => self.level_of(spec),
            };
            Some(spec.rows()? as f64 * 0.25f64.powi(level as i32))
        });
        let pixels = patches as f64 * (side * side) as f64;
        let values = MAPS_KEPT * maps.sum::<f64>() * pixels;
        let states = WEIGHT_COPIES * self.parameter_count();
        (values as u64 + states) * size_of::<f32>() as u64
    }

    /// The level of a kernel's input. A deconvolution is applied to the level below its own.
    fn level_of(&self, spec: &WeightSpec) -> usize {
        match spec.stage {
            Stage::Fusion => 0,
            Stage::Encoder { level, .. } | Stage::Head { level } => level,
            Stage::Latent => self.variant.spec().halvings,
            Stage::Decoder { level } => level + usize::from(spec.role == Role::Deconvolution),
        }
    }

    /// The width with the number of trainable values that is nearest to `parameters`.
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
}

/// The pixels of a level, as a share of the image's: each has a quarter of the level above.
fn share_of_pixels(level: usize) -> f64 {
    0.25f64.powi(level as i32)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::config::{LEVELS, Reading, Variant};
    use crate::kernel_head::KERNEL_LEVELS;
    use crate::unet::{Guides, UNET_LEVELS, UnetSize};
    use burn::tensor::Device;
    use rand::SeedableRng;
    use rand_chacha::ChaCha8Rng;

    fn config(variant: Variant, reading: Reading, width: usize) -> ModelConfig {
        ModelConfig {
            variant,
            reading,
            width,
            ..ModelConfig::default()
        }
    }

    /// Counted from the paper's text and from the authors' model (docs/network.md).
    #[test]
    fn parameters_are_those_of_the_paper() {
        for (variant, reading, width, expected) in [
            (Variant::Demc, Reading::Paper, 64, 42_856_390),
            (Variant::DemcNosn, Reading::Paper, 64, 42_778_755),
            (Variant::Semc, Reading::Paper, 77, 42_998_192),
            (Variant::Demc, Reading::Released, 64, 44_852_678),
        ] {
            assert_eq!(config(variant, reading, width).parameter_count(), expected);
        }
    }

    #[test]
    fn width_for_the_papers_parameters_is_the_papers() {
        let semc = config(Variant::Semc, Reading::Paper, 1);
        assert_eq!(semc.width_for(42_856_390), 77);
        let demc = config(Variant::Demc, Reading::Paper, 1);
        assert_eq!(demc.width_for(42_856_390), 64);
    }

    /// Color-only at width 1, layer by layer.
    #[test]
    fn operations_agree_with_a_sum_by_hand() {
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
        expected += 3.0;
        let found = config(Variant::ColorOnly, Reading::Paper, 1).flops_per_pixel();
        assert!((found - 2.0 * expected).abs() < 1e-9 * found, "{found}");
    }

    /// Those of the files that Open Image Denoise ships.
    #[test]
    fn unets_have_the_size_of_those_of_open_image_denoise() {
        for (size, guides, parameters, gigaflops) in [
            (UnetSize::Small, Guides::AlbedoNormal, 320_035, 124.0),
            (UnetSize::Base, Guides::AlbedoNormal, 919_811, 251.0),
            (UnetSize::Large, Guides::AlbedoNormal, 3_848_387, 624.0),
        ] {
            let unet = ModelConfig {
                variant: Variant::Unet,
                size,
                guides,
                ..ModelConfig::default()
            };
            assert_eq!(unet.parameter_count(), parameters);
            let found = 1e-3 * unet.flops_per_pixel();
            assert!((found - gigaflops).abs() < 1.0, "{size:?}: {found}");
        }
    }

    fn every_network(check: impl Fn(ModelConfig)) {
        for (size, guides) in UnetSize::ALL
            .into_iter()
            .zip(Guides::ALL.into_iter().cycle())
        {
            check(ModelConfig {
                variant: Variant::Unet,
                size,
                guides,
                ..ModelConfig::default()
            });
        }
        for variant in Variant::ALL {
            for reading in Reading::ALL {
                for width in [1, 3, 7] {
                    check(ModelConfig {
                        levels: [1, 3, 4, 2, 5],
                        ..config(variant, reading, width)
                    });
                }
            }
        }
    }

    #[test]
    fn specs_have_the_names_and_shapes_of_the_built_network() {
        every_network(|config| {
            let mut rng = ChaCha8Rng::seed_from_u64(1);
            let built = config.init(&mut rng, [0.0; 3], &Device::flex()).weights();
            let specs = config.weight_specs();
            assert_eq!(specs.len(), built.len(), "{config}");
            let mut trainable = 0;
            for (spec, weight) in specs.iter().zip(&built) {
                assert_eq!((&spec.name, &spec.shape), (&weight.name, &weight.shape));
                assert_eq!(spec.len(), weight.data.len(), "{}", spec.name);
                if spec.is_trainable() {
                    trainable += weight.data.len() as u64;
                }
            }
            assert_eq!(config.parameter_count(), trainable, "{config}");
        });
    }

    /// The stage that a weight's name spells.
    fn stage_of_name(name: &str) -> Stage {
        let parts: Vec<&str> = name.split('.').collect();
        let number = |part: &str| part.parse::<usize>().expect("an index");
        match parts[..] {
            ["fusion", ..] | ["side", "fusion", ..] => Stage::Fusion,
            ["side", "levels", level, ..] => Stage::Encoder {
                encoder: 1,
                level: number(level),
            },
            ["side", "fuses", index, ..] => Stage::Decoder {
                level: UNET_LEVELS - 1 - number(index),
            },
            ["encoders", encoder, "levels", level, ..] => Stage::Encoder {
                encoder: number(encoder),
                level: number(level),
            },
            ["latent" | "bottom", ..] => Stage::Latent,
            ["encoder", level, ..] => Stage::Encoder {
                encoder: 0,
                level: number(level),
            },
            ["decoder", index, "convs", ..] => Stage::Decoder {
                level: UNET_LEVELS - 1 - number(index),
            },
            ["head", _] => Stage::Head { level: 0 },
            ["decoder", "levels", index, ..] => Stage::Decoder {
                level: LEVELS - 1 - number(index),
            },
            ["diffuse" | "specular", "layers", "8", ..] => Stage::Head { level: 0 },
            ["diffuse", "layers", ..] => Stage::Encoder {
                encoder: 0,
                level: 0,
            },
            ["specular", "layers", ..] => Stage::Encoder {
                encoder: 1,
                level: 0,
            },
            ["decoder", "head", ..] => Stage::Head { level: 0 },
            ["decoder", "kernels", index, ..] => Stage::Head {
                level: KERNEL_LEVELS - 1 - number(index),
            },
            _ => panic!("{name}"),
        }
    }

    /// The role that a weight's name spells.
    fn role_of_name(name: &str) -> Role {
        match name.rsplit('.').next().expect("a name") {
            "weight" if name.contains("deconv") => Role::Deconvolution,
            "weight" => Role::Convolution,
            "bias" => Role::Bias,
            "gamma" => Role::NormScale,
            "beta" => Role::NormShift,
            "running_mean" => Role::RunningMean,
            "running_var" => Role::RunningVariance,
            _ => panic!("{name}"),
        }
    }

    #[test]
    fn specs_have_the_roles_and_stages_that_their_names_spell() {
        every_network(|config| {
            for spec in config.weight_specs() {
                assert_eq!(spec.stage, stage_of_name(&spec.name), "{}", spec.name);
                assert_eq!(spec.role, role_of_name(&spec.name), "{}", spec.name);
            }
        });
    }

    /// The roles and stages of a small network, by hand.
    #[test]
    fn specs_have_the_roles_and_stages_of_the_paper() {
        let specs = config(Variant::DemcNosn, Reading::Released, 1).weight_specs();
        let count = |role, stage| {
            let matches = specs
                .iter()
                .filter(|spec| (spec.role, spec.stage) == (role, stage));
            matches.count()
        };
        for (encoder, level, convolutions) in [(0, 0, 2), (0, 4, 3), (1, 1, 2), (1, 4, 3)] {
            let stage = Stage::Encoder { encoder, level };
            assert_eq!(count(Role::Convolution, stage), convolutions, "{stage:?}");
            assert_eq!(count(Role::Bias, stage), convolutions, "{stage:?}");
        }
        for level in 0..LEVELS {
            let stage = Stage::Decoder { level };
            assert_eq!(count(Role::Deconvolution, stage), 1);
            assert_eq!(count(Role::Convolution, stage), 1, "the skip fusion");
            assert_eq!(count(Role::RunningVariance, stage), 1);
        }
        assert_eq!(count(Role::NormScale, Stage::Latent), 1);
        assert_eq!(count(Role::Convolution, Stage::Head { level: 0 }), 1);
        assert!(specs.iter().all(|spec| spec.stage != Stage::Fusion));
        let deepest = specs
            .iter()
            .find(|spec| spec.name == "decoder.levels.0.deconv.weight")
            .expect("a decoder");
        assert_eq!(deepest.stage, Stage::Decoder { level: 4 });
        assert_eq!((deepest.rows(), deepest.fan_in()), (Some(8), 8 * 4));
        assert_eq!(deepest.layer(), "decoder.levels.0.deconv");
        let fusion = specs
            .iter()
            .find(|spec| spec.name == "decoder.levels.0.fuse.weight");
        let fusion = fusion.expect("a skip fusion");
        assert_eq!((fusion.rows(), fusion.fan_in()), (Some(8), 3 * 8));
        for spec in specs.iter().filter(|spec| spec.shape.len() == 1) {
            assert_eq!((spec.rows(), spec.fan_in()), (None, 1), "{}", spec.name);
        }
    }

    /// Counted by hand, layer by layer.
    #[test]
    fn the_widest_network_is_described_without_its_values() {
        let widest = config(Variant::Demc, Reading::Paper, crate::config::MAX_WIDTH);
        assert_eq!(widest.parameter_count(), 685_408_006);
    }
}
