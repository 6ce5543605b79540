//! Mean and standard deviation of every feature channel, and the best flat image, over the training
//! scenes. Sums are computed per scene in double precision and merged in the order of the scenes,
//! so the result does not depend on the number of threads.

use demc_program::parallel;

use crate::check::content::{ContentProblem, suspicious};
use crate::dataset::{Scene, size_mismatch};
use crate::error::Error;
use crate::image::frame::{FEATURES, FramePlanes, MAX_ALBEDO, Presence, TEXTURES};
use crate::image::layout::ChannelLayout;
use crate::image::plane::Plane;
use crate::input::moments::{ChannelMoments, counted_samples};
use crate::input::ranges::{FrameSummary, Ranges};
use crate::input::transform::{FeatureStats, Normalizer, STD_FLOOR};
use crate::training::config::DataConfig;

/// Maximum number of scenes decoded at the same time: eight of 1280x720 take about 300 MB.
const MAX_THREADS: usize = 8;

/// Statistics of a set of scenes.
#[derive(Debug, Clone, PartialEq)]
pub struct Statistics {
    /// Gamma, feature statistics and flat colour, for the network's input and initialisation.
    pub normalizer: Normalizer,
    /// Ranges of the scenes' summary values.
    pub ranges: Ranges,
    /// Pixels of all scenes.
    pub pixels: u64,
    /// Pixels whose camera rays all miss (`mask` = 0).
    pub misses: u64,
    /// Number of negative samples of colour and reference that were set to 0.
    pub clamped: u64,
    /// What [`suspicious`] finds in each scene, in their order.
    pub suspicious: Vec<(String, Vec<ContentProblem>)>,
}

impl Statistics {
    /// Measures `scenes` for the input conversion of `config`. `relmse_epsilon` is the epsilon of
    /// Eq. 5 that the flat colour is fitted with.
    ///
    /// # Errors
    /// The error of the first unusable scene, as in [`crate::image::frame::read_frame`]. Reference and mask must
    /// be present if `layout` names them.
    pub fn measure(
        scenes: &[Scene],
        layout: &ChannelLayout,
        config: &DataConfig,
        relmse_epsilon: f32,
    ) -> Result<Self, Error> {
        let threads = parallel::threads().count.min(MAX_THREADS);
        Self::measure_on(threads, scenes, layout, config, relmse_epsilon)
    }

    /// As [`Self::measure`], on a given number of threads.
    ///
    /// # Errors
    /// As [`Self::measure`].
    pub fn measure_on(
        threads: usize,
        scenes: &[Scene],
        layout: &ChannelLayout,
        config: &DataConfig,
        relmse_epsilon: f32,
    ) -> Result<Self, Error> {
        let DataConfig {
            gamma,
            transfer,
            albedo_demodulation_epsilon,
            position,
            exposure_level,
            restore_light,
            ..
        } = *config;
        let relmse_epsilon = decimal(relmse_epsilon);
        let scene_sums = |scene| SceneSums::of(scene, layout, config, relmse_epsilon);
        let mut total = SceneSums::default();
        let mut summaries = Vec::with_capacity(scenes.len());
        let mut found = Vec::new();
        let all = parallel::map(threads, scenes.iter().collect(), scene_sums);
        for (scene, sums) in scenes.iter().zip(all) {
            let mut sums = sums?;
            found.push((scene.name.clone(), std::mem::take(&mut sums.suspicious)));
            total.add(&sums);
            summaries.extend(sums.summary);
        }
        Ok(Self {
            normalizer: Normalizer {
                gamma,
                transfer,
                albedo_demodulation_epsilon,
                position,
                exposure_level,
                restore_light,
                features: FeatureStats {
                    mean: total.features.map(|moments| moments.mean as f32),
                    std: total
                        .features
                        .map(|moments| (moments.std() as f32).max(STD_FLOOR)),
                }
                .with_ranges_of(transfer),
                flat_color: total
                    .color
                    .map(|channel| transfer.compressed(channel.best(), gamma)),
            },
            ranges: Ranges::of(&summaries),
            pixels: total.pixels,
            misses: total.misses,
            clamped: total.clamped,
            suspicious: found,
        })
    }
}

