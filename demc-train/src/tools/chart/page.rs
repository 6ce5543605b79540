//! The layout of a figure: panels in rows and columns, and the legend beside them.

use plotters::prelude::*;

use super::figure::Figure;
use super::frame::{
    Area, EDGE, INK, LOWER, LegendEntries, ROW, SIZES, chart, font, palette, width,
};
use super::lines;

/// Length of the sample line in a legend.
const SAMPLE: i32 = 44;

pub(super) struct FigurePage<'a> {
    figure: &'a Figure,
    /// Rows and columns of panels.
    grid: (usize, usize),
    panel: (u32, u32),
    legend: LegendEntries,
}

impl<'a> FigurePage<'a> {
    pub(super) fn new(figure: &'a Figure) -> Self {
        let entries: Vec<LegendEntries> = figure.0.iter().map(lines::entries).collect();
        let (columns, panel) = match entries.len() {
            0 | 1 => (1, (1552, 900)),
            2 | 4 => (2, (1000, 760)),
            _ => (3, (820, 700)),
        };
        let mut legend = LegendEntries::new();
        for entry in entries.iter().flatten() {
            if !legend.contains(entry) {
                legend.push(entry.clone());
            }
        }
        FigurePage {
            figure,
            grid: (entries.len().div_ceil(columns).max(1), columns),
            panel,
            legend,
        }
    }

    pub(super) fn size(&self) -> (u32, u32) {
        let panels = self.grid.1 as u32 * self.panel.0;
        let widest = self.legend.iter().map(|(name, _)| width(name)).max();
        let legend = widest.map_or(EDGE, |widest| widest + SAMPLE + 4 * EDGE);
        let names = self.legend.len() as i32 * ROW + 4 * EDGE;
        let height = self.grid.0 as u32 * self.panel.1;
        (panels + legend as u32, height.max(names as u32))
    }

    pub(super) fn draw<B: DrawingBackend>(&self, root: &Area<B>) -> DrawResult<(), B> {
        root.fill(&WHITE)?;
        let (areas, beside) = root.split_horizontally(self.grid.1 as u32 * self.panel.0);
        for (i, area) in areas.split_evenly(self.grid).iter().enumerate() {
            match self.figure.0.get(i) {
                Some(panel) => lines::draw(area, panel)?,
                None if i == 0 => drop(chart(area, ["", "", ""], (None, None))?),
                None => {}
            }
        }
        self.draw_legend(&beside)?;
        root.present()
    }

    /// Draws the legend in a separate column, where it covers no data.
    fn draw_legend<B: DrawingBackend>(&self, area: &Area<B>) -> DrawResult<(), B> {
        if self.legend.is_empty() {
            return Ok(());
        }
        let mut builder = ChartBuilder::on(area);
        let mut chart = builder
            .margin_top(3 * EDGE)
            .build_cartesian_2d(0..1, 0..1)?;
        for (name, color) in &self.legend {
            let style = palette(*color).stroke_width(5);
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
