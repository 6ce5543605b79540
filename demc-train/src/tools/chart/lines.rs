//! A panel of lines.

use plotters::prelude::*;
use plotters::style::text_anchor::{HPos, Pos, VPos};

use super::axis::{Axis, shows};
use super::figure::{LinePanel, Series};
use super::frame::{self, Area, Chart, INK, LegendEntries, ROW, palette, text_style};

/// Line widths of a series and of a faint one, in drawing units.
const WIDTHS: [u32; 2] = [4, 2];
const RADIUS: u32 = 7;
/// Share of its colour that a faint series keeps.
const FAINT: f64 = 0.35;
/// Series of at most this many points show each point.
const FEW: usize = 40;
/// Margins as shares of an axis: beyond the data, and per label of a mark.
const MARGINS: [f64; 2] = [0.04, 0.06];

pub(super) fn entries(panel: &LinePanel) -> LegendEntries {
    let named = |series: &&Series| !series.faint && !series.name.is_empty();
    let shown = panel.series.iter().filter(named);
    shown.map(|s| (s.name.clone(), s.color)).collect()
}

pub(super) fn draw<B: DrawingBackend>(area: &Area<B>, panel: &LinePanel) -> DrawResult<(), B> {
    let is_shown = |point: &(f64, f64)| shows(panel.x, point.0) && shows(panel.y, point.1);
    let points = || panel.series.iter().flat_map(|series| &series.points);
    let shown = || points().filter(|point| is_shown(point));
    let marks = panel.marks.iter().filter(|mark| shows(panel.x, mark.0));
    let xs = shown()
        .map(|point| point.0)
        .chain(marks.clone().map(|mark| mark.0));
    let x = Axis::over(panel.x, xs, [MARGINS[0]; 2]);
    let above = MARGINS[0] + MARGINS[1] * marks.clone().count() as f64;
    let ys = shown().map(|point| point.1);
    let y = Axis::over(panel.y, ys, [MARGINS[0], above]);
    let labels = [&*panel.title, &panel.x_label, &panel.y_label];
    let chart = frame::chart(area, labels, (x, y))?;
    let Some(mut chart) = chart else {
        return Ok(());
    };
    for faint in [true, false] {
        for series in panel.series.iter().filter(|series| series.faint == faint) {
            let runs = series.points.split(|point| !is_shown(point));
            for run in runs.filter(|run| !run.is_empty()) {
                draw_run(&mut chart, series, run)?;
            }
        }
    }
    draw_marks(&mut chart, &marks.collect::<Vec<_>>())
}

fn draw_run<B: DrawingBackend>(
    chart: &mut Chart<B>,
    series: &Series,
    run: &[(f64, f64)],
) -> DrawResult<(), B> {
    let RGBColor(red, green, blue) = palette(series.color);
    let pale = |x: u8| (255.0 - FAINT * (255.0 - f64::from(x))).round() as u8;
    let (color, width) = if series.faint {
        (RGBColor(pale(red), pale(green), pale(blue)), WIDTHS[1])
    } else {
        (RGBColor(red, green, blue), WIDTHS[0])
    };
    let style = color.filled().stroke_width(width);
    let dots = run.len() == 1 || (series.points.len() <= FEW && !series.faint);
    let radius = if dots { RADIUS } else { 0 };
    let line = LineSeries::new(run.iter().copied(), style);
    chart.draw_series(line.point_size(radius))?;
    Ok(())
}

/// Draws the marks as dashed lines. Their labels stand in rows above the data.
fn draw_marks<B: DrawingBackend>(
    chart: &mut Chart<B>,
    marks: &[&(f64, String)],
) -> DrawResult<(), B> {
    let (heights, right) = (
        chart.y_range(),
        chart.plotting_area().get_pixel_range().0.end,
    );
    for (value, _) in marks {
        let ends = [(*value, heights.start), (*value, heights.end)];
        chart.draw_series(DashedLineSeries::new(ends, 14, 9, INK.stroke_width(3)))?;
    }
    for (row, (value, label)) in (0..).zip(marks) {
        let (top, width, y) = ((*value, heights.end), frame::width(label) + 16, row * ROW);
        let (side, from, to) = if chart.backend_coord(&top).0 + width < right {
            (HPos::Left, 8, width)
        } else {
            (HPos::Right, -8, -width)
        };
        let behind = Rectangle::new([(from / 2, y + 2), (to, y + ROW)], WHITE.filled());
        let style = text_style(INK).pos(Pos::new(side, VPos::Center));
        let label = Text::new(label.clone(), (from, y + ROW / 2 + frame::LOWER), style);
        chart.draw_series([EmptyElement::at(top) + behind + label])?;
    }
    Ok(())
}
