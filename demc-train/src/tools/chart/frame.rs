//! The frame of a panel: title, axes, labels and grid, with the colours and text of all panels.

use plotters::coord::Shift;
use plotters::coord::ranged1d::BoldPoints;
use plotters::prelude::*;
use plotters::style::text_anchor::{HPos, Pos, VPos};

use super::axis::{Axis, number};

/// The colours of Okabe and Ito (2008), distinguishable with colour blindness. Yellow, faint on
/// white, is last.
const PALETTE: [u32; 8] = [
    0x0072B2, 0xD55E00, 0x009E73, 0xCC79A7, 0xE69F00, 0x56B4E9, 0x000000, 0xF0E442,
];
pub(super) const INK: RGBColor = RGBColor(0x22, 0x22, 0x22);
pub(super) const GREY: RGBColor = RGBColor(0x77, 0x77, 0x77);
pub(super) const GRID: [RGBColor; 2] = [RGBColor(0xD0, 0xD0, 0xD0), RGBColor(0xEC, 0xEC, 0xEC)];
/// Text sizes of titles and of all other text, in drawing units.
pub(super) const SIZES: [f64; 2] = [36.0, 30.0];
pub(super) const ROW: i32 = 40;
/// Offset that centres text vertically where `plotters` places it too high.
pub(super) const LOWER: i32 = 4;
/// Margin around panels and legends.
pub(super) const EDGE: i32 = 24;
/// Font size in an SVG of a text size of 1: `plotters` divides by it.
const POINTS: f64 = 1.0 / 1.24;
/// Width of a character as a share of the font size. Estimate: text in the widest usual
/// `sans-serif` fonts (Verdana, DejaVu Sans) averages 0.58 to 0.62, in Arial and Helvetica 0.5.
const CHARACTER: f64 = 0.65;

pub(super) type Area<B> = DrawingArea<B, Shift>;
pub(super) type Chart<'a, B> = ChartContext<'a, B, Cartesian2d<Axis, Axis>>;
/// Names with their index in the palette.
pub(super) type LegendEntries = Vec<(String, usize)>;

pub(super) fn palette(color: usize) -> RGBColor {
    let [_, red, green, blue] = PALETTE[color % PALETTE.len()].to_be_bytes();
    if color < PALETTE.len() {
        RGBColor(red, green, blue)
    } else {
        RGBColor(red / 2 + 0x40, green / 2 + 0x40, blue / 2 + 0x40)
    }
}

pub(super) fn font(size: f64) -> FontDesc<'static> {
    FontDesc::new(FontFamily::SansSerif, size, FontStyle::Normal)
}

pub(super) fn text_style(color: RGBColor) -> TextStyle<'static> {
    let middle = Pos::new(HPos::Center, VPos::Center);
    font(SIZES[1]).color(&color).pos(middle)
}

/// Estimated width of a label in drawing units. The viewer chooses the font, so no exact width is
/// known.
pub(super) fn width(text: &str) -> i32 {
    (text.chars().count() as f64 * CHARACTER * SIZES[1] * POINTS).ceil() as i32
}

/// Draws title, axes, labels (of x and y) and grid of a panel and returns it, or draws "no data"
/// without an axis.
pub(super) fn chart<'c, B: DrawingBackend>(
    area: &Area<B>,
    [title, x_label, y_label]: [&str; 3],
    axes: (Option<Axis>, Option<Axis>),
) -> DrawResult<Option<Chart<'c, B>>, B> {
    let title_style = font(SIZES[0]).color(&INK);
    let area = area.margin(EDGE, 0, 0, 0).titled(title, title_style)?;
    let (wide, high) = area.dim_in_pixel();
    let (Some(x), Some(y)) = axes else {
        let middle = (wide as i32 / 2, high as i32 / 2);
        area.draw(&Text::new("no data", middle, text_style(GREY)))?;
        return Ok(None);
    };
    let [x_most, y_most] = [wide as usize / 130, high as usize / 80];
    let numbers = y.key_points(BoldPoints(y_most)).into_iter();
    let widest = numbers.map(|value| width(&number(value, 9))).max();
    let mut chart = ChartBuilder::on(&area)
        .margin(EDGE)
        .margin_right(2 * EDGE)
        .x_label_area_size(2 * ROW + EDGE / 2)
        .y_label_area_size(widest.unwrap_or(0) + ROW + EDGE)
        .build_cartesian_2d(x, y)?;
    let mut mesh = chart.configure_mesh();
    mesh.set_all_tick_mark_size(8)
        .x_labels(x_most)
        .y_labels(y_most)
        .label_style(text_style(INK))
        .y_label_offset(LOWER)
        .x_desc(x_label)
        .y_desc(y_label)
        .axis_style(GREY.stroke_width(2))
        .bold_line_style(GRID[0].stroke_width(2))
        .light_line_style(GRID[1].stroke_width(2))
        .draw()?;
    Ok(Some(chart))
}
