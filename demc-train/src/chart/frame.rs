//! What panels of both kinds share: title, axes with ticks, grid, "no data", legends.

use super::axis::Axis;
use super::shape::{Align, Area, Drawing, GREY, INK, Rgb, palette};

/// Size of titles, in pixels of the PNG.
const TITLE: f64 = 34.0;
/// Size of all other words.
pub(super) const WORDS: f64 = 29.0;
/// Height of a line of words.
pub(super) const ROW: f64 = 40.0;
/// Pixels between words and what they stand beside.
const GAP: f64 = 12.0;
/// Pixels of height for a label of the y axis, of width for one of the x axis.
const ROOM: [f64; 2] = [75.0, 130.0];
/// Grid lines of labelled ticks, of minor ticks.
const GRID: [Rgb; 2] = [[0xD8; 3], [0xEE; 3]];
/// Length of the line in a legend.
const SAMPLE: f64 = 44.0;
/// Pixels between two entries of a legend.
const BETWEEN: f64 = 40.0;

/// The words around a panel.
#[derive(Clone, Copy, Debug)]
pub(super) struct Words<'a> {
    pub(super) title: &'a str,
    pub(super) x_label: &'a str,
    pub(super) y_label: &'a str,
}

/// Draws title and labels in `cell`, and returns what they leave of it. `rows` lines of words stay free under the
/// title, and room for the ticks of `y`.
pub(super) fn around(
    drawing: &mut Drawing,
    cell: Area,
    words: Words,
    y: Option<&Axis>,
    rows: usize,
) -> Area {
    let mut inside = Area {
        left: cell.left + GAP,
        top: cell.top + 1.5 * TITLE + rows as f64 * ROW,
        right: cell.right - 1.5 * WORDS,
        bottom: cell.bottom - ROW - GAP,
    };
    if !words.x_label.is_empty() {
        inside.bottom -= ROW;
    }
    if !words.y_label.is_empty() {
        inside.left += ROW;
    }
    let ticks = y.map_or(vec![], |axis| axis.ticks(wanted(inside, 0)));
    let widest = ticks.iter().map(|t| drawing.text_width(&t.label, WORDS));
    inside.left += widest.fold(0.0, f64::max) + GAP;

    let (across, down) = inside.middle();
    let title = drawing.fitted(words.title, TITLE, cell.width());
    let at = (across, cell.top + 0.7 * TITLE);
    drawing.text(at, &title, TITLE, Align::Center, INK);
    let x_label = drawing.fitted(words.x_label, WORDS, cell.width());
    let at = (across, cell.bottom - ROW / 2.0);
    drawing.text(at, &x_label, WORDS, Align::Center, INK);
    let y_label = drawing.fitted(words.y_label, WORDS, inside.bottom - inside.top);
    drawing.upright_text((cell.left + ROW / 2.0, down), &y_label, WORDS, INK);
    inside
}

fn wanted(inside: Area, way: usize) -> usize {
    let length = [inside.bottom - inside.top, inside.width()][way];
    (length / ROOM[way]) as usize
}

/// Grid lines and labels of the y axis.
pub(super) fn y_ticks(drawing: &mut Drawing, inside: Area, axis: &Axis) {
    for tick in axis.ticks(wanted(inside, 0)) {
        let ends = [inside.at(0.0, tick.at), inside.at(1.0, tick.at)];
        let is_minor = usize::from(tick.label.is_empty());
        drawing.line(ends.to_vec(), 2, GRID[is_minor]);
        let at = (inside.left - GAP, ends[0].1);
        drawing.text(at, &tick.label, WORDS, Align::Right, INK);
    }
}

/// Grid lines and labels of the x axis.
pub(super) fn x_ticks(drawing: &mut Drawing, inside: Area, axis: &Axis) {
    for tick in axis.ticks(wanted(inside, 1)) {
        let ends = [inside.at(tick.at, 0.0), inside.at(tick.at, 1.0)];
        let is_minor = usize::from(tick.label.is_empty());
        drawing.line(ends.to_vec(), 2, GRID[is_minor]);
        x_name(drawing, inside, tick.at, &tick.label);
    }
}

/// A word below the x axis.
pub(super) fn x_name(drawing: &mut Drawing, inside: Area, at: f64, name: &str) {
    let (across, bottom) = inside.at(at, 0.0);
    let at = (across, bottom + GAP + WORDS / 2.0);
    drawing.text(at, name, WORDS, Align::Center, INK);
}

/// The lines of the axes, over the grid.
pub(super) fn axes(drawing: &mut Drawing, inside: Area) {
    let corners = [(0.0, 1.0), (0.0, 0.0), (1.0, 0.0)].map(|(x, y)| inside.at(x, y));
    drawing.line(corners.to_vec(), 2, GREY);
}