#[derive(Default)]
struct SceneSums {
    features: [ChannelMoments; FEATURES],
    color: [FlatColor; 3],
    /// Of a single scene; `None` in a total.
    summary: Option<FrameSummary>,
    pixels: u64,
    misses: u64,
    clamped: u64,
    /// Of a single scene; empty in a total.
    suspicious: Vec<ContentProblem>,
}

impl SceneSums {
    fn of(
        scene: &Scene,
        layout: &ChannelLayout,
        config: &DataConfig,
        relmse_epsilon: f64,
    ) -> Result<Self, Error> {
        let layout = scene.layout(layout);
        let mut planes =
            FramePlanes::read(&scene.path, layout, Presence::Required, Presence::Required)?;
        if let Some(error) = size_mismatch(scene, planes.width, planes.height) {
            return Err(error);
        }
        let found = suspicious(&planes, layout);
        let scale = config.preparation().apply(&mut planes);
        let albedo_epsilon = config.albedo_demodulation_epsilon;
        let pixels = planes.width * planes.height;
        let mask = planes.mask.as_ref().map(Plane::to_f32);
        let misses = mask.iter().flatten().filter(|share| **share <= 0.0);
        let mut sums = Self {
            pixels: pixels as u64,
            misses: misses.count() as u64,
            clamped: planes.clamped as u64,
            suspicious: found,
            ..Self::default()
        };
        for (channel, plane) in planes.features.iter().enumerate() {
            let samples = counted_samples(channel, plane.to_f32(), mask.as_deref());
            sums.features[channel] = ChannelMoments::of(&samples);
        }
        let color: Vec<f32> = planes.color.iter().flat_map(Plane::to_f32).collect();
        sums.summary = Some(FrameSummary::new(&color, &sums.features));
        let textures = &planes.features[TEXTURES..];
        let references = planes.reference.iter().flatten();
        for ((color, plane), texture) in sums.color.iter_mut().zip(references).zip(textures) {
            let modulation = match albedo_epsilon {
                Some(epsilon) => texture
                    .to_f32()
                    .iter()
                    .map(|t| t.clamp(0.0, MAX_ALBEDO) + epsilon)
                    .collect(),
                None => vec![1.0; pixels],
            };
            let samples: Vec<f32> = plane.to_f32().iter().map(|x| x * scale).collect();
            *color = FlatColor::of(&samples, &modulation, relmse_epsilon);
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

/// The double nearest to the decimal number in the configuration: 0.001, not its single-precision
/// neighbour.
fn decimal(value: f32) -> f64 {
    value.to_string().parse().expect("a float prints as one")
}

/// Fits the constant c with the least RelMSE (Eq. 5) of m c against the samples r of a channel. The
/// derivative of `sum (r - m c)^2 / (r^2 + epsilon)` is zero at the mean of r / m with weights `m^2
/// / (r^2 + epsilon)`.
#[derive(Debug, Default, Clone, Copy)]
struct FlatColor {
    weighted: f64,
    weights: f64,
}

impl FlatColor {
    fn of(samples_hdr: &[f32], scale: &[f32], relmse_epsilon: f64) -> Self {
        let mut sums = Self::default();
        for (&sample, &scale) in samples_hdr.iter().zip(scale) {
            let [sample, scale] = [sample, scale].map(f64::from);
            let weight = scale / (sample * sample + relmse_epsilon);
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
    fn flat_color_has_the_least_relmse() {
        let samples: Vec<f32> = (0..500)
            .map(|i| (i as f32 * 0.7).sin().powi(4) * 2.0)
            .collect();
        let textures: Vec<f32> = (0..500).map(|i| 0.1 + (i % 7) as f32 / 7.0).collect();
        let cases = [
            (vec![1.0; 500], 0.001),
            (textures, 0.001),
            (vec![1.0; 500], 0.1),
        ];
        for (scale, epsilon) in cases {
            let loss = |c: f64| -> f64 {
                let terms = samples.iter().zip(&scale).map(|(&r, &m)| {
                    let [r, m] = [r, m].map(f64::from);
                    (r - m * c).powi(2) / (r * r + epsilon)
                });
                terms.sum()
            };
            let best = FlatColor::of(&samples, &scale, epsilon).best();
            assert!(loss(best) < loss(best * 1.01) && loss(best) < loss(best * 0.99));
            assert!(loss(best) < loss(0.0), "better than black");
        }
    }
}
