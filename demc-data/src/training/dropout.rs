//! Feature dropout: training patches that lack a feature buffer at random. A network that was trained
//! this way also denoises files without the buffer. Ours; the paper has no such thing.

use rand::RngExt;
use serde::{Deserialize, Serialize};

use crate::image::frame::FEATURES;
use crate::image::layout::{Missing, MissingPolicies};
use crate::seed::{RandomStream, generator};

/// Number of channels of a buffer.
const BUFFER: usize = 3;
/// Indices of the two textures among the buffers.
const TEXTURE1: usize = 2;
const TEXTURE2: usize = 3;

/// The probability that a patch lacks each feature buffer. A dropped `texture2` is a copy of
/// `texture1`; any other dropped buffer is zero.
#[derive(Debug, Clone, Copy, Default, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct Dropout {
    /// For the normal.
    pub normal: f64,
    /// For the position.
    pub position: f64,
    /// For the first texture.
    pub texture1: f64,
    /// For the second texture.
    pub texture2: f64,
}

impl Dropout {
    /// Whether no buffer is ever dropped.
    pub fn is_off(&self) -> bool {
        *self == Self::default()
    }

    /// Each key below `data.` with its probability.
    pub fn probabilities(&self) -> [(&'static str, f64); 4] {
        [
            ("dropout.normal", self.normal),
            ("dropout.position", self.position),
            ("dropout.texture1", self.texture1),
            ("dropout.texture2", self.texture2),
        ]
    }

    /// What replaces the buffers that a network trained with this dropout can do without.
    pub fn missing(&self) -> MissingPolicies {
        let policy = |probability, policy| {
            if probability > 0.0 {
                policy
            } else {
                Missing::Error
            }
        };
        MissingPolicies {
            normal: policy(self.normal, Missing::Zeros),
            position: policy(self.position, Missing::Zeros),
            texture1: policy(self.texture1, Missing::Zeros),
            texture2: policy(self.texture2, Missing::CopyTexture1),
        }
    }

    /// Draws which buffers the patch at `position` of `epoch` lacks.
    pub(crate) fn draw(&self, seed: u64, epoch: u64, position: u64) -> [bool; 4] {
        let mut rng = generator(RandomStream::Dropout, seed, epoch, position);
        self.probabilities()
            .map(|(_, probability)| rng.random::<f64>() < probability)
    }
}

/// Drops buffers of a patch in place.
///
/// # Shapes
/// `features` is `[12, N]`, as rendered or with mapped positions.
pub(crate) fn drop_buffers(features: &mut [f32], dropped: [bool; 4]) {
    let size = features.len() / FEATURES * BUFFER;
    for buffer in (0..dropped.len()).filter(|buffer| dropped[*buffer]) {
        match buffer {
            TEXTURE2 => features.copy_within(TEXTURE1 * size..TEXTURE2 * size, TEXTURE2 * size),
            _ => features[buffer * size..][..size].fill(0.0),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_dropped_buffer_is_zero_and_a_dropped_second_texture_is_the_first() {
        let features: Vec<f32> = (1..=24).map(|x| x as f32).collect();
        let dropped = |buffers| {
            let mut out = features.clone();
            drop_buffers(&mut out, buffers);
            out
        };
        assert_eq!(dropped([false; 4]), features);
        let position = dropped([false, true, false, false]);
        assert_eq!(position[6..12], [0.0; 6]);
        assert_eq!(position[12..], features[12..]);
        let second = dropped([false, false, false, true]);
        assert_eq!(second[18..], features[12..18]);
        assert_eq!(second[..18], features[..18]);
        assert_eq!(dropped([true; 4]), [0.0; 24]);
    }

    #[test]
    fn each_buffer_is_dropped_as_often_as_its_probability_says() {
        let dropout = Dropout {
            position: 0.25,
            texture2: 1.0,
            ..Dropout::default()
        };
        let draws: Vec<[bool; 4]> = (0..4000).map(|i| dropout.draw(7, 0, i)).collect();
        let share = |buffer: usize| {
            draws.iter().filter(|drawn| drawn[buffer]).count() as f64 / draws.len() as f64
        };
        assert_eq!([share(0), share(2), share(3)], [0.0, 0.0, 1.0]);
        // The standard error is 0.007.
        assert!((share(1) - 0.25).abs() < 0.03, "{}", share(1));
    }

    #[test]
    fn buffers_that_training_dropped_may_be_missing() {
        let dropout = Dropout {
            normal: 0.1,
            texture2: 0.5,
            ..Dropout::default()
        };
        let missing = dropout.missing();
        assert_eq!(missing.normal, Missing::Zeros);
        assert_eq!(missing.texture2, Missing::CopyTexture1);
        assert_eq!(missing.position, Missing::Error);
    }
}
