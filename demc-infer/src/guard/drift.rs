//! An image's numbers beside those of the training scenes.

use demc_data::frame::FEATURE_NAMES;
use demc_data::ranges::Range;
use demc_data::{Ranges, Summary};

use super::Warning;

/// How far outside the training scenes' range a mean may lie, in widths of that range (ours: another scene has its camera somewhere
/// else; of the data set's 19 test scenes against its 89 training scenes the farthest is at 0.18).
const FAR: f64 = 1.0;

/// How many times the largest of the training scenes' deviations a deviation may be (the test scenes' most is 1.5).
const WIDE: f64 = 3.0;

/// How many stops outside the training scenes' range the exposure may lie (the test scenes' most is 0.75).
const STOPS: f64 = 1.0;

/// A channel's range is taken to be at least this wide, in the channel's unit: one that the training scenes hardly use.
const LEAST_WIDTH: f64 = 0.05;

/// Channels of a buffer.
const BUFFER: usize = 3;

/// The name of a buffer, and what it likely is when it drifts.
const BUFFERS: [(&str, &str); 4] = [
    ("normal", "another buffer, or another space?"),
    (
        "position",
        "another unit, or a scene far from the origin? Training on scenes of that scale would help",
    ),
    ("texture1", "another buffer, or not a reflectance?"),
    ("texture2", "another buffer, or not a reflectance?"),
];

/// One warning for the exposure and one for each buffer that drifts.
pub(super) fn warnings(image: &Summary, training: &Ranges) -> Vec<Warning> {
    let features = BUFFERS
        .iter()
        .enumerate()
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
        });
    exposure(image.exposure, training.exposure)
        .into_iter()
        .chain(features)
        .collect()
}

/// What is wrong with a channel's mean or deviation.
fn channel_drift(image: &Summary, training: &Ranges, channel: usize) -> Option<String> {
    let (mean, std) = (image.mean[channel], image.std[channel]);
    let (means, stds) = (training.mean[channel], training.std[channel]);
    let (low, high) = (f64::from(means.low), f64::from(means.high));
    let width = (high - low).max(LEAST_WIDTH);
    let beyond = (low - mean).max(mean - high) / width;
    if beyond > FAR {
        return Some(format!(
            "its mean is {mean:.3}, {low:.3} to {high:.3} in the training scenes"
        ));
    }
    let most = f64::from(stds.high).max(LEAST_WIDTH);
    (std > WIDE * most).then(|| {
        let least = stds.low;
        format!("it varies by {std:.3}, {least:.3} to {most:.3} in the training scenes")
    })
}

fn exposure(found: f64, training: Range) -> Option<Warning> {
    let (low, high) = (f64::from(training.low), f64::from(training.high));
    let (below, above) = ((low / found).log2(), (found / high).log2());
    let (stops, than) = match below > above {
        true => (below, "darker than the darkest"),
        false => (above, "brighter than the brightest"),
    };
    // A black image has nothing to expose.
    (found > 0.0 && stops > STOPS).then(|| Warning {
        what: "colour".into(),
        found: format!("it is {stops:.1} stops {than} training scenes (exposure {found:.4}, there {low:.4} to {high:.4})"),
        cause: "wrong exposure or unit? Scale the radiance before, and back after",
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    fn summary(exposure: f64, position_x: f64, deviation: f64) -> Summary {
        let mut mean = [0.5; 12];
        mean[3] = position_x;
        Summary {
            exposure,
            mean,
            std: [deviation; 12],
        }
    }

    fn training() -> Ranges {
        let scenes: Vec<Summary> = (0..20)
            .map(|i| summary(0.1 + 0.01 * f64::from(i), f64::from(i), 0.2))
            .collect();
        Ranges::of(&scenes)
    }

    #[test]
    fn an_image_like_the_training_scenes_is_quiet() {
        assert_eq!(warnings(&summary(0.2, 3.0, 0.2), &training()), []);
        assert_eq!(warnings(&summary(0.2, -5.0, 0.3), &training()), []);
        assert_eq!(warnings(&summary(0.0, 3.0, 0.2), &training()), []);
    }

    #[test]
    fn each_drift_is_named_with_its_numbers() {
        let [exposed] = &warnings(&summary(2.0, 3.0, 0.2), &training())[..] else {
            panic!("one warning");
        };
        assert!(
            exposed
                .to_string()
                .starts_with("colour: it is 2.8 stops brighter"),
            "{exposed}"
        );
        let [far] = &warnings(&summary(0.2, 1000.0, 0.2), &training())[..] else {
            panic!("one warning");
        };
        assert!(
            far.to_string()
                .starts_with("position.x: its mean is 1000.000, 1.000 to 18.000 in the training"),
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
