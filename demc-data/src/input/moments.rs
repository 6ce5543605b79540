//! Mean and standard deviation of a channel's samples, in double precision.

use crate::image::frame::{MAX_ALBEDO, TEXTURES};

/// The samples of a feature channel for statistics, as the network sees them: normals and positions
/// of pixels with a hit, and albedo up to `MAX_ALBEDO`.
pub(crate) fn counted_samples(
    channel: usize,
    mut samples: Vec<f32>,
    mask: Option<&[f32]>,
) -> Vec<f32> {
    if channel >= TEXTURES {
        for sample in &mut samples {
            *sample = sample.min(MAX_ALBEDO);
        }
    }
    // Normals and positions are undefined without a hit.
    if let Some(mask) = mask.filter(|_| channel < TEXTURES) {
        let mut mask = mask.iter();
        samples.retain(|_| mask.next().is_some_and(|share| *share > 0.0));
    }
    samples
}

/// Count, mean and sum of squared distances from the mean.
#[derive(Debug, Default, Clone, Copy)]
pub(crate) struct ChannelMoments {
    count: f64,
    pub(crate) mean: f64,
    squares: f64,
}

impl ChannelMoments {
    /// Two passes, so that positions far from the origin lose no digits.
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

    /// Combines two sets (Chan, Golub and LeVeque 1983).
    pub(crate) fn add(&mut self, other: &Self) {
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

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn moments_of_parts_are_the_moments_of_the_whole() {
        // Around 1e4, as positions can be; a sum of squares in f32 would lose all digits.
        let samples: Vec<f32> = (0..1000).map(|i| 1e4 + (i as f32 * 0.7).sin()).collect();
        let whole = ChannelMoments::of(&samples);
        let mut parts = ChannelMoments::default();
        for part in [
            &samples[..1],
            &samples[1..700],
            &samples[700..700],
            &samples[700..],
        ] {
            parts.add(&ChannelMoments::of(part));
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
        let moments = ChannelMoments::of(&[1.0, 2.0, 3.0, 6.0]);
        assert_eq!((moments.mean, moments.std()), (3.0, 3.5f64.sqrt()));
    }
}
