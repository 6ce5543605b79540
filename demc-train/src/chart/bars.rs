//! A panel of bars with intervals and dots, a bar a variant.

use super::axis::{Axis, shows, three_digits};
use super::frame::{self, Entries, ROW, WORDS, Words};
use super::shape::{Align, Area, Drawing, GREY, INK, WHITE, palette};
use super::{Bar, BarPanel, Scale};

/// Share of its slot that a bar is wide.
const BAR: f64 = 0.6;
/// Widest bar, in pixels.
const WIDEST: f64 = 180.0;
/// Half the width of an interval's caps.
const CAP: f64 = 14.0;
/// Values all above this share of the largest are drawn without bars, on an axis that does not start at 0: from 0
/// they would look the same.
const NEAR: f64 = 0.5;
/// Least pixels of a panel that are not its plot: labels at the left, margins.
const AROUND: f64 = 190.0;

/// The legend's entries for a panel.
pub(super) fn entries(panel: &BarPanel) -> Entries {
    let bars = panel.names.iter().zip(&panel.bars).enumerate();
    bars.map(|(i, (name, _))| (name.clone(), i)).collect()
}

/// Whether every name fits below its bar, in a panel of `width`.
pub(super) fn names_fit(drawing: &Drawing, panel: &BarPanel, width: f64) -> bool {
    let slot = (width - AROUND) / panel.names.len().max(1) as f64;
    let names = panel.names.iter();
    let mut widths = names.map(|name| drawing.text_width(name, WORDS));
    widths.all(|width| width < slot)
}

/// Draws `panel` into `cell`, with names below the bars if `named`.
pub(super) fn draw(drawing: &mut Drawing, cell: Area, panel: &BarPanel, named: bool) {
    let bars: Vec<_> = panel.names.iter().zip(&panel.bars).collect();
    let values: Vec<f64> = bars
        .iter()
        .flat_map(|(_, bar)| values(bar))
        .filter(|value| shows(panel.y, *value))
        .collect();
    let from_zero = panel.y == Scale::Linear && !are_near(&values);
    let axis = axis(panel.y, &values, from_zero);
    let words = Words {
        title: &panel.title,
        x_label: "",
        y_label: &panel.y_label,
    };
    let inside = frame::around(drawing, cell, words, axis.as_ref(), 0);
    let Some(axis) = axis else {
        frame::axes(drawing, inside);
        return frame::no_data(drawing, inside);
    };
    frame::y_ticks(drawing, inside, &axis);
    let slot = 1.0 / bars.len() as f64;
    let base = match (panel.y, from_zero) {
        (Scale::Linear, true) => Some(axis.at(0.0)),
        (Scale::Linear, false) => None,
        (Scale::Log, _) => Some(0.0),
    };
    for (i, (name, bar)) in bars.iter().enumerate() {
        let x = (i as f64 + 0.5) * slot;
        draw_bar(drawing, inside, panel.y, &axis, (x, slot), base, (i, bar));
        if named {
            frame::x_name(drawing, inside, x, name);
        }
    }
    if let Some(base) = base {
        drawing.line(vec![inside.at(0.0, base), inside.at(1.0, base)], 2, GREY);
    }
    frame::axes(drawing, inside);
}

/// All values that a bar shows.
fn values(bar: &Bar) -> impl Iterator<Item = f64> {
    let ends = bar.interval.into_iter().flat_map(|(low, high)| [low, high]);
    [bar.value]
        .into_iter()
        .chain(ends)
        .chain(bar.points.clone())
}

fn are_near(values: &[f64]) -> bool {
    let low = values.iter().copied().fold(f64::INFINITY, f64::min);
    let high = values.iter().copied().fold(f64::NEG_INFINITY, f64::max);
    low > NEAR * high && low > 0.0
}

/// Room above for the number over a bar; below none where the bars stand on zero.
fn axis(scale: Scale, values: &[f64], from_zero: bool) -> Option<Axis> {
    let zero = (from_zero && !values.is_empty()).then_some(0.0);
    let is_negative = values.iter().any(|value| *value < 0.0);
    let below = if from_zero && !is_negative { 0.0 } else { 0.12 };
    Axis::over(scale, values.iter().copied().chain(zero), [below, 0.16])
}

