//! Panels of named values.

use plotters::prelude::*;
use plotters::style::text_anchor::{HPos, Pos, VPos};

use super::axis::{Axis, number, shows};
use super::figure::{AxisScale, Category, CategoryFigure, CategoryPanel};
use super::frame::{
    Area, EDGE, GREY, GRID, INK, LOWER, ROW, SIZES, font, palette, text_style, width,
};

/// Width of a panel without names, in drawing units.
const PANEL: i32 = 900;
/// Height of a category.
const HEIGHT: i32 = 3 * ROW / 2;
/// Height of title, labels, and margins.
const AROUND: i32 = 5 * ROW;
/// Half of a bar's height, as a share of a category's.
const HALF: f64 = 0.3;
/// Half of the height of an interval's ends.
const CAP: f64 = 0.15;
/// Opacity of a bar, under the line of its interval.
const OPACITY: f64 = 0.7;
const LINE: u32 = 4;
const RADIUS: i32 = 9;
/// Space beyond the data, as a share of the axis.
const MARGIN: f64 = 0.05;
/// A bar is cut, and its value written on it, if it ends beyond this multiple of all others.
const CUT: f64 = 2.0;

impl CategoryFigure {
    /// Width and height in drawing units.
    pub(super) fn size(&self) -> (u32, u32) {
        let widths = self.0.iter().map(|panel| PANEL + names_width(panel));
        let rows = self.0.iter().map(|panel| panel.rows.len()).max();
        let height = AROUND + rows.unwrap_or(0) as i32 * HEIGHT;
        (widths.sum::<i32>().max(PANEL) as u32, height as u32)
    }

    pub(super) fn draw<B: DrawingBackend>(&self, root: &Area<B>) -> DrawResult<(), B> {
        root.fill(&WHITE)?;
        let mut rest = root.clone();
        for panel in &self.0 {
            let (area, others) = rest.split_horizontally(PANEL + names_width(panel));
            draw_panel(&area, panel)?;
            rest = others;
        }
        root.present()
    }
}

fn names_width(panel: &CategoryPanel) -> i32 {
    let widest = panel.rows.iter().map(|row| width(&row.name)).max();
    widest.unwrap_or(0) + 2 * EDGE
}

/// All ends of a category on the axis.
fn ends(row: &Category) -> impl Iterator<Item = f64> {
    row.interval.into_iter().flatten().chain([row.value])
}

/// The value at which the axis ends before its margin: infinite, unless one bar is much longer than all others.
fn bars_limit(panel: &CategoryPanel) -> f64 {
    let longest = |row: &&Category| ends(row).fold(0.0, f64::max);
    let mut rows: Vec<&Category> = panel.rows.iter().collect();
    rows.sort_by(|a, b| longest(a).total_cmp(&longest(b)));
    match rows[..] {
        [.., second, last] if panel.bars && last.value > CUT * longest(&second) => {
            CUT * longest(&second)
        }
        _ => f64::INFINITY,
    }
}

fn draw_panel<B: DrawingBackend>(area: &Area<B>, panel: &CategoryPanel) -> DrawResult<(), B> {
    let area = area
        .margin(EDGE, 0, 0, 0)
        .titled(&panel.title, font(SIZES[0]).color(&INK))?;
    let limit = bars_limit(panel);
    let zero = panel.bars.then_some(0.0);
    let ends = panel.rows.iter().flat_map(ends).map(|end| end.min(limit));
    let values = ends.chain(panel.line).chain(zero);
    let is_shown = |value: &f64| shows(panel.x, *value);
    // A bar starts at the edge.
    let margins = [if panel.bars { 0.0 } else { MARGIN }, MARGIN];
    let count = panel.rows.len() as f64;
    let rows = Axis::over(AxisScale::Linear, [0.0, count], [0.0; 2]);
    let (Some(x), Some(y)) = (Axis::over(panel.x, values.filter(is_shown), margins), rows) else {
        return Ok(());
    };
    let mut chart = ChartBuilder::on(&area)
        .margin(EDGE)
        .margin_right(2 * EDGE)
        .x_label_area_size(2 * ROW + EDGE / 2)
        .y_label_area_size(names_width(panel) - EDGE)
        .build_cartesian_2d(x, y)?;
    chart
        .configure_mesh()
        .disable_y_mesh()
        .disable_y_axis()
        .x_labels(PANEL as usize / 130)
        .label_style(text_style(INK))
        .x_desc(&panel.x_label)
        .axis_style(GREY.stroke_width(2))
        .bold_line_style(GRID[0].stroke_width(2))
        .light_line_style(GRID[1].stroke_width(2))
        .draw()?;
    for (index, row) in panel.rows.iter().enumerate() {
        let middle = count - 0.5 - index as f64;
        let color = palette(row.color);
        let is_cut = row.value > limit;
        if panel.bars {
            let end = row.value.min(chart.x_range().end);
            let corners = [(0.0, middle - HALF), (end, middle + HALF)];
            chart.draw_series([Rectangle::new(corners, color.mix(OPACITY).filled())])?;
        } else {
            chart.draw_series([Circle::new((row.value, middle), RADIUS, color.filled())])?;
        }
        if let Some([low, high]) = row.interval.filter(|_| !is_cut) {
            let ink = if panel.bars { INK } else { color };
            let lines = [
                [(low, middle), (high, middle)],
                [(low, middle - CAP), (low, middle + CAP)],
                [(high, middle - CAP), (high, middle + CAP)],
            ];
            let style = ink.stroke_width(LINE);
            chart.draw_series(lines.map(|line| PathElement::new(line, style)))?;
        }
        let (left, height) = chart.backend_coord(&(chart.x_range().start, middle));
        let (base_x, base_y) = area.get_base_pixel();
        let at = (left - base_x - EDGE, height - base_y + LOWER);
        let style = text_style(INK).pos(Pos::new(HPos::Right, VPos::Center));
        area.draw(&Text::new(row.name.clone(), at, style))?;
        if is_cut {
            let (right, _) = chart.backend_coord(&(chart.x_range().end, middle));
            let at = (right - base_x - EDGE, height - base_y + LOWER);
            let style = text_style(INK).pos(Pos::new(HPos::Right, VPos::Center));
            area.draw(&Text::new(number(row.value, 2), at, style))?;
        }
    }
    if let Some(value) = panel.line.filter(is_shown) {
        let ends = [(value, 0.0), (value, count)];
        chart.draw_series(DashedLineSeries::new(ends, 14, 9, INK.stroke_width(3)))?;
    }
    Ok(())
}
