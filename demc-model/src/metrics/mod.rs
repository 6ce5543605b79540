//! How near an image is to its reference: one table of metrics, each under a name that has one meaning.
//!
//! "RelMSE" and "SSIM" mean many things in this field, and a number without its variant cannot be compared. `relmse`
//! here is the paper's: it **sums** over the three channels and averages over pixels, in linear HDR. [`METRICS`] holds
//! what others report, so that a number can be put beside theirs.
//!
//! Nothing is measured on an image with NaN or infinite values: [`Image::new`] counts and refuses them.

mod color;
mod filter;
mod flip;
mod image;
mod perceptual;
mod relative;

pub use self::image::{Image, ImageError};
pub(crate) use perceptual::gaussian;
pub use perceptual::{SSIM_WINDOW, psnr, ssim};
pub use relative::{
    energy_bias, mrse_pbrt, rel_mse, rel_mse_afgsa, rel_mse_image, rel_mse_map, rel_mse_sbmc,
    rel_mse_trimmed, smape,
};

pub use flip::flip;

/// Epsilon of Eq. 5.
pub const LOSS_EPSILON: f32 = 0.001;

/// Gamma of the tone mapping that SSIM and pictures use; the paper's Eq. 4.
pub const DISPLAY_GAMMA: f32 = 2.2;

/// A metric.
#[derive(Debug, Clone, Copy)]
pub struct Metric {
    /// Its name, with the variant: what every output calls it.
    pub name: &'static str,
    /// What it is, in words; c is the candidate, r the reference.
    pub definition: &'static str,
    /// Which values are good.
    pub better: Better,
    /// Its value for a candidate (first) and a reference of one size; `None` where it has none.
    pub of: fn(&Image, &Image) -> Option<f64>,
}

/// Which values of a metric are good.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Better {
    /// Small ones.
    Lower,
    /// Large ones.
    Higher,
    /// Those near zero, on either side.
    Zero,
}

impl Better {
    /// The word in a table: `lower`, `higher` or `zero`.
    pub fn word(self) -> &'static str {
        match self {
            Better::Lower => "lower",
            Better::Higher => "higher",
            Better::Zero => "zero",
        }
    }

    /// Where the best values are, after "best": `where small`, `where large`, `near zero`.
    pub fn phrase(self) -> &'static str {
        match self {
            Better::Lower => "where small",
            Better::Higher => "where large",
            Better::Zero => "near zero",
        }
    }

    /// A value on a scale where two can be compared: its distance from zero where that is what counts.
    pub fn comparable(self, value: f64) -> f64 {
        match self {
            Better::Zero => value.abs(),
            Better::Lower | Better::Higher => value,
        }
    }

    /// Whether a difference of two [`comparable`](Self::comparable) values speaks for the first.
    pub fn prefers(self, difference: f64) -> bool {
        match self {
            Better::Higher => difference > 0.0,
            Better::Lower | Better::Zero => difference < 0.0,
        }
    }
}

/// All metrics, the two headlines first.
pub const METRICS: [Metric; 10] = [
    Metric {
        name: "relmse",
        definition: "sum over rgb of (c - r)^2 / (r^2 + 0.001), mean over pixels, linear HDR (the paper's Eq. 5)",
        better: Better::Lower,
        of: |c, r| Some(rel_mse(c, r)),
    },
    Metric {
        name: "ssim",
        definition: "Wang et al. 2004 on clip(x, 0, 1)^(1/2.2): 11x11 Gaussian window, sigma 1.5, inner windows only, mean of the channels",
        better: Better::Higher,
        of: ssim,
    },
    Metric {
        name: "relmse@afgsa",
        definition: "0.5 x mean over values of (c - r)^2 / (r^2 + 0.01) (AFGSA, ACFM)",
        better: Better::Lower,
        of: |c, r| Some(rel_mse_afgsa(c, r)),
    },
    Metric {
        name: "relmse@sbmc",
        definition: "mean over values of (c - r)^2 / (r^2 + 0.0001), without a border of 21 pixels (SBMC)",
        better: Better::Lower,
        of: rel_mse_sbmc,
    },
    Metric {
        name: "mrse@pbrt",
        definition: "mean over values of (c - r)^2 / (r + 0.01)^2 (pbrt-v4's imgtool diff)",
        better: Better::Lower,
        of: |c, r| Some(mrse_pbrt(c, r)),
    },
    Metric {
        name: "relmse-trimmed",
        definition: "relmse without the 0.1 % of the pixels that are worst",
        better: Better::Lower,
        of: |c, r| Some(rel_mse_trimmed(c, r)),
    },
    Metric {
        name: "smape",
        definition: "mean over values of |c - r| / (|c| + |r| + 0.01) (KPCN)",
        better: Better::Lower,
        of: |c, r| Some(smape(c, r)),
    },
    Metric {
        name: "psnr",
        definition: "-10 log10 of the mean squared error on clip(x, 0, 1)^(1/2.2), in dB; none for equal images",
        better: Better::Higher,
        of: psnr,
    },
    Metric {
        name: "flip",
        definition: "mean LDR-FLIP (Andersson et al. 2020) on clip(x, 0, 1)^(1/2.2), 67 pixels a degree",
        better: Better::Lower,
        of: |c, r| Some(flip(c, r)),
    },
    Metric {
        name: "energy-bias",
        definition: "mean luminance of c by that of r, minus 1; none for a black reference",
        better: Better::Zero,
        of: energy_bias,
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
    fn names_are_unique_and_found() {
        for metric in &METRICS {
            let found = find(metric.name).expect("a row");
            assert_eq!(found.definition, metric.definition);
            assert_eq!(METRICS.iter().filter(|m| m.name == metric.name).count(), 1);
        }
        assert!(find("RelMSE").is_none());
    }

    /// Every metric has its best value for the reference itself, and a worse one for a disturbed copy.
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
            name, better, of, ..
        } in METRICS
        {
            let worse = better.comparable(of(&c, &r).expect("a value"));
            let same = of(&r, &r);
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