fn draw_bar(
    drawing: &mut Drawing,
    inside: Area,
    scale: Scale,
    axis: &Axis,
    (x, slot): (f64, f64),
    base: Option<f64>,
    (color, bar): (usize, &Bar),
) {
    if !shows(scale, bar.value) {
        let at = inside.at(x, 0.0);
        return drawing.text((at.0, at.1 - ROW / 2.0), "n/a", WORDS, Align::Center, INK);
    }
    let half = (slot * inside.width() * BAR).min(WIDEST) / 2.0;
    let (middle, top) = inside.at(x, axis.at(bar.value));
    match base {
        Some(base) => {
            let bottom = inside.at(x, base).1;
            let area = Area {
                left: middle - half,
                top: top.min(bottom),
                right: middle + half,
                bottom: top.max(bottom),
            };
            drawing.fill(area, palette(color));
        }
        None => drawing.line(
            vec![(middle - half, top), (middle + half, top)],
            8,
            palette(color),
        ),
    }
    for (i, value) in bar
        .points
        .iter()
        .enumerate()
        .filter(|(_, v)| shows(scale, **v))
    {
        // Spread by the golden ratio, clear of the interval in the middle.
        let spread = (i as f64 * 0.618).fract() * 0.5 + 0.3;
        let side = if i % 2 == 0 { 1.0 } else { -1.0 };
        let at = (
            middle + side * spread * half,
            inside.at(x, axis.at(*value)).1,
        );
        drawing.dot(at, 7, WHITE);
        drawing.dot(at, 5, INK);
    }
    let shown = || values(bar).filter(|value| shows(scale, *value));
    let lowest = shown().fold(bar.value, f64::min);
    let highest = shown().fold(bar.value, f64::max);
    if let Some((low, high)) = bar.interval.filter(|ends| shows(scale, ends.1)) {
        let low = shows(scale, low).then(|| axis.at(low));
        draw_interval(drawing, inside, x, low, axis.at(high));
    }
    let at = match bar.value < 0.0 {
        true => inside.at(x, axis.at(lowest)).1 + 0.8 * WORDS,
        false => inside.at(x, axis.at(highest)).1 - 0.8 * WORDS,
    };
    drawing.text_on_white((middle, at), &three_digits(bar.value), WORDS);
}

/// An interval with caps, edged in white so that it shows on a dark bar. One without a low end on the axis goes down to it.
fn draw_interval(drawing: &mut Drawing, inside: Area, x: f64, low: Option<f64>, high: f64) {
    let (from, to) = (inside.at(x, low.unwrap_or(0.0)), inside.at(x, high));
    for (width, cap, color) in [(9, CAP + 3.0, WHITE), (4, CAP, INK)] {
        drawing.line(vec![from, to], width, color);
        let ends = [low.map(|_| from), Some(to)];
        for (across, down) in ends.into_iter().flatten() {
            drawing.line(
                vec![(across - cap, down), (across + cap, down)],
                width,
                color,
            );
        }
    }
}

#[cfg(test)]
mod tests {
    use super::super::paint::Font;
    use super::super::shape::Shape;
    use super::*;

    fn drawn(values: &[f64], y: Scale) -> Vec<Shape> {
        let bar = |value: &f64| Bar {
            value: *value,
            interval: Some((value * 0.9, value * 1.1)),
            points: vec![value * 0.95, value * 1.05],
        };
        let panel = BarPanel {
            title: "RelMSE".to_string(),
            y_label: String::new(),
            names: values.iter().map(|value| format!("v{value}")).collect(),
            bars: values.iter().map(bar).collect(),
            y,
        };
        let mut drawing = Drawing::new(800.0, 600.0, Font::embedded().unwrap());
        let cell = Area {
            left: 0.0,
            top: 0.0,
            right: 800.0,
            bottom: 600.0,
        };
        assert!(names_fit(&drawing, &panel, 800.0));
        draw(&mut drawing, cell, &panel, true);
        drawing.shapes
    }

    fn heights(shapes: &[Shape]) -> Vec<f64> {
        let of = |shape: &Shape| match shape {
            Shape::Box { area, color } if *color != WHITE => Some(area.bottom - area.top),
            _ => None,
        };
        shapes.iter().filter_map(of).collect()
    }

    #[test]
    fn bars_from_zero_are_as_high_as_their_values() {
        let heights = heights(&drawn(&[0.1, 0.4], Scale::Linear));
        assert!((heights[1] / heights[0] - 4.0).abs() < 1e-9, "{heights:?}");
    }

    #[test]
    fn values_near_each_other_get_an_axis_of_their_own_and_no_bars() {
        let shapes = drawn(&[0.90, 0.92], Scale::Linear);
        assert!(heights(&shapes).is_empty());
        let is_thick = |shape: &&Shape| matches!(shape, Shape::Line { width: 8, .. });
        assert_eq!(shapes.iter().filter(is_thick).count(), 2);
    }

    #[test]
    fn bar_without_a_value_says_so() {
        let says = |values: &[f64], words: &str| {
            let shapes = drawn(values, Scale::Log);
            let is_it = |shape: &Shape| matches!(shape, Shape::Text { text, .. } if text == words);
            shapes.iter().any(is_it)
        };
        assert!(says(&[0.5, f64::NAN], "n/a") && says(&[0.5, f64::NAN], "0.500"));
        assert!(says(&[f64::NAN, 0.0], "no data"));
    }
}
