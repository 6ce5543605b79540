//! Mean and standard deviation of every feature channel, and the best flat image, over the training
//! scenes. Sums are taken scene by scene in double precision and merged in the scenes' order: the result is
//! the same whatever the number of threads.

use crate::dataset::size_mismatch;
use crate::frame::{FEATURES, FramePlanes, Presence, TEXTURES};
use crate::parallel;
use crate::plane::Plane;
use crate::ranges::{Ranges, Summary};
use crate::transform::STD_FLOOR;
use crate::{ChannelLayout, Error, FeatureStats, Normalizer, Scene};

/// Most scenes decoded at the same time: eight of 1280x720 are about 300 MB.
const MAX_THREADS: usize = 8;
/// Channels whose misses are left out: normal xyz and position xyz, which have no value where nothing was hit.
const GEOMETRY: usize = 6;

/// Epsilon of Eq. 5.
const RELMSE_EPSILON: f64 = 0.001;

/// What was measured on a set of scenes.
#[derive(Debug, Clone, PartialEq)]
pub struct Statistics {
    /// Gamma, feature statistics and flat colour: what the network's input and start need.
    pub normalizer: Normalizer,
    /// What the scenes were like, one by one.
    pub ranges: Ranges,
    /// Pixels of all scenes.
    pub pixels: u64,
    /// Pixels that no camera ray of theirs hit a surface from (`mask` = 0).
    pub misses: u64,
    /// Negative samples of colour and reference that were set to 0.
    pub clamped: u64,
}

impl Statistics {
    /// Measures `scenes`; `gamma` is the transfer exponent of Eq. 4, `demodulate` as in [`Normalizer`].
    ///
    /// # Errors
    /// The first scene's error that cannot be used, as in [`crate::read_frame`]; a reference that `layout`
    /// names must be there, and so must the mask.
    pub fn measure(
        scenes: &[Scene],
        layout: &ChannelLayout,
        gamma: f32,
        demodulate: f32,
    ) -> Result<Self, Error> {
        let threads = parallel::available().min(MAX_THREADS);
        Self::measure_on(threads, scenes, layout, gamma, demodulate)
    }

    /// As [`Self::measure`], on a given number of threads.
    ///
    /// # Errors
    /// As [`Self::measure`].
    pub fn measure_on(
        threads: usize,
        scenes: &[Scene],
        layout: &ChannelLayout,
        gamma: f32,
        demodulate: f32,
    ) -> Result<Self, Error> {
        let of_scene = |scene| Sums::of(scene, layout, demodulate);
        let mut total = Sums::default();
        let mut summaries = Vec::with_capacity(scenes.len());
        for sums in parallel::map(threads, scenes.iter().collect(), of_scene) {
            let sums = sums?;
            total.add(&sums);
            summaries.extend(sums.summary);
        }
        Ok(Self {
            normalizer: Normalizer {
                gamma,
                demodulate,
                features: FeatureStats {
                    mean: total.features.map(|moments| moments.mean as f32),
                    std: total
                        .features
                        .map(|moments| (moments.std() as f32).max(STD_FLOOR)),
                },
                flat_color: total
                    .color
                    .map(|channel| channel.best().powf(1.0 / f64::from(gamma)) as f32),
            },
            ranges: Ranges::of(&summaries),
            pixels: total.pixels,
            misses: total.misses,
            clamped: total.clamped,
        })
    }
}

/// One scene's share of the statistics.
#[derive(Default)]
struct Sums {
    features: [Moments; FEATURES],
    color: [FlatColor; 3],
    /// Of one scene; none in a total.
    summary: Option<Summary>,
    pixels: u64,
    misses: u64,
    clamped: u64,
}

impl Sums {
    fn of(scene: &Scene, layout: &ChannelLayout, demodulate: f32) -> Result<Self, Error> {
        let planes =
            FramePlanes::read(&scene.path, layout, Presence::Required, Presence::Required)?;
        if let Some(error) = size_mismatch(scene, planes.width, planes.height) {
            return Err(error);
        }
        let pixels = planes.width * planes.height;
        let mask = planes.mask.as_ref().map(Plane::to_f32);
        let misses = mask.iter().flatten().filter(|share| **share <= 0.0);
        let mut sums = Self {
            pixels: pixels as u64,
            misses: misses.count() as u64,
            clamped: planes.clamped as u64,
            ..Self::default()
        };
        for (channel, plane) in planes.features.iter().enumerate() {
            let samples = hit_samples(channel, plane.to_f32(), mask.as_deref());
            sums.features[channel] = Moments::of(&samples);
        }
        let color: Vec<f32> = planes.color.iter().flat_map(Plane::to_f32).collect();
        sums.summary = Some(Summary::new(&color, &sums.features));
        let textures = &planes.features[TEXTURES..];
        let references = planes.reference.iter().flatten();
        for ((color, plane), texture) in sums.color.iter_mut().zip(references).zip(textures) {
            let scale = match demodulate > 0.0 {
                true => texture
                    .to_f32()
                    .iter()
                    .map(|t| t.max(0.0) + demodulate)
                    .collect(),
                false => vec![1.0; pixels],
            };
            *color = FlatColor::of(&plane.to_f32(), &scale);
        }
        Ok(sums)
    }

