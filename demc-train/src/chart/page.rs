//! The page: panels in rows and columns, and the legend below them.

use super::frame::{self, Entries, ROW, Sample};
use super::paint::Font;
use super::shape::{Area, Drawing};
use super::{Figure, bars, lines};

/// White around everything, in pixels of the PNG.
const EDGE: f64 = 24.0;
/// White between panels.
const BETWEEN: f64 = 30.0;
/// Pixels of the PNG for a panel that is alone, one of two or four, one of more: width, height.
const PANELS: [(f64, f64); 3] = [(1552.0, 900.0), (1000.0, 760.0), (820.0, 700.0)];

/// The figure as shapes.
pub(super) fn drawn(figure: &Figure, font: Font) -> Drawing {
    let (count, entries, sample): (usize, Vec<Entries>, Sample) = match figure {
        Figure::Lines(panels) => {
            let entries = panels.iter().map(lines::entries).collect();
            (panels.len(), entries, Sample::Line)
        }
        Figure::Bars(panels) => {
            let entries = panels.iter().map(bars::entries).collect();
            (panels.len(), entries, Sample::Box)
        }
    };
    let (columns, (width, height)) = grid(count);
    let mut drawing = Drawing::new(0.0, 0.0, font);
    let named = match figure {
        Figure::Lines(_) => false,
        Figure::Bars(panels) => panels.iter().all(|p| bars::names_fit(&drawing, p, width)),
    };
    let shared = match named {
        true => Some(Entries::new()),
        false => frame::shared(&entries),
    };
    let own = |drawing: &Drawing, i: usize| match (&shared, entries.get(i)) {
        (None, Some(entries)) => frame::legend_height(drawing, entries, width),
        _ => 0.0,
    };
    let tallest = (0..count).map(|i| own(&drawing, i)).fold(0.0, f64::max);

    let rows = count.div_ceil(columns).max(1);
    let right = 2.0 * EDGE + columns as f64 * (width + BETWEEN) - BETWEEN;
    let bottom = EDGE + rows as f64 * (height + tallest + BETWEEN) - BETWEEN;
    for i in 0..count {
        let left = EDGE + (i % columns) as f64 * (width + BETWEEN);
        let top = EDGE + (i / columns) as f64 * (height + tallest + BETWEEN);
        let cell = Area {
            left,
            top,
            right: left + width,
            bottom: top + height,
        };
        match figure {
            Figure::Lines(panels) => lines::draw(&mut drawing, cell, &panels[i]),
            Figure::Bars(panels) => bars::draw(&mut drawing, cell, &panels[i], named),
        }
        if shared.is_none() {
            let below = Area {
                top: cell.bottom,
                ..cell
            };
            frame::legend(&mut drawing, &entries[i], below, sample);
        }
    }
    let mut end = bottom;
    if count == 0 {
        let page = Area {
            left: EDGE,
            top: EDGE,
            right: right - EDGE,
            bottom,
        };
        frame::no_data(&mut drawing, page);
    }
    if let Some(entries) = shared.filter(|entries| !entries.is_empty()) {
        let below = Area {
            left: EDGE,
            top: bottom + ROW / 4.0,
            right: right - EDGE,
            bottom,
        };
        frame::legend(&mut drawing, &entries, below, sample);
        end = below.top + frame::legend_height(&drawing, &entries, below.width());
    }
    drawing.width = right.ceil() as u32;
    drawing.height = (end + EDGE).ceil() as u32;
    drawing
}

/// How many columns, and how large a panel is.
fn grid(count: usize) -> (usize, (f64, f64)) {
    match count {
        0 | 1 => (1, PANELS[0]),
        2 | 4 => (2, PANELS[1]),
        _ => (3, PANELS[2]),
    }
}