/// What a panel without data shows.
pub(super) fn no_data(drawing: &mut Drawing, inside: Area) {
    drawing.text(inside.middle(), "no data", WORDS, Align::Center, GREY);
}

/// Names with their places in the palette.
pub(super) type Entries = Vec<(String, usize)>;

/// How a legend shows a colour.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) enum Sample {
    Line,
    Box,
}

/// The entries of `panels` once each, if no colour stands for two names.
pub(super) fn shared(panels: &[Entries]) -> Option<Entries> {
    let mut all = Entries::new();
    for entry in panels.iter().flatten() {
        if !all.contains(entry) {
            if all.iter().any(|(_, color)| *color == entry.1) {
                return None;
            }
            all.push(entry.clone());
        }
    }
    Some(all)
}

/// Pixels of height of a legend in a given width.
pub(super) fn legend_height(drawing: &Drawing, entries: &Entries, width: f64) -> f64 {
    legend_rows(drawing, entries, width).len() as f64 * ROW
}

/// Draws a legend downwards from the top of `area`.
pub(super) fn legend(drawing: &mut Drawing, entries: &Entries, area: Area, sample: Sample) {
    for (i, row) in legend_rows(drawing, entries, area.width())
        .iter()
        .enumerate()
    {
        let widths: Vec<_> = row.iter().map(|(n, _)| entry_width(drawing, n)).collect();
        let total = widths.iter().sum::<f64>() + BETWEEN * (row.len() - 1) as f64;
        let mut x = area.middle().0 - total / 2.0;
        let y = area.top + (i as f64 + 0.5) * ROW;
        for ((name, color), width) in row.iter().zip(widths) {
            draw_sample(drawing, (x, y), *color, sample);
            let at = (x + SAMPLE + GAP, y);
            drawing.text(at, name, WORDS, Align::Left, INK);
            x += width + BETWEEN;
        }
    }
}

fn draw_sample(drawing: &mut Drawing, (x, y): (f64, f64), color: usize, sample: Sample) {
    match sample {
        Sample::Line => colored_line(drawing, vec![(x, y), (x + SAMPLE, y)], 5, color),
        Sample::Box => drawing.fill(
            Area {
                left: x + SAMPLE - ROW / 2.0,
                top: y - ROW / 4.0,
                right: x + SAMPLE,
                bottom: y + ROW / 4.0,
            },
            palette(color),
        ),
    }
}

/// A line in a colour of the palette, in dashes where the palette has begun again.
pub(super) fn colored_line(
    drawing: &mut Drawing,
    points: Vec<(f64, f64)>,
    width: u32,
    color: usize,
) {
    if color < super::shape::PALETTE.len() {
        drawing.line(points, width, palette(color));
    } else {
        drawing.dashed(&points, width, palette(color));
    }
}

fn entry_width(drawing: &Drawing, name: &str) -> f64 {
    SAMPLE + GAP + drawing.text_width(name, WORDS)
}

/// Entries in rows, names cut to the width.
fn legend_rows(drawing: &Drawing, entries: &Entries, width: f64) -> Vec<Entries> {
    let mut rows: Vec<Entries> = Vec::new();
    let mut left = 0.0;
    for (name, color) in entries {
        let name = drawing.fitted(name, WORDS, width - SAMPLE - GAP);
        let needed = entry_width(drawing, &name) + BETWEEN;
        match rows.last_mut().filter(|_| needed <= left + BETWEEN) {
            Some(row) => row.push((name, *color)),
            None => {
                rows.push(vec![(name, *color)]);
                left = width;
            }
        }
        left -= needed;
    }
    rows
}

#[cfg(test)]
mod tests {
    use super::super::paint::Font;
    use super::*;

    fn entries(names: &[(&str, usize)]) -> Entries {
        names
            .iter()
            .map(|(n, color)| (n.to_string(), *color))
            .collect()
    }

    #[test]
    fn legend_is_shared_unless_a_colour_means_two_things() {
        let [a, b] = [entries(&[("a", 0)]), entries(&[("b", 1)])];
        let both = shared(&[a.clone(), a.clone(), b.clone()]).unwrap();
        assert_eq!(both, entries(&[("a", 0), ("b", 1)]));
        assert_eq!(shared(&[a, entries(&[("b", 0)])]), None);
    }

    #[test]
    fn legend_breaks_into_rows_that_fit() {
        let drawing = Drawing::new(10.0, 10.0, Font::embedded().unwrap());
        let names = entries(&[("first", 0), ("second", 1), ("third", 2), ("x", 3)]);
        let rows = legend_rows(&drawing, &names, 360.0);
        assert!(rows.len() > 1);
        assert_eq!(rows.concat(), names);
        for row in &rows {
            let total: f64 = row
                .iter()
                .map(|(n, _)| entry_width(&drawing, n) + BETWEEN)
                .sum();
            assert!(total - BETWEEN <= 360.0, "{row:?}");
        }
    }
}
