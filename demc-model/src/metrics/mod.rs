//! The metrics of an image against its reference, in one table. Each name has one meaning.
//!
//! "RelMSE" and "SSIM" have many variants in this field; numbers of different variants cannot be
//! compared. `relmse` is the paper's: it **sums** over the three channels and averages over pixels,
//! in linear HDR. [`METRICS`] also holds the variants that others report, for comparison with their
//! numbers.
//!
//! An image with NaN or infinite values has no metrics: [`Image::new`] counts and refuses them.

mod appearance;
mod color;
mod filter;
mod flip;
mod image;
mod perceptual;
mod relative;

pub use self::image::{DISPLAY_GAMMA, Image, ImageError};
pub(crate) use perceptual::gaussian;
pub use perceptual::{SSIM_WINDOW, psnr, ssim};
pub use relative::{
    LOSS_EPSILON, energy_bias, mrse_pbrt, rel_mse, rel_mse_afgsa, rel_mse_image, rel_mse_map,
    rel_mse_sbmc, rel_mse_trimmed, smape,
};

pub use flip::flip;

/// A row of the table of metrics.
#[derive(Debug, Clone, Copy)]
pub struct Metric {
    /// The name with the variant, as in every output.
    pub name: &'static str,
    /// The definition in words; c is the candidate, r the reference.
    pub definition: &'static str,
    /// The values that are better.
    pub better: Better,
    /// The value for a candidate (first) and a reference of one size; `None` if the metric is
    /// undefined.
    pub measure: fn(&Image, &Image) -> Option<f64>,
}

/// The values of a metric that are better.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Better {
    /// Smaller values.
    Lower,
    /// Larger values.
    Higher,
    /// Values nearer to zero, on either side.
    Zero,
}

impl Better {
    /// The word for tables: `lower`, `higher` or `zero`.
    pub fn word(self) -> &'static str {
        match self {
            Better::Lower => "lower",
            Better::Higher => "higher",
            Better::Zero => "zero",
        }
    }

    /// The phrase after "best": `where small`, `where large` or `near zero`.
    pub fn phrase(self) -> &'static str {
        match self {
            Better::Lower => "where small",
            Better::Higher => "where large",
            Better::Zero => "near zero",
        }
    }

    /// The value on a scale where two values can be compared: the distance from zero for
    /// [`Better::Zero`].
    pub fn comparable(self, value: f64) -> f64 {
        match self {
            Better::Zero => value.abs(),
            Better::Lower | Better::Higher => value,
        }
    }

    /// Whether the first of two [`comparable`](Self::comparable) values with this difference is
    /// better.
    pub fn prefers(self, difference: f64) -> bool {
        match self {
            Better::Higher => difference > 0.0,
            Better::Lower | Better::Zero => difference < 0.0,
        }
    }
}

/// All metrics, the two headline metrics first.
pub const METRICS: [Metric; 10] = [
    Metric {
        name: "relmse",
        definition: "sum over rgb of (c - r)^2 / (r^2 + 0.001), mean over pixels, linear HDR (the paper's Eq. 5)",
        better: Better::Lower,
        measure: |c, r| Some(rel_mse(c, r)),
    },
    Metric {
        name: "ssim",
        definition: "Wang et al. 2004 on clip(x, 0, 1)^(1/2.2): 11x11 Gaussian window, sigma 1.5, inner windows only, mean of the channels",
        better: Better::Higher,
        measure: ssim,
    },
    Metric {
        name: "relmse@afgsa",
        definition: "0.5 x mean over values of (c - r)^2 / (r^2 + 0.01) (AFGSA, ACFM)",
        better: Better::Lower,
        measure: |c, r| Some(rel_mse_afgsa(c, r)),
    },
    Metric {
        name: "relmse@sbmc",
        definition: "mean over values of (c - r)^2 / (r^2 + 0.0001), without a border of 21 pixels (SBMC)",
        better: Better::Lower,
        measure: rel_mse_sbmc,
    },
    Metric {
        name: "mrse@pbrt",
        definition: "mean over values of (c - r)^2 / (r + 0.01)^2 (pbrt-v4's imgtool diff)",
        better: Better::Lower,
        measure: |c, r| Some(mrse_pbrt(c, r)),
    },
    Metric {
        name: "relmse-trimmed",
        definition: "relmse without the worst 0.1 % of the pixels",
        better: Better::Lower,
        measure: |c, r| Some(rel_mse_trimmed(c, r)),
    },
    Metric {
        name: "smape",
        definition: "mean over values of |c - r| / (|c| + |r| + 0.01) (KPCN)",
        better: Better::Lower,
        measure: |c, r| Some(smape(c, r)),
    },
    Metric {
        name: "psnr",
        definition: "-10 log10 of the mean squared error on clip(x, 0, 1)^(1/2.2), in dB; none for equal images",
        better: Better::Higher,
        measure: psnr,
    },
    Metric {
        name: "flip",
        definition: "mean LDR-FLIP (Andersson et al. 2020) on clip(x, 0, 1)^(1/2.2), 67 pixels per degree",
        better: Better::Lower,
        measure: |c, r| Some(flip(c, r)),
    },
    Metric {
        name: "energy-bias",
        definition: "mean luminance of c divided by that of r, minus 1; none for a black reference",
        better: Better::Zero,
        measure: energy_bias,
    },
];

/// The metric called `name`.
pub fn find(name: &str) -> Option<&'static Metric> {
    METRICS.iter().find(|metric| metric.name == name)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn names_are_unique_and_can_be_looked_up() {
        for metric in &METRICS {
            let found = find(metric.name).expect("a row");
            assert_eq!(found.definition, metric.definition);
            assert_eq!(METRICS.iter().filter(|m| m.name == metric.name).count(), 1);
        }
        assert!(find("RelMSE").is_none());
    }

    /// Every metric is best for the reference itself and worse for a disturbed copy.
    #[test]
    fn a_disturbed_copy_is_worse_than_the_reference() {
        let (height, width) = (64, 72);
        let reference: Vec<f32> = (0..3 * height * width)
            .map(|i| 0.3 + 0.2 * ((i % 31) as f32 / 31.0))
            .collect();
        let disturbed: Vec<f32> = reference
            .iter()
            .enumerate()
            .map(|(i, x)| x * (1.05 + 0.1 * (i % 7) as f32))
            .collect();
        let image = |hdr| Image::new(hdr, height, width).expect("finite");
        let (r, c) = (image(&reference), image(&disturbed));
        for Metric {
            name,
            better,
            measure,
            ..
        } in METRICS
        {
            let worse = better.comparable(measure(&c, &r).expect("a value"));
            let same = measure(&r, &r);
            match name {
                "psnr" => assert_eq!(same, None, "infinite"),
                _ => {
                    let same = better.comparable(same.expect("a value"));
                    assert!(better.prefers(same - worse), "{name}: {same} {worse}");
                }
            }
        }
    }
}
