//! The page: panels in rows and columns, each with its frame, and the legend beside them.

use plotters::coord::Shift;
use plotters::coord::ranged1d::BoldPoints;
use plotters::prelude::*;
use plotters::style::text_anchor::{HPos, Pos, VPos};

use super::axis::{Axis, number};
use super::{Figure, bars, lines};

/// The colours of Okabe and Ito (2008), which the colour-blind tell apart; yellow, hard to see on white, comes last.
const PALETTE: [u32; 8] = [
    0x0072B2, 0xD55E00, 0x009E73, 0xCC79A7, 0xE69F00, 0x56B4E9, 0x000000, 0xF0E442,
];
/// Words and intervals.
pub(super) const INK: RGBColor = RGBColor(0x22, 0x22, 0x22);
/// Axes and what is less important than words.
pub(super) const GREY: RGBColor = RGBColor(0x77, 0x77, 0x77);
/// Grid lines of labelled values, of those between.
const GRID: [RGBColor; 2] = [RGBColor(0xD0, 0xD0, 0xD0), RGBColor(0xEC, 0xEC, 0xEC)];
/// Sizes of titles and of all other words, in pixels of the PNG.
const SIZES: [f64; 2] = [36.0, 30.0];
/// Height of a line of words.
pub(super) const ROW: i32 = 40;
/// How much lower than `plotters` puts them words are centred.
pub(super) const LOWER: i32 = 4;
/// White around panels and legends.
const EDGE: i32 = 24;
/// Length of the line in a legend.
const SAMPLE: i32 = 44;
/// Browsers' fonts for `sans-serif` are up to this much wider than the embedded one.
const OTHER_FONTS: f64 = 1.12;

/// What panels are drawn on.
pub(super) type Area<B> = DrawingArea<B, Shift>;
/// A panel whose values have places.
pub(super) type Chart<'a, B> = ChartContext<'a, B, Cartesian2d<Axis, Axis>>;
/// Names with their places in the palette.
pub(super) type Entries = Vec<(String, usize)>;

/// A figure and where its parts go.
pub(super) struct Page<'a> {
    figure: &'a Figure,
    /// Rows and columns of panels, pixels of each.
    grid: (usize, usize),
    panel: (u32, u32),
    legend: Entries,
}

impl<'a> Page<'a> {
    pub(super) fn of(figure: &'a Figure) -> Self {
        let entries: Vec<Entries> = match figure {
            Figure::Lines(panels) => panels.iter().map(lines::entries).collect(),
            Figure::Bars(panels) => panels.iter().map(bars::entries).collect(),
        };
        let (columns, panel) = match entries.len() {
            0 | 1 => (1, (1552, 900)),
            2 | 4 => (2, (1000, 760)),
            _ => (3, (820, 700)),
        };
        let mut legend = Entries::new();
        for entry in entries.iter().flatten() {
            if !legend.contains(entry) {
                legend.push(entry.clone());
            }
        }
        Page {
            figure,
            grid: (entries.len().div_ceil(columns).max(1), columns),
            panel,
            legend,
        }
    }

    /// Width and height in pixels.
    pub(super) fn size(&self) -> (u32, u32) {
        let panels = self.grid.1 as u32 * self.panel.0;
        let widest = self.legend.iter().map(|(name, _)| width(name)).max();
        let legend = widest.map_or(EDGE, |widest| widest + SAMPLE + 4 * EDGE);
        let names = self.legend.len() as i32 * ROW + 4 * EDGE;
        let height = self.grid.0 as u32 * self.panel.1;
        (panels + legend as u32, height.max(names as u32))
    }

