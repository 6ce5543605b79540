//! Axes: which values one shows, how far it reaches, and where its ticks are.

use super::Scale;

/// Values beyond 1e100, or below 1e-100 on a log axis, count as not finite: their ranges would overflow.
const EXTREME: f64 = 1e100;
/// Number from which a linear axis writes 10k for 10000.
const LARGE: f64 = 1e4;

/// A range of values and the way from it to `0..=1`.
#[derive(Clone, Copy, Debug)]
pub(super) struct Axis {
    scale: Scale,
    /// Ends, as `log10` on a log axis.
    low: f64,
    high: f64,
}

/// A place on an axis.
#[derive(Clone, Debug, PartialEq)]
pub(super) struct Tick {
    /// 0 at the low end, 1 at the high one.
    pub(super) at: f64,
    /// Empty for a minor tick.
    pub(super) label: String,
}

/// Whether an axis of `scale` can show `value`.
pub(super) fn shows(scale: Scale, value: f64) -> bool {
    match scale {
        Scale::Linear => value.abs() < EXTREME,
        Scale::Log => value > 1.0 / EXTREME && value < EXTREME,
    }
}

impl Axis {
    /// An axis over those of `values` that it can show, longer at both ends by these shares of their span.
    /// `None` without any.
    pub(super) fn over(
        scale: Scale,
        values: impl IntoIterator<Item = f64>,
        margins: [f64; 2],
    ) -> Option<Self> {
        let (low, high) = values
            .into_iter()
            .filter(|value| shows(scale, *value))
            .map(|value| forward(scale, value))
            .fold((f64::INFINITY, f64::NEG_INFINITY), |(low, high), value| {
                (low.min(value), high.max(value))
            });
        if low > high {
            return None;
        }
        let largest = low.abs().max(high.abs());
        let span = high - low;
        let [below, above] = match scale {
            // One value, or as good as one: a tenth of it to either side.
            Scale::Linear if span <= 1e-9 * largest && largest > 0.0 => [0.1 * largest; 2],
            Scale::Linear if span == 0.0 => [1.0; 2],
            Scale::Log if span < 1e-6 => [2.0_f64.log10(); 2],
            _ => margins.map(|share| share * span),
        };
        Some(Axis {
            scale,
            low: low - below,
            high: high + above,
        })
    }

    /// Where `value` is: 0 at the low end, 1 at the high one.
    pub(super) fn at(&self, value: f64) -> f64 {
        self.place(forward(self.scale, value))
    }

    fn place(&self, forwarded: f64) -> f64 {
        (forwarded - self.low) / (self.high - self.low)
    }

    /// About `wanted` labelled ticks.
    pub(super) fn ticks(&self, wanted: usize) -> Vec<Tick> {
        let wanted = wanted.max(2);
        match self.scale {
            Scale::Linear => self.even_ticks(self.low, self.high, wanted),
            Scale::Log => self.log_ticks(wanted),
        }
    }

    /// Ticks at multiples of 1, 2 or 5 times a power of ten between two values.
    fn even_ticks(&self, low: f64, high: f64, wanted: usize) -> Vec<Tick> {
        // A third more at most: rounding the step up makes them fewer.
        let least = (high - low) / (1.3 * wanted as f64);
        let exponent = least.log10().floor() as i32;
        let (factor, exponent) = [(1.0, exponent), (2.0, exponent), (5.0, exponent)]
            .into_iter()
            .find(|(factor, exponent)| factor * power(*exponent) >= least * (1.0 - 1e-9))
            .unwrap_or((1.0, exponent + 1));
        let step = factor * power(exponent);
        let first = (low / step - 1e-9).ceil() as i64;
        let last = (high / step + 1e-9).floor() as i64;
        let largest = low.abs().max(high.abs());
        (first..=last)
            .take(4 * wanted)
            .map(|i| {
                let value = i as f64 * step;
                Tick {
                    at: self.at(value),
                    label: even_label(value, exponent, largest),
                }
            })
            .collect()
    }

