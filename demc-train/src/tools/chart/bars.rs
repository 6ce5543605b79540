//! A panel of bars with intervals and dots, one bar per variant.

use plotters::prelude::*;

use super::axis::{Axis, number, shows};
use super::figure::{AxisScale, Bar, BarPanel};
use super::frame::{self, Area, Chart, GREY, INK, LegendEntries, ROW, palette, text_style};

/// Half the width of a bar, as a share of its slot, and at most this many pixels.
const HALF: (f64, f64) = (0.3, 90.0);
/// Width of an interval's caps as a share of the bar.
const CAP: f64 = 0.3;
/// If all values are above this share of the largest, the axis does not start at 0: bars from 0
/// would look equal.
const NEAR: f64 = 0.5;
/// Width available for the names below the bars, pixels.
const ROOM: i32 = 620;

/// Legend entries of a panel: none if its names fit below the bars.
pub(super) fn entries(panel: &BarPanel) -> LegendEntries {
    let bars = panel.names.iter().zip(&panel.bars).enumerate();
    let named = bars.filter(|_| !names_fit(panel));
    named.map(|(i, (name, _))| (name.clone(), i)).collect()
}

fn names_fit(panel: &BarPanel) -> bool {
    let slot = ROOM / panel.names.len().max(1) as i32;
    panel.names.iter().all(|name| frame::width(name) < slot)
}

pub(super) fn draw<B: DrawingBackend>(area: &Area<B>, panel: &BarPanel) -> DrawResult<(), B> {
    let bars = || panel.names.iter().zip(&panel.bars);
    let values: Vec<f64> = bars().flat_map(|(_, bar)| shown(bar, panel.y)).collect();
    let low = values.iter().copied().fold(f64::INFINITY, f64::min);
    let high = values.iter().copied().fold(f64::NEG_INFINITY, f64::max);
    let from_zero = panel.y == AxisScale::Linear && !(low > 0.0 && low > NEAR * high);
    let zero = (from_zero && !values.is_empty()).then_some(0.0);
    let below = if from_zero && low >= 0.0 { 0.0 } else { 0.12 };
    // Space for the number above a bar.
    let y = Axis::over(panel.y, values.into_iter().chain(zero), [below, 0.16]);
    let count = bars().count() as f64;
    let x = Axis::over(AxisScale::Linear, [0.0, count], [0.0; 2]);
    let chart = frame::chart(area, &panel.title, None, &panel.y_label, (x, y))?;
    let Some(mut chart) = chart else {
        return Ok(());
    };
    let bottom = chart.y_range().start;
    let base = match panel.y {
        AxisScale::Linear => zero,
        AxisScale::Log => Some(bottom),
    };
    let slot = f64::from(chart.plotting_area().dim_in_pixel().0) / count;
    let half = HALF.0.min(HALF.1 / slot);
    for (i, (name, bar)) in bars().enumerate() {
        if names_fit(panel) {
            let place = EmptyElement::at((i as f64 + 0.5, bottom));
            let name = Text::new(name.clone(), (0, ROW * 3 / 4), text_style(INK));
            chart.draw_series([place + name])?;
        }
        draw_bar(&mut chart, panel.y, base, half, (i, bar))?;
    }
    let line = |base| PathElement::new([(0.0, base), (count, base)], GREY.stroke_width(2));
    chart.draw_series(base.map(line))?;
    Ok(())
}

/// All values of a bar that an axis can show.
fn shown(bar: &Bar, scale: AxisScale) -> impl Iterator<Item = f64> {
    let ends = bar.interval.into_iter().flat_map(|(low, high)| [low, high]);
    let points = ends.chain(bar.points.clone());
    let values = [bar.value].into_iter().chain(points);
    values.filter(move |value| shows(scale, *value))
}

fn draw_bar<B: DrawingBackend>(
    chart: &mut Chart<B>,
    scale: AxisScale,
    base: Option<f64>,
    half: f64,
    (color, bar): (usize, &Bar),
) -> DrawResult<(), B> {
    let x = color as f64 + 0.5;
    let bottom = chart.y_range().start;
    if !shows(scale, bar.value) {
        let label = Text::new("n/a", (0, -ROW / 2), text_style(INK));
        chart.draw_series([EmptyElement::at((x, bottom)) + label])?;
        return Ok(());
    }
    let across = |half: f64, y: f64| [(x - half, y), (x + half, y)];
    let top = across(half, bar.value);
    if let Some(base) = base {
        let corners = [top[0], (x + half, base)];
        chart.draw_series([Rectangle::new(corners, palette(color).filled())])?;
    } else {
        chart.draw_series([PathElement::new(top, palette(color).stroke_width(8))])?;
    }
    if let Some((low, high)) = bar.interval.filter(|ends| shows(scale, ends.1)) {
        // A low end outside the axis is drawn at its bottom. White edges keep it visible on a dark
        // bar.
        let low = if shows(scale, low) { low } else { bottom };
        for (cap, style) in [(1.2, WHITE.stroke_width(10)), (1.0, INK.stroke_width(4))] {
            let cap = cap * CAP * half;
            let lines = [across(cap, low), across(cap, high), [(x, low), (x, high)]];
            chart.draw_series(lines.map(|ends| PathElement::new(ends, style)))?;
        }
    }
    let dots = bar.points.iter().enumerate();
    for (i, value) in dots.filter(|dot| shows(scale, *dot.1)) {
        // Spread by the golden ratio, beside the interval in the middle.
        let spread = half * ((i as f64 * 0.618).fract() * 0.5 + 0.45);
        let place = across(spread, *value)[i % 2];
        let discs = [(7, WHITE), (5, INK)];
        chart
            .draw_series(discs.map(|(radius, color)| Circle::new(place, radius, color.filled())))?;
    }
    // The number, above everything that belongs to the bar.
    let end = shown(bar, scale).chain(base).fold(bar.value, f64::max);
    let down = -ROW * 2 / 3;
    let number = number(bar.value, 2);
    let (wide, high) = (frame::width(&number) / 2, ROW / 3);
    let behind = Rectangle::new([(-wide, down - high), (wide, down + high)], WHITE.filled());
    let label = Text::new(number, (0, down + frame::LOWER), text_style(INK));
    chart.draw_series([EmptyElement::at((x, end)) + behind + label])?;
    Ok(())
}