    pub(super) fn draw<B: DrawingBackend>(
        &self,
        root: &Area<B>,
        is_bitmap: bool,
    ) -> DrawResult<(), B> {
        root.fill(&WHITE)?;
        let (areas, beside) = root.split_horizontally(self.grid.1 as u32 * self.panel.0);
        for (i, area) in areas.split_evenly(self.grid).iter().enumerate() {
            match self.figure {
                Figure::Lines(panels) if i < panels.len() => {
                    lines::draw(area, &panels[i], is_bitmap)?
                }
                Figure::Bars(panels) if i < panels.len() => bars::draw(area, &panels[i])?,
                _ if i == 0 => drop(chart(area, "", None, "", (None, None))?),
                _ => {}
            }
        }
        self.draw_legend(&beside)?;
        root.present()
    }

    /// In a column of its own, where it hides nothing.
    fn draw_legend<B: DrawingBackend>(&self, area: &Area<B>) -> DrawResult<(), B> {
        if self.legend.is_empty() {
            return Ok(());
        }
        let width = match self.figure {
            Figure::Lines(_) => 5,
            Figure::Bars(_) => 22,
        };
        let mut builder = ChartBuilder::on(area);
        let mut chart = builder
            .margin_top(3 * EDGE)
            .build_cartesian_2d(0..1, 0..1)?;
        for (name, color) in &self.legend {
            let style = palette(*color).stroke_width(width);
            let series = chart.draw_series(LineSeries::new([(0, 0); 0], style))?;
            series.label(name).legend(move |(x, y)| {
                let y = y - LOWER / 2;
                PathElement::new([(x, y), (x + SAMPLE, y)], style)
            });
        }
        let mut labels = chart.configure_series_labels();
        labels.position(SeriesLabelPosition::UpperLeft);
        labels.legend_area_size(SAMPLE + EDGE / 2);
        labels.label_font(font(SIZES[1]).color(&INK)).draw()
    }
}

/// The colour of a place in the palette, which begins again after its last in greyer ones.
pub(super) fn palette(color: usize) -> RGBColor {
    let [_, red, green, blue] = PALETTE[color % PALETTE.len()].to_be_bytes();
    match color < PALETTE.len() {
        true => RGBColor(red, green, blue),
        false => RGBColor(red / 2 + 0x40, green / 2 + 0x40, blue / 2 + 0x40),
    }
}

fn font(size: f64) -> FontDesc<'static> {
    FontDesc::new(FontFamily::SansSerif, size, FontStyle::Normal)
}

/// Words centred on their place.
pub(super) fn words(color: RGBColor) -> TextStyle<'static> {
    let middle = Pos::new(HPos::Center, VPos::Center);
    font(SIZES[1]).color(&color).pos(middle)
}

/// Pixels that words are wide, in the widest of the usual fonts.
pub(super) fn width(text: &str) -> i32 {
    let (width, _) = font(SIZES[1]).box_size(text).unwrap_or_default();
    (OTHER_FONTS * f64::from(width)).ceil() as i32
}

/// A chart whose title, axes, labels and grid are drawn, or "no data" where an axis is missing. Without `x_label`, the
/// x axis has neither numbers nor grid lines.
pub(super) fn chart<'c, B: DrawingBackend>(
    area: &Area<B>,
    title: &str,
    x_label: Option<&str>,
    y_label: &str,
    axes: (Option<Axis>, Option<Axis>),
) -> DrawResult<Option<Chart<'c, B>>, B> {
    let title_style = font(SIZES[0]).color(&INK);
    let area = area.margin(EDGE, 0, 0, 0).titled(title, title_style)?;
    let (wide, high) = area.dim_in_pixel();
    let (Some(x), Some(y)) = axes else {
        let middle = (wide as i32 / 2, high as i32 / 2);
        area.draw(&Text::new("no data", middle, words(GREY)))?;
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
        .x_labels(x_label.map_or(0, |_| x_most))
        .y_labels(y_most)
        .label_style(words(INK))
        .y_label_offset(LOWER)
        .x_desc(x_label.unwrap_or_default())
        .y_desc(y_label)
        .axis_style(GREY.stroke_width(2))
        .bold_line_style(GRID[0].stroke_width(2))
        .light_line_style(GRID[1].stroke_width(2))
        .draw()?;
    Ok(Some(chart))
}