    fn log_ticks(&self, wanted: usize) -> Vec<Tick> {
        let decades = self.high - self.low;
        let inside: Vec<(i32, i32)> = (self.low.floor() as i32..=self.high.ceil() as i32)
            .flat_map(|exponent| (1..10).map(move |digit| (digit, exponent)))
            .filter(|(digit, exponent)| (0.0..=1.0).contains(&self.place_of(*digit, *exponent)))
            .collect();
        let of = |digits: &[i32]| inside.iter().filter(|at| digits.contains(&at.0)).count();
        let stride = (decades / wanted as f64).ceil() as i32;
        let digits: &[i32] = if inside.len() < 3 {
            return self.even_ticks(power_of(self.low), power_of(self.high), wanted);
        } else if of(&[1, 2, 5]) < 3 {
            &[1, 2, 3, 4, 5, 6, 7, 8, 9]
        } else if of(&[1, 2, 5]) <= wanted + 1 {
            &[1, 2, 5]
        } else {
            &[1]
        };
        let tiny = self.low < -3.0;
        inside
            .iter()
            .filter(|tick| stride == 1 || tick.0 == 1)
            .map(|tick| Tick {
                at: self.place_of(tick.0, tick.1),
                label: if digits.contains(&tick.0) && tick.1.rem_euclid(stride) == 0 {
                    log_label(tick.0, tick.1, tiny)
                } else {
                    String::new()
                },
            })
            .collect()
    }

    fn place_of(&self, digit: i32, exponent: i32) -> f64 {
        self.place(f64::from(digit).log10() + f64::from(exponent))
    }
}

fn forward(scale: Scale, value: f64) -> f64 {
    match scale {
        Scale::Linear => value,
        Scale::Log => value.log10(),
    }
}

fn power(exponent: i32) -> f64 {
    10.0_f64.powi(exponent)
}

fn power_of(exponent: f64) -> f64 {
    10.0_f64.powf(exponent)
}

/// The label of a multiple of `10^exponent` on an axis whose largest value is `largest`.
fn even_label(value: f64, exponent: i32, largest: f64) -> String {
    if value == 0.0 {
        return "0".to_string();
    }
    let magnitude = value.abs().log10().floor() as i32;
    if exponent < -4 || largest >= 1e12 {
        let digits = (magnitude - exponent).clamp(0, 15) as usize;
        return format!("{value:.digits$e}");
    }
    let units = [(9, "G"), (6, "M"), (3, "k")];
    let unit = units
        .into_iter()
        .find(|(unit, _)| largest >= LARGE && value.abs() >= power(*unit) * (1.0 - 1e-9));
    let (unit, name) = unit.unwrap_or((0, ""));
    let digits = (unit - exponent).max(0) as usize;
    let number = format!("{:.digits$}", value / power(unit));
    if unit > 0 && number.contains('.') {
        let short = number.trim_end_matches('0').trim_end_matches('.');
        return format!("{short}{name}");
    }
    format!("{number}{name}")
}

/// The label of `digit * 10^exponent`; `tiny` if the axis shows values below a thousandth.
fn log_label(digit: i32, exponent: i32, tiny: bool) -> String {
    match exponent {
        ..0 if tiny => format!("{digit}e{exponent}"),
        ..0 => format!("0.{}{digit}", "0".repeat((-exponent - 1) as usize)),
        0..12 => even_label(
            f64::from(digit) * power(exponent),
            exponent,
            power(exponent),
        ),
        _ => format!("{digit}e{exponent}"),
    }
}

/// A value to three significant digits.
pub(super) fn three_digits(value: f64) -> String {
    let magnitude = value.abs().log10().floor();
    if value != 0.0 && !(-3.0..5.0).contains(&magnitude) {
        return format!("{value:.2e}");
    }
    let digits = (2.0 - magnitude).clamp(0.0, 5.0) as usize;
    let digits = if value == 0.0 { 0 } else { digits };
    format!("{value:.digits$}")
}