    fn add(&mut self, other: &Self) {
        for (total, part) in self.features.iter_mut().zip(&other.features) {
            total.add(part);
        }
        for (total, part) in self.color.iter_mut().zip(&other.color) {
            total.weighted += part.weighted;
            total.weights += part.weights;
        }
        self.pixels += other.pixels;
        self.misses += other.misses;
        self.clamped += other.clamped;
    }
}

/// The samples of a feature channel that count: of normals and positions those where something was hit.
pub(crate) fn hit_samples(channel: usize, mut samples: Vec<f32>, mask: Option<&[f32]>) -> Vec<f32> {
    if let Some(mask) = mask.filter(|_| channel < GEOMETRY) {
        let mut mask = mask.iter();
        samples.retain(|_| mask.next().is_some_and(|share| *share > 0.0));
    }
    samples
}

/// Count, mean and sum of squared distances from the mean.
#[derive(Debug, Default, Clone, Copy)]
pub(crate) struct Moments {
    count: f64,
    pub(crate) mean: f64,
    squares: f64,
}

impl Moments {
    /// In two passes: positions far from the origin lose no digits.
    pub(crate) fn of(samples: &[f32]) -> Self {
        let count = samples.len() as f64;
        let mean = samples.iter().map(|&sample| f64::from(sample)).sum::<f64>() / count.max(1.0);
        let squares = samples
            .iter()
            .map(|&sample| (f64::from(sample) - mean).powi(2))
            .sum();
        Self {
            count,
            mean,
            squares,
        }
    }

    /// Chan, Golub and LeVeque's update for two sets.
    fn add(&mut self, other: &Self) {
        let count = self.count + other.count;
        if count > 0.0 {
            let delta = other.mean - self.mean;
            self.mean += delta * other.count / count;
            self.squares += other.squares + delta * delta * self.count * other.count / count;
            self.count = count;
        }
    }

    pub(crate) fn std(&self) -> f64 {
        (self.squares / self.count.max(1.0)).sqrt()
    }
}

/// The constant c that has, times m, the least RelMSE against the samples r of a channel: the derivative of
/// `sum (r - m c)^2 / (r^2 + epsilon)` (Eq. 5) is zero at the mean of r / m weighted by `m^2 / (r^2 + epsilon)`.
#[derive(Debug, Default, Clone, Copy)]
struct FlatColor {
    weighted: f64,
    weights: f64,
}

impl FlatColor {
    fn of(samples_hdr: &[f32], scale: &[f32]) -> Self {
        let mut sums = Self::default();
        for (&sample, &scale) in samples_hdr.iter().zip(scale) {
            let [sample, scale] = [sample, scale].map(f64::from);
            let weight = scale / (sample * sample + RELMSE_EPSILON);
            sums.weighted += weight * sample;
            sums.weights += weight * scale;
        }
        sums
    }

    fn best(self) -> f64 {
        self.weighted / self.weights.max(f64::MIN_POSITIVE)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn moments_of_parts_are_the_moments_of_the_whole() {
        // Around 1e4, as positions can be: a sum of squares in f32 would be left with nothing.
        let samples: Vec<f32> = (0..1000).map(|i| 1e4 + (i as f32 * 0.7).sin()).collect();
        let whole = Moments::of(&samples);
        let mut parts = Moments::default();
        for part in [
            &samples[..1],
            &samples[1..700],
            &samples[700..700],
            &samples[700..],
        ] {
            parts.add(&Moments::of(part));
        }
        assert_eq!(parts.count, whole.count);
        assert!((parts.mean - whole.mean).abs() < 1e-9);
        assert!((parts.std() - whole.std()).abs() < 1e-9);
        assert!(
            (whole.std() - 0.5f64.sqrt()).abs() < 1e-2,
            "the deviation of a sine: {}",
            whole.std()
        );
    }

    #[test]
    fn moments_match_a_hand_computed_case() {
        let moments = Moments::of(&[1.0, 2.0, 3.0, 6.0]);
        assert_eq!((moments.mean, moments.std()), (3.0, 3.5f64.sqrt()));
    }

    #[test]
    fn flat_color_has_the_least_relmse() {
        let samples: Vec<f32> = (0..500)
            .map(|i| (i as f32 * 0.7).sin().powi(4) * 2.0)
            .collect();
        let textures: Vec<f32> = (0..500).map(|i| 0.1 + (i % 7) as f32 / 7.0).collect();
        for scale in [vec![1.0; 500], textures] {
            let loss = |c: f64| -> f64 {
                let terms = samples.iter().zip(&scale).map(|(&r, &m)| {
                    let [r, m] = [r, m].map(f64::from);
                    (r - m * c).powi(2) / (r * r + RELMSE_EPSILON)
                });
                terms.sum()
            };
            let best = FlatColor::of(&samples, &scale).best();
            assert!(loss(best) < loss(best * 1.01) && loss(best) < loss(best * 0.99));
            assert!(loss(best) < loss(0.0), "better than black");
        }
    }
}
