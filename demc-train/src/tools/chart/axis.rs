//! Axes: their range and the values they label.

use std::ops::Range;

use plotters::coord::ranged1d::{KeyPointHint, NoDefaultFormatting, ValueFormatter};
use plotters::coord::types::RangedCoordf64;
use plotters::prelude::*;

use super::figure::AxisScale;

/// Values beyond 1e100, or below 1e-100 on a log axis, count as not finite: ranges would overflow.
const EXTREME: f64 = 1e100;

/// An axis of `plotters` whose spacing is chosen at run time.
pub(super) enum Axis {
    Linear(RangedCoordf64),
    Log(LogCoord<f64>),
}

/// Whether an axis of `scale` can show `value`.
pub(super) fn shows(scale: AxisScale, value: f64) -> bool {
    value.abs() < EXTREME && (scale == AxisScale::Linear || value > 1.0 / EXTREME)
}

impl Axis {
    /// An axis over `values` plus a margin at each end, as a share of their span. `None` without
    /// values.
    pub(super) fn over(
        scale: AxisScale,
        values: impl IntoIterator<Item = f64>,
        margins: [f64; 2],
    ) -> Option<Self> {
        let values = values.into_iter().map(|value| match scale {
            AxisScale::Linear => value,
            AxisScale::Log => value.log10(),
        });
        let (low, high) = values.fold((f64::INFINITY, f64::NEG_INFINITY), |(low, high), value| {
            (low.min(value), high.max(value))
        });
        let largest = low.abs().max(high.abs());
        let [below, above] = match high - low > 1e-9 * largest {
            true => margins.map(|share| share * (high - low)),
            // One distinct value: half to double on a log axis, else a tenth of it to either side.
            false if scale == AxisScale::Log => [0.3; 2],
            false if largest > 0.0 => [0.1 * largest; 2],
            false => [1.0; 2],
        };
        let (low, high) = (low - below, high + above);
        (low < high).then(|| match scale {
            AxisScale::Linear => Axis::Linear((low..high).into()),
            AxisScale::Log => Axis::Log((10_f64.powf(low)..10_f64.powf(high)).log_scale().into()),
        })
    }
}

impl Ranged for Axis {
    type FormatOption = NoDefaultFormatting;
    type ValueType = f64;

    fn map(&self, value: &f64, limit: (i32, i32)) -> i32 {
        match self {
            Axis::Linear(axis) => axis.map(value, limit),
            Axis::Log(axis) => axis.map(value, limit),
        }
    }

    fn key_points<Hint: KeyPointHint>(&self, hint: Hint) -> Vec<f64> {
        match (self, hint.weight().allow_light_points()) {
            (Axis::Linear(_), true) => Vec::new(),
            (Axis::Linear(axis), false) => axis.key_points(hint),
            (Axis::Log(axis), is_light) => log_points(&axis.range(), is_light, hint),
        }
    }

    fn range(&self) -> Range<f64> {
        match self {
            Axis::Linear(axis) => axis.range(),
            Axis::Log(axis) => axis.range(),
        }
    }
}

impl ValueFormatter<f64> for Axis {
    fn format(value: &f64) -> String {
        number(*value, 9)
    }
}

/// Labels of a log axis: multiples of powers of ten.
///
/// Tries all of 1 to 9, then 1-2-5, then 1-2-3-5-7, then powers of ten alone, until they fit.
/// `plotters` labels powers of ten only, and a loss between 0.2 and 0.8 contains none.
fn log_points(range: &Range<f64>, is_light: bool, hint: impl KeyPointHint) -> Vec<f64> {
    let most = hint.max_num_points();
    let decades = range.start.log10().floor() as i32..=range.end.log10().ceil() as i32;
    let points = |digits: &[i32], stride: usize| -> Vec<f64> {
        let decades = decades.clone().step_by(stride);
        decades
            .flat_map(|decade| digits.iter().map(move |digit| (*digit, decade)))
            .map(|(digit, decade)| f64::from(digit) * 10_f64.powi(decade))
            .filter(|value| range.contains(value))
            .collect()
    };
    let all = points(&[1, 2, 3, 4, 5, 6, 7, 8, 9], 1);
    if all.len() < 3 && !is_light {
        return RangedCoordf64::from(range.clone()).key_points(hint);
    }
    if all.len() <= most / 2 {
        return all;
    }
    [&[1, 2, 5][..], &[1, 2, 3, 5, 7]]
        .map(|digits| points(digits, 1))
        .into_iter()
        .filter(|choice| choice.len() >= 3)
        .chain((1..=200).map(|stride| points(&[1], stride)))
        .find(|choice| choice.len() <= most)
        .unwrap_or_default()
}

/// A number with `digits` digits after the first: 0.05, 250k, 1e-6.
pub(super) fn number(value: f64, digits: usize) -> String {
    let rounded: f64 = format!("{value:.digits$e}").parse().unwrap_or(value);
    match rounded.abs() {
        // `plotters` adds steps up: a zero may come out as 1e-17.
        ..1e-15 => "0".to_string(),
        ..1e-3 | 1e9.. => format!("{rounded:e}"),
        1e6.. => format!("{}M", rounded / 1e6),
        1e4.. => format!("{}k", rounded / 1e3),
        _ => rounded.to_string(),
    }
}

#[cfg(test)]
mod tests {
    use plotters::coord::ranged1d::BoldPoints;

    use super::*;

    fn labels(scale: AxisScale, low: f64, high: f64, most: usize) -> Vec<String> {
        let axis = Axis::over(scale, [low, high], [0.01; 2]).unwrap();
        let points = axis.key_points(BoldPoints(most)).into_iter();
        points.map(|value| number(value, 9)).collect()
    }

    #[test]
    fn labels_are_short_and_round() {
        let steps = ["0", "50k", "100k", "150k", "200k", "250k"];
        assert_eq!(labels(AxisScale::Linear, 0.0, 250_000.0, 8), steps);
        assert_eq!(
            labels(AxisScale::Linear, 0.2, 0.31, 4),
            ["0.2", "0.25", "0.3"]
        );
        assert_eq!(
            labels(AxisScale::Log, 0.1, 1.0, 5),
            ["0.1", "0.2", "0.5", "1"]
        );
        assert_eq!(labels(AxisScale::Log, 0.2, 0.4, 6), ["0.2", "0.3", "0.4"]);
        assert_eq!(labels(AxisScale::Log, 0.3, 0.9, 6), ["0.3", "0.5", "0.7"]);
        assert_eq!(labels(AxisScale::Log, 1e-5, 1.0, 4), ["1e-4", "0.01", "1"]);
        assert_eq!(
            labels(AxisScale::Log, 0.21, 0.29, 5).first().unwrap(),
            "0.22"
        );
        let bars = [1.4249, 0.03091, 0.95].map(|value| number(value, 2));
        assert_eq!(bars, ["1.42", "0.0309", "0.95"]);
    }

    #[test]
    fn extreme_values_have_few_ticks_too() {
        let (tiny, huge) = (1e-99, 9e99);
        for (low, high) in [(0.0, huge), (-huge, huge), (0.0, tiny), (1e6, 1e6 + 0.01)] {
            assert!(
                labels(AxisScale::Linear, low, high, 8).len() <= 9,
                "{low} {high}"
            );
        }
        assert!((2..9).contains(&labels(AxisScale::Log, tiny, huge, 8).len()));
        assert!(Axis::over(AxisScale::Log, [], [0.1; 2]).is_none());
    }
}