#[cfg(test)]
mod tests {
    use super::*;

    fn labels(scale: Scale, low: f64, high: f64, wanted: usize) -> Vec<String> {
        let axis = Axis::over(scale, [low, high], [0.0; 2]).unwrap();
        let ticks = axis.ticks(wanted).into_iter().map(|tick| tick.label);
        ticks.filter(|label| !label.is_empty()).collect()
    }

    #[test]
    fn labels_are_short_and_round() {
        assert_eq!(
            labels(Scale::Linear, 0.0, 250_000.0, 5),
            ["0", "50k", "100k", "150k", "200k", "250k"]
        );
        assert_eq!(
            labels(Scale::Linear, 0.0, 5000.0, 5),
            ["0", "1000", "2000", "3000", "4000", "5000"]
        );
        assert_eq!(
            labels(Scale::Linear, 0.0, 1_500_000.0, 3),
            ["0", "500k", "1M", "1.5M"]
        );
        assert_eq!(
            labels(Scale::Linear, -0.1, 0.3, 4),
            ["-0.1", "0.0", "0.1", "0.2", "0.3"].map(|s| if s == "0.0" { "0" } else { s })
        );
        assert_eq!(
            labels(Scale::Log, 0.1, 2.0, 6),
            ["0.1", "0.2", "0.5", "1", "2"]
        );
        assert_eq!(
            labels(Scale::Log, 1e-6, 1.0, 4),
            ["1e-6", "1e-4", "1e-2", "1"]
        );
        assert_eq!(
            labels(Scale::Log, 1.0, 1e5, 6),
            ["1", "10", "100", "1000", "10k", "100k"]
        );
        assert_eq!(
            labels(Scale::Log, 0.30, 0.34, 4),
            ["0.30", "0.31", "0.32", "0.33", "0.34"]
        );
        assert_eq!(
            labels(Scale::Linear, 1e-6, 3e-6, 2),
            ["1e-6", "2e-6", "3e-6"]
        );
    }

    #[test]
    fn ticks_are_few_and_on_the_axis_for_any_range() {
        for scale in [Scale::Linear, Scale::Log] {
            for low in [1e-99, 1e-9, 0.00123, 0.5, 7.0, 12345.678, 1e16, 1e60] {
                for factor in [1.0, 1.0 + 1e-12, 1.001, 1.3, 3.0, 50.0, 1e7, 1e39] {
                    let axis = Axis::over(scale, [low, low * factor], [0.05; 2]).unwrap();
                    let ticks = axis.ticks(6);
                    let labelled = ticks.iter().filter(|tick| !tick.label.is_empty()).count();
                    assert!(
                        (2..=12).contains(&labelled),
                        "{scale:?} {low} {factor}: {ticks:?}"
                    );
                    let inside = |tick: &Tick| (-1e-6..=1.0 + 1e-6).contains(&tick.at);
                    assert!(
                        ticks.iter().all(inside),
                        "{scale:?} {low} {factor}: {ticks:?}"
                    );
                }
            }
        }
    }

    #[test]
    fn axis_places_by_its_scale_and_refuses_what_it_cannot_show() {
        let log = Axis::over(Scale::Log, [f64::NAN, -1.0, 0.0, 0.01, 1.0], [0.0; 2]).unwrap();
        assert!((log.at(0.1) - 0.5).abs() < 1e-12);
        let linear = Axis::over(Scale::Linear, [0.0, 10.0, f64::INFINITY], [0.1; 2]).unwrap();
        assert!((linear.at(0.0) - 1.0 / 12.0).abs() < 1e-12);
        assert!(Axis::over(Scale::Log, [0.0, -2.0, f64::NAN], [0.1; 2]).is_none());
    }

    #[test]
    fn values_have_three_digits() {
        let values = [0.12345, 0.0, 1234.0, 1.5, 0.000012, 23456789.0].map(three_digits);
        assert_eq!(values, ["0.123", "0", "1234", "1.50", "1.20e-5", "2.35e7"]);
    }
}
