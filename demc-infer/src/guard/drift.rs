//! Compares an image's statistics with the ranges of the training scenes.

use demc_data::check::geometry::Warning;
use demc_data::image::frame::FEATURE_NAMES;
use demc_data::{FrameSummary, PositionSpace, Ranges};

/// Largest distance of a mean from the training scenes' range, in widths of that range.
///
/// Ours. Of the data set's 19 test scenes against its 89 training scenes, the farthest is at 0.18.
const MAX_DISTANCE: f64 = 1.0;

/// Largest ratio of a deviation to the training scenes' largest (ours; the test scenes' maximum is
/// 1.5).
const MAX_DEVIATION_RATIO: f64 = 3.0;

/// Smallest assumed width of a channel's range, in the channel's unit: for channels that the
/// training scenes hardly use (ours).
const MIN_WIDTH: f64 = 0.05;

/// Number of channels of a buffer.
const BUFFER: usize = 3;

/// The name of each buffer, and the likely cause when it drifts.
const BUFFERS: [(&str, &str); 4] = [
    ("normal", "is it another buffer, or in another space?"),
    (
        "position",
        "is it in another unit, or is the scene far from the origin? Training on scenes of that scale would help",
    ),
    (
        "texture1",
        "is it another buffer, or something other than albedo?",
    ),
    (
        "texture2",
        "is it another buffer, or something other than albedo?",
    ),
];

/// One warning for each buffer that drifts. Positions are compared in [`PositionSpace::Scene`].
pub(super) fn warnings(
    image: &FrameSummary,
    training: &Ranges,
    position: PositionSpace,
) -> Vec<Warning> {
    let buffers = BUFFERS.iter().enumerate();
    buffers
        .filter(|(_, (name, _))| position.is_scene() || *name != "position")
        .filter_map(|(buffer, (_, cause))| {
            let channels = buffer * BUFFER..(buffer + 1) * BUFFER;
            let (channel, found) = channels
                .filter_map(|channel| Some((channel, channel_drift(image, training, channel)?)))
                .next()?;
            Some(Warning {
                what: FEATURE_NAMES[channel].into(),
                found,
                cause,
            })
        })
        .collect()
}

/// How a channel's mean or deviation leaves the training range; `None` if it does not.
fn channel_drift(image: &FrameSummary, training: &Ranges, channel: usize) -> Option<String> {
    let (mean, std) = (image.mean[channel], image.std[channel]);
    let (means, stds) = (training.mean[channel], training.std[channel]);
    let (low, high) = (f64::from(means.low), f64::from(means.high));
    let width = (high - low).max(MIN_WIDTH);
    let distance = (low - mean).max(mean - high) / width;
    if distance > MAX_DISTANCE {
        return Some(format!(
            "its mean is {mean:.3}, in the training scenes {low:.3} to {high:.3}"
        ));
    }
    let largest = f64::from(stds.high).max(MIN_WIDTH);
    (std > MAX_DEVIATION_RATIO * largest).then(|| {
        let smallest = stds.low;
        format!(
            "its standard deviation is {std:.3}, in the training scenes {smallest:.3} to {largest:.3}"
        )
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    fn summary(exposure: f64, position_x: f64, deviation: f64) -> FrameSummary {
        let mut mean = [0.5; 12];
        mean[3] = position_x;
        FrameSummary {
            exposure,
            mean,
            std: [deviation; 12],
        }
    }

    fn training() -> Ranges {
        let scenes: Vec<FrameSummary> = (0..20)
            .map(|i| summary(0.1 + 0.01 * f64::from(i), f64::from(i), 0.2))
            .collect();
        Ranges::of(&scenes)
    }

    fn warnings(image: &FrameSummary, training: &Ranges) -> Vec<Warning> {
        super::warnings(image, training, PositionSpace::Scene)
    }

    #[test]
    fn an_image_like_the_training_scenes_causes_no_warning() {
        assert_eq!(warnings(&summary(0.2, 3.0, 0.2), &training()), []);
        assert_eq!(warnings(&summary(0.2, -5.0, 0.3), &training()), []);
    }

    #[test]
    fn any_exposure_and_any_position_relative_to_the_image_is_fine() {
        assert_eq!(warnings(&summary(2e3, 3.0, 0.2), &training()), []);
        let far = summary(0.2, 1000.0, 0.2);
        assert_eq!(super::warnings(&far, &training(), PositionSpace::Image), []);
        assert_eq!(warnings(&far, &training()).len(), 1);
    }

    #[test]
    fn each_drift_is_named_with_its_numbers() {
        let [far] = &warnings(&summary(0.2, 1000.0, 0.2), &training())[..] else {
            panic!("one warning");
        };
        assert!(
            far.to_string().starts_with(
                "position.x: its mean is 1000.000, in the training scenes 1.000 to 18"
            ),
            "{far}"
        );
        let wide = warnings(&summary(0.2, 3.0, 2.0), &training());
        let whats: Vec<&str> = wide.iter().map(|warning| warning.what.as_str()).collect();
        assert_eq!(
            whats,
            ["normal.x", "position.x", "texture1.r", "texture2.r"]
        );
    }
}
